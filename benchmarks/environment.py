"""What a benchmark ran on: machine, versions, commit. Every result file carries it."""

import json
import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
PACKAGES = ("numpy", "numba", "torch", "opencv-contrib-python-headless", "pyarrow", "snakemake")


def environment() -> dict[str, Any]:
    """Processor, cores, memory (GB), package versions and the commit (`-dirty` if changed)."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(memory, 1),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "commit": _git("describe", "--always", "--dirty", "--abbrev=12"),
    }


def write_result(name: str, values: dict[str, Any]) -> Path:
    """Write `benchmarks/results/{name}.json`: the environment and the figures."""
    path = RESULTS / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"environment": environment(), **values}, indent=1) + "\n")
    return path


def _cpu_model() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((s.split(":", 1)[1].strip() for s in lines if s.startswith("model name")), "")


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True
    ).stdout.strip()
