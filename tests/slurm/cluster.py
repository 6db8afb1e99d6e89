"""A throw-away SLURM on this machine, and projects whose heads submit to it."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.workflow.project import Project

HERE = Path(__file__).parent
ADMIN_PATH = "/usr/local/sbin:/usr/sbin:/sbin"  # daemons lie there, not on every user's PATH
PATIENCE_S = 300.0
# What the tests change of the shipped profile: patience, and what needs accounting.
QUICK = {
    "retries": 1,
    "latency-wait": 5,
    "slurm-init-seconds-before-status-checks": 15,  # about a toy job; later checks are rarer
    "slurm-status-command": "squeue",
    "slurm-efficiency-report": False,
}


def slurm_is_installed() -> bool:
    return shutil.which("slurmctld", path=f"{os.environ['PATH']}:{ADMIN_PATH}") is not None


def wait_until(done: Callable[[], object], what: str) -> None:
    """Poll until `done()` is true; a test fails with `what` it waited for."""
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end, f"waited {PATIENCE_S:.0f} s in vain for {what}"
        time.sleep(0.1)


@dataclass(frozen=True)
class Job:
    """A line of squeue; `comment` holds rule and wildcards."""

    job_id: str
    state: str
    comment: str


class Cluster:
    """One node, eight CPUs, two fake GPUs; partitions cpu, gpu, and urgent, which preempts them."""

    def __init__(self) -> None:
        # munge refuses a socket below a folder that others cannot enter; socket paths are short
        self.root = Path(tempfile.mkdtemp(prefix="ntop-slurm-"))
        self.root.chmod(0o711)
        controller, node = free_ports(2)
        self._environment = os.environ | {
            "PATH": f"{os.environ['PATH']}:{ADMIN_PATH}",
            "SLURM_CONF": str(self.root / "etc/slurm.conf"),
            "SLURM_IT": str(self.root),
            "CTLD_PORT": str(controller),
            "SLURMD_PORT": str(node),
            "MEM": "64000",  # advertised only: memory is not enforced
        }

    def visible_to(self, environment: dict[str, str]) -> dict[str, str]:
        """`environment` for a process that submits: the srun of this cluster comes first."""
        return environment | {
            "PATH": f"{self.root}/bin:{environment['PATH']}",
            "SLURM_CONF": self._environment["SLURM_CONF"],
        }

    def up(self) -> None:
        """Start the daemons; a test fails with their words."""
        log = self.root / "up.log"
        assert self._script("slurm_up.sh", log) == 0, log.read_text()

    def down(self) -> None:
        """Stop the daemons and remove every trace."""
        self._script("slurm_down.sh", self.root / "down.log")
        shutil.rmtree(self.root, ignore_errors=True)

    def _script(self, name: str, log: Path) -> int:
        with log.open("w") as out:  # a file: daemons would keep a pipe open for ever
            return subprocess.run(
                [HERE / name],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                check=False,
            ).returncode

    def ask(self, *words: str) -> str:
        """What a SLURM command prints."""
        return subprocess.run(
            words, env=self._environment, capture_output=True, text=True, check=True
        ).stdout.strip()

    def jobs(self, *words: str) -> list[Job]:
        """Jobs that squeue lists: without `words` those that have not ended."""
        lines = self.ask("squeue", "-h", "-o", "%i|%T|%k", *words).splitlines()
        return [Job(*line.split("|", maxsplit=2)) for line in lines]

    def preempt_all(self) -> None:
        """Submit an urgent job that needs the whole node for a moment."""
        self.ask("sbatch", "-p", "urgent", "--exclusive", "-o", "/dev/null", "--wrap", "sleep 1")


def free_ports(count: int) -> list[int]:
    """Ports of the loopback that nobody listens on."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


class SlurmProject(Project):
    """A copy of the workflow whose head submits to the cluster with the shipped profile."""

    def __init__(self, folder: Path, cluster: Cluster) -> None:
        folder.mkdir(exist_ok=True)
        super().__init__(folder)
        shutil.copy(HERE / "toy.smk", folder)
        self.environment = cluster.visible_to(self.environment)
        self.heads: list[subprocess.Popen[str]] = []
        self.use_profile()

    def use_profile(self, *, stages: dict[str, dict[str, Any]] | None = None, **keys: Any) -> None:
        """The shipped profile with the tests' patience, and what one test needs on top."""
        shipped = yaml.safe_load((self.folder / "profiles/slurm/config.yaml").read_text())
        values = shipped | QUICK | keys
        for stage, resources in (stages or {}).items():
            values["set-resources"].setdefault(stage, {}).update(resources)
        path = self.folder / "profiles/test/config.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(yaml.safe_dump(values))

    def head(self, *words: str) -> subprocess.Popen[str]:
        """Start Snakemake on the head; its words go to `head.log`."""
        with (self.folder / "head.log").open("a") as log:
            head = subprocess.Popen(
                ["snakemake", "--profile", "profiles/test", *words],
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                # a test run in the background ignores SIGINT, and its children would inherit that
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
        self.heads.append(head)
        return head

    def end(self) -> None:
        """Kill the heads that a failed test left."""
        for head in self.heads:
            head.kill()
            head.wait()

    def submit(self, *words: str) -> int:
        """Run the head to its end; returns its exit code."""
        return self.head(*words).wait(timeout=2 * PATIENCE_S)

    def said(self) -> str:
        """What the heads of this project have printed."""
        return (self.folder / "head.log").read_text()
