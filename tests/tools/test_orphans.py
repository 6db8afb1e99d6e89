"""What a killed Snakemake leaves: a real one is killed; SLURM's answers come from a stand-in."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ntop import cli
from ntop.tools.alive import is_snakemake, processes_in, read_marks, slurm_comment
from ntop.tools.orphans import EXIT_ORPHANS
from tests.tools.run_folder import PATIENCE_S, ROOT, RunFolder, stand_in_for_squeue

SHARD = "results/5_render/raw/loose/range/h1.0_r0.5/000000"
SNAKEFILE = """
rule make:
    output: "made"
    shell: "exec {python} -c 'import time; time.sleep(600)' --out {{output}}"
"""


@pytest.fixture
def run(tmp_path):
    run = RunFolder(tmp_path / "run")
    yield run
    run.end()
    for orphan in processes_in(run.folder).jobs.values():
        os.kill(orphan, signal.SIGKILL)


def look(run, capsys) -> tuple[int, str]:
    code = cli.main(["orphans", "--directory", str(run.folder)])
    return code, capsys.readouterr().out


def test_nothing_left_is_said_and_is_no_error(run, capsys):
    code, text = look(run, capsys)
    assert (code, text) == (0, f"nothing is left in {run.folder}: start snakemake as usual\n")


def test_a_killed_snakemake_and_the_job_that_outlives_it(run, capsys):
    run.write("Snakefile", SNAKEFILE.format(python=sys.executable))
    head = subprocess.Popen(
        [sys.executable, "-m", "snakemake", "made", "--cores", "1", "--quiet", "all"],
        cwd=run.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    run.processes.append(head)
    patience = time.monotonic() + PATIENCE_S
    while not (processes_in(run.folder).jobs and read_marks(run.folder)):
        assert time.monotonic() < patience
        time.sleep(0.1)
    code, text = look(run, capsys)
    assert code == 0
    assert f"(process {head.pid}) on 1 outputs: nothing is orphaned" in text

    head.kill()
    head.wait()
    (orphan,) = processes_in(run.folder).jobs.values()
    code, text = look(run, capsys)
    assert code == EXIT_ORPHANS
    assert f"still running:\n  made, process {orphan} of this machine" in text
    assert "Do not start snakemake yet" in text

    remedy = next(line for line in text.splitlines() if line.startswith("  kill "))
    subprocess.run(remedy.split(), check=True)
    while processes_in(run.folder).jobs:
        assert time.monotonic() < patience
        time.sleep(0.1)
    code, text = look(run, capsys)
    assert code == 0
    assert "gone:\n  made, " in text
    assert "no output" in text
    assert "  snakemake --unlock --cores 1" in text


def test_slurms_jobs_are_known_by_id_while_queued_and_by_comment_while_running(
    run, capsys, tmp_path, monkeypatch
):
    run.mark(SHARD)  # running: its mark has lost the id
    run.mark("results/4_train/raw/loose", job_id="12")
    run.mark("results/4_train/studio/plain", job_id="13")
    run.write("results/4_train/studio/plain/avatar.json")
    here = run.folder
    lines = [
        f"11|RUNNING|{here}|rule_render_wildcards_raw_loose_range_h1.0_r0.5_000000",
        f"12|PENDING|{here}|rule_train_wildcards_raw_loose",
        f"14|RUNNING|{here.parent}|rule_train_wildcards_studio_plain",  # of another folder
    ]
    path = stand_in_for_squeue(tmp_path / "bin", lines="\n".join(lines))
    monkeypatch.setenv("PATH", path)
    before = {path: path.stat().st_mtime_ns for path in run.folder.rglob("*")}
    code, text = look(run, capsys)
    assert code == EXIT_ORPHANS
    assert f"  {SHARD}, SLURM job 11 RUNNING, since " in text
    assert "  results/4_train/raw/loose, SLURM job 12 PENDING, since " in text
    assert "gone:\n  results/4_train/studio/plain, since " in text
    assert sorted(text.split("scancel ")[1].splitlines()[0].split()) == ["11", "12"]
    assert "--cleanup-metadata results/4_train/studio/plain --cores 1" in text
    assert {path: path.stat().st_mtime_ns for path in run.folder.rglob("*")} == before


def test_a_job_of_unknown_output_leaves_no_mark_for_gone(run, capsys, tmp_path, monkeypatch):
    run.mark(SHARD)
    line = f"11|RUNNING|{run.folder}|group_job"
    monkeypatch.setenv("PATH", stand_in_for_squeue(tmp_path / "bin", lines=line))
    code, text = look(run, capsys)
    assert code == EXIT_ORPHANS
    assert "still running:\n  [group_job], SLURM job 11 RUNNING" in text
    assert (
        f"perhaps running, as SLURM cannot be asked here or lists jobs without output:\n  {SHARD}"
        in text
    )
    assert "  scancel 11\n" in text


def test_a_run_started_twice_shows_both_jobs(run, capsys, tmp_path, monkeypatch):
    run.mark("results/4_train/raw/loose")
    lines = [f"{n}|RUNNING|{run.folder}|rule_train_wildcards_raw_loose" for n in (7, 8)]
    monkeypatch.setenv("PATH", stand_in_for_squeue(tmp_path / "bin", lines="\n".join(lines)))
    _, text = look(run, capsys)
    assert "raw/loose, SLURM job 7 RUNNING, SLURM job 8 RUNNING, since " in text
    assert "  scancel 7 8\n" in text


@pytest.mark.parametrize("logs", [".snakemake/slurm_logs", "logs/slurm"])
@pytest.mark.parametrize("installed", [True, False])
def test_a_queue_that_does_not_answer_is_not_taken_for_empty(
    run, capsys, tmp_path, monkeypatch, installed, logs
):
    run.mark(SHARD)
    run.write(f"{logs}/rule_render/11.log")  # SLURM was used here
    path = stand_in_for_squeue(tmp_path / "bin", error="Unable to contact controller", code=1)
    monkeypatch.setenv("PATH", path if installed else str(tmp_path))
    code, text = look(run, capsys)
    assert code == EXIT_ORPHANS
    assert "perhaps running, as SLURM cannot be asked here" in text


def test_a_job_of_this_machine_needs_no_mark(run, capsys):
    process = run.start(SHARD)
    code, text = look(run, capsys)
    assert code == EXIT_ORPHANS
    assert f"  {SHARD}, process {process.pid} of this machine, not marked" in text
    assert f"  kill {process.pid}\n" in text


def test_the_run_script_starts_nothing_beside_orphans(run):
    process = run.start(SHARD)
    shutil.copytree(ROOT / "workflow", run.folder / "workflow")
    environment = os.environ | {
        "NTOP_LOCK_WAIT_S": "1",
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    done = subprocess.run(
        ["workflow/run.sh", "test", "1"],
        cwd=run.folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout == ""
    assert f"  kill {process.pid}\n" in done.stderr
    assert not (run.folder / ".snakemake").exists()


def test_long_names_are_put_together_and_other_files_passed_over(run):
    long = "results/" + "a/" * 150 + "end"
    run.mark(long, job_id="7")
    run.write(".snakemake/incomplete/migration_underway")
    run.write(".snakemake/incomplete/cmVzdWx0cy9h", '{"external')  # half written
    (mark,) = read_marks(run.folder)
    assert (mark.output, mark.job_id) == (long, "7")


def test_snakemake_writes_the_marks_that_we_read(run):
    from snakemake.persistence.file import FilePersistence  # its own writer is the specification

    keys = ["results/1_capture/raw/loose", "results/" + "b/" * 200 + "c", "a b/ü?>"]
    persistence = FilePersistence(nolock=True, path=run.folder / ".snakemake")
    for number, key in enumerate(keys):
        persistence._mark_incomplete(key, str(number))
    assert {mark.output: mark.job_id for mark in read_marks(run.folder)} == {
        key: str(number) for number, key in enumerate(keys)
    }


def test_a_machine_without_slurm_is_not_asked_about_it(run, capsys, tmp_path, monkeypatch):
    run.mark(SHARD)
    monkeypatch.setenv("PATH", str(tmp_path))
    code, text = look(run, capsys)
    assert code == 0
    assert f"gone:\n  {SHARD}, since " in text


@pytest.mark.parametrize(
    ("output", "comment"),
    [
        (SHARD, "rule_render_wildcards_raw_loose_range_h1.0_r0.5_000000"),
        ("results/6_annotate/a/b/c/d/000000.parquet", "rule_annotate_wildcards_a_b_c_d_000000"),
        ("data/packages/pose2sim", None),
    ],
)
def test_outputs_are_described_as_the_slurm_plugin_does(output, comment):
    assert slurm_comment(output) == comment


def test_snakemake_is_known_by_its_command_line():
    assert is_snakemake(["/env/bin/python3", "/env/bin/snakemake", "--cores", "2"])
    assert is_snakemake(["python", "-m", "snakemake"])
    assert is_snakemake(["python3.11", "-u", "/env/bin/snakemake"])
    assert not is_snakemake(["vi", "snakemake"])
    assert not is_snakemake([])
