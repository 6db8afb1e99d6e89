"""One vocabulary in five places, and set-up files that agree with each other."""

import importlib
import inspect
import re
import tomllib
from pathlib import Path

import pytest
import yaml

from ntop.config.sections import STAGE_SECTIONS
from ntop.config.whole import Config
from ntop.stages import STAGES

ROOT = Path(__file__).parents[1]


def test_stage_names_are_the_same_in_rules_modules_and_config():
    names = [name for _, name, _ in STAGES]
    modules = sorted(p.stem for p in (ROOT / "ntop/stages").glob("s[0-9]_*.py"))
    rules = sorted(p.stem for p in (ROOT / "workflow/rules").glob("[1-9]_*.smk"))
    assert modules == [f"s{number}_{name}" for number, name, _ in STAGES]
    assert rules == [f"{number}_{name}" for number, name, _ in STAGES]
    assert list(STAGE_SECTIONS) == names
    assert [key for key in Config.model_fields if key in names] == names


@pytest.mark.parametrize(("number", "name"), [(n, name) for n, name, _ in STAGES])
def test_every_flag_of_a_rule_is_a_parameter_of_its_stage(number, name):
    text = (ROOT / f"workflow/rules/{number}_{name}.smk").read_text()
    command = text[text.index("shell:") :]
    flags = {flag.replace("-", "_") for flag in re.findall(r"--([a-z0-9-]+)", command)}
    main = importlib.import_module(f"ntop.stages.s{number}_{name}").main
    parameters = inspect.signature(main).parameters
    required = {n for n, p in parameters.items() if p.default is inspect.Parameter.empty}
    assert required <= flags <= set(parameters)


def test_the_conda_file_only_installs_the_package():
    conda = yaml.safe_load((ROOT / "environment.yml").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert conda["dependencies"][0] == f"python {project['requires-python']}"
    assert conda["dependencies"][-1] == {"pip": ["-e ."]}


def test_every_dependency_is_pinned_in_the_constraints():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["dev"] + extras["slurm"]
    pins = (ROOT / "constraints.txt").read_text().lower().splitlines()
    pinned = {line.split("==")[0].replace("_", "-") for line in pins if "==" in line}
    assert {re.split(r"[<>=]", name)[0].lower() for name in wanted} <= pinned


@pytest.mark.parametrize("name", ["default", "slurm"])
def test_every_line_of_a_profile_is_explained(name):
    profile = yaml.safe_load((ROOT / f"profiles/{name}/config.yaml").read_text())
    page = (ROOT / "docs/running-on-slurm.md").read_text()
    rows = page.partition(f"| line of `profiles/{name}/config.yaml` |")[2].partition("\n\n")[0]
    explained = [line.split("|")[1] for line in rows.splitlines() if line.startswith("| `")]
    for key, value in profile.items():
        [cell] = [cell for cell in explained if re.search(rf"`{key}\b(?!-)", cell)]
        if not isinstance(value, dict):
            shown = f"[{', '.join(value)}]" if isinstance(value, list) else str(value).lower()
            assert f"`{key}: {shown}`" in cell


def test_no_machine_path_or_host_is_committed():
    hosts = "|".join(("pypi\\.o" + "rg", "pythonho" + "sted", "registry\\.np" + "mjs"))
    forbidden = re.compile(rf"(?<![\w./-])/(work|farm|root|home)/|{hosts}")
    for path in ROOT.rglob("*"):
        parts = path.relative_to(ROOT).parts
        if parts[0] in {".git", ".venv", "results", "data", "logs", ".snakemake"}:
            continue
        if path.suffix in {".py", ".md", ".smk", ".yaml", ".toml", ".sh", ".txt", ".json"}:
            assert not forbidden.search(path.read_text()), path
