"""A copy of the workflow in a folder of its own, in which Snakemake runs."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEST_CONFIG = ["--configfile", "config/test.yaml"]


class Project:
    """A copy of the workflow (not of the package) in which Snakemake runs."""

    def __init__(self, folder: Path) -> None:
        self._use(folder)
        for name in ("workflow", "profiles", "config"):
            shutil.copytree(ROOT / name, folder / name)
        for name in ("Snakefile", "environment.yml"):
            shutil.copy(ROOT / name, folder)

    @classmethod
    def existing(cls, folder: Path) -> "Project":
        """A project that has been made, and perhaps run, before."""
        project = cls.__new__(cls)
        project._use(folder)
        return project

    def _use(self, folder: Path) -> None:
        self.folder = folder
        self.environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        }

    def snakemake(self, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["snakemake", "--cores", "2", *words],
            cwd=self.folder,
            env=self.environment | environment,
            capture_output=True,
            text=True,
            check=False,
        )

    def command(self) -> list[str]:
        """What `make demo` runs, on the tiny configuration."""
        return ["workflow/run.sh", "test", "2", *TEST_CONFIG]

    def run(self) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.command(),
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )

    def dataset(self) -> Path:
        return self.folder / "results/7_assemble/test"

    def digest(self) -> dict[str, str]:
        """SHA-256 of every file of the dataset."""
        return {
            str(path.relative_to(self.dataset())): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(self.dataset().rglob("*"))
            if path.is_file()
        }
