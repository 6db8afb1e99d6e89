"""What is alive: processes of this machine, jobs of the cluster, marks of Snakemake. Only looks.

Snakemake marks every output it works on with a file below `.snakemake/incomplete`: its name is the
output in base64, its content holds the cluster's job id. A mark goes away when its job ends *and*
the head process is there to notice. On SLURM the id is there only while the job is queued: on its
node Snakemake starts once more and writes the mark anew, without it. A running job is found by its
working directory and its comment, which names the rule and the wildcards.
"""

import base64
import binascii
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import psutil

MARKS = ".snakemake/incomplete"
SLURM_LOGS = (".snakemake/slurm_logs", "logs/slurm")  # the plugin's own, our profile's
QUEUED = frozenset({"PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "SPECIAL_EXIT"})


@dataclass(frozen=True)
class Mark:
    """An output that a Snakemake process worked on when it was last heard of."""

    output: str
    job_id: str | None  # of the cluster; None if the job began, or is not of a cluster
    since: float  # seconds since the epoch


@dataclass(frozen=True)
class Processes:
    """What runs in one working directory, on this machine."""

    heads: tuple[int, ...]  # process ids of Snakemake itself
    jobs: dict[str, int]  # output -> process id of the stage that makes it


@dataclass(frozen=True)
class SlurmJob:
    """A job that SLURM has queued or runs."""

    job_id: str
    state: str  # in SLURM's words
    comment: str  # `rule_{rule}_wildcards_{values}` if it is Snakemake's


def read_marks(directory: Path) -> list[Mark]:
    """Snakemake's marks, by output; a file that is no mark is passed over."""
    folder = directory / MARKS
    marks = []
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        # names too long for a file are cut into folders, each with an @ before it
        parts = path.relative_to(folder).parts
        name = "".join(part.removeprefix("@") for part in parts)
        try:
            output = base64.b64decode(name, altchars=b"-_", validate=True).decode()
            since, record = path.stat().st_mtime, json.loads(path.read_text())
        except (binascii.Error, UnicodeDecodeError, json.JSONDecodeError, FileNotFoundError):
            continue  # no base64, half written, or its job has just ended
        job_id = record.get("external_jobid") if isinstance(record, dict) else None
        marks.append(Mark(output, None if job_id is None else str(job_id), since))
    return sorted(marks, key=lambda mark: mark.output)


def is_locked(directory: Path) -> bool:
    """Whether a Snakemake process holds the directory, or was killed while it did."""
    return any((directory / ".snakemake/locks").glob("*.lock"))


def processes_in(directory: Path) -> Processes:
    """Snakemake and stages that run in `directory`, as far as this user may see them."""
    heads, jobs = [], {}
    place = str(directory.resolve())
    for process in psutil.process_iter():
        try:
            words = process.cmdline()
            if not words or process.cwd() != place:
                continue
        except (psutil.Error, OSError):
            continue  # ended meanwhile, or another user's
        if "--out" in words[:-1]:  # every stage names its output so, and only its output
            jobs[words[words.index("--out") + 1]] = process.pid
        # on a cluster's node Snakemake starts itself once more, for a single job
        elif is_snakemake(words) and "--target-jobs" not in words:
            heads.append(process.pid)
    return Processes(tuple(sorted(heads)), jobs)


def is_snakemake(words: list[str]) -> bool:
    """Whether a command line is Snakemake's, as a script or as `python -m snakemake`."""
    names = [Path(word).name for word in words[:4]]
    return names[:1] == ["snakemake"] or (
        names[:1] != [] and names[0].startswith("python") and "snakemake" in names
    )


def slurm_queue(directory: Path, marks: list[Mark]) -> list[SlurmJob] | None:
    """Jobs of SLURM that belong to `directory`; None if some may exist and SLURM cannot be asked.

    Asks for the whole queue: another user may have started the run in a shared folder.
    """
    place = str(directory.resolve())
    was_used = any((directory / folder).is_dir() for folder in SLURM_LOGS)
    was_used = was_used or any(mark.job_id for mark in marks)
    silent = None if was_used else []
    if shutil.which("squeue") is None:
        return silent
    words = ["squeue", "--noheader", "--array", "--format=%i|%T|%Z|%k"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return silent
    rows = (line.strip().split("|", 3) for line in done.stdout.splitlines())
    return [SlurmJob(row[0], row[1], row[3]) for row in rows if row[2:3] == [place]]


def jobs_of(mark: Mark, queue: list[SlurmJob]) -> list[SlurmJob]:
    """The jobs that make a marked output: more than one if a run was started twice."""
    comment = slurm_comment(mark.output)
    return [job for job in queue if job.job_id == mark.job_id or job.comment == comment]


def slurm_comment(output: str) -> str | None:
    """How the SLURM plugin describes the job of a stage's output; None for other outputs."""
    found = re.fullmatch(r"results/[0-9]_([a-z]+)/(.+?)(\.parquet)?", output)
    return found and f"rule_{found[1]}_wildcards_{found[2].replace('/', '_')}"
