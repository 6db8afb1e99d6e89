import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ntop import cli
from ntop.config.sections import RenderConfig, TrainConfig
from ntop.conventions import ConfigError
from ntop.stages import VERSIONS

ROOT = Path(__file__).parents[1]
RIGS = {"a": {"height_above_pelvis_m": 1.0, "ring_radius_m": 0.5}}


def entry(config: RenderConfig, out: Path, frames: list[int], motion: str, seed: int = 3) -> None:
    """Stand-in with every kind of parameter."""


def test_flags_come_from_the_signature():
    config = json.dumps({"rigs": RIGS, "version": VERSIONS["render"]})
    words = ["--config", config, "--out", "x", "--motion", ""]
    values = cli.parse(entry, verb="render", words=[*words, "--frames", "3", "4"])
    assert values["config"].rigs["a"].ring_radius_m == 0.5
    assert values["out"] == Path("x")
    assert values["frames"] == [3, 4]
    assert values["motion"] == ""
    assert values["seed"] == 3


def tool(*command: str, n: int, json: bool = False) -> int:
    """Stand-in for a tool that runs a command."""
    return n + len(command) + json


def test_a_tool_may_take_a_command_a_letter_and_a_switch():
    words = ["-n", "2", "--json", "--", "ls", "-n", "--", "x"]
    values = cli.parse(tool, verb="tool", words=words)
    assert values == {"n": 2, "json": True, "command": ["ls", "-n", "--", "x"]}
    assert cli.parse(tool, verb="tool", words=["-n", "2", "--", "ls"])["json"] is False


@pytest.mark.parametrize("words", [["-n", "2"], ["-n", "2", "--"], ["-n", "2", "ls"]])
def test_a_tool_without_its_command_is_refused(words, capsys):
    with pytest.raises(SystemExit):
        cli.parse(tool, verb="tool", words=words)
    assert "-- command" in capsys.readouterr().err


def test_the_exit_code_is_what_the_verb_returns(monkeypatch):
    monkeypatch.setattr("ntop.tools.lease.main", tool)
    assert cli.main(["lease", "-n", "2", "--", "ls"]) == 3


def test_a_config_file_serves_as_well(tmp_path):
    path = tmp_path / "train.json"
    path.write_text('{"steps": 7}')
    assert cli.read_section(str(path), kind=TrainConfig, verb="train").steps == 7


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"version": 99}', "version 99 of stage train"),
        ('{"stepz": 1}', "stepz: unknown key"),
        ("{nonsense", "not JSON"),
        ("missing.json", "cannot read"),
    ],
)
def test_a_wrong_config_is_refused_in_words(text, words):
    with pytest.raises(ConfigError, match=words):
        cli.read_section(text, kind=TrainConfig, verb="train")


def test_an_unknown_verb_lists_the_known_ones(capsys):
    assert cli.main(["paint"]) == cli.EXIT_USER_ERROR
    assert "capture, mask, fit, train" in capsys.readouterr().err


def test_an_error_for_people_has_no_traceback(capsys, tmp_path):
    code = cli.main(["annotate", "--config", "{}", "--renders", str(tmp_path), "--out", "x"])
    assert code == cli.EXIT_USER_ERROR
    assert capsys.readouterr().err.startswith("ntop annotate: ")


@pytest.mark.parametrize("words", [["lens"], []])
def test_output_that_nobody_reads_ends_without_a_word(words):
    reader, writer = os.pipe()
    os.close(reader)  # as `head` does once it has its lines
    done = subprocess.run(
        [sys.executable, "-m", "ntop.cli", *words],
        cwd=ROOT,
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (cli.EXIT_UNREAD, "")


def test_a_pipe_that_broke_elsewhere_is_not_hidden(monkeypatch):
    def broken() -> None:
        raise BrokenPipeError

    monkeypatch.setattr("ntop.tools.orphans.main", broken)
    reader, writer = os.pipe()
    with os.fdopen(reader), os.fdopen(writer, "w") as read_by_somebody:
        monkeypatch.setattr("sys.stdout", read_by_somebody)
        with pytest.raises(BrokenPipeError):
            cli.main(["orphans"])
