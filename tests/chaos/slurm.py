"""Disturbances through a real SLURM: requeue, preempt, time out, scancel, a killed head."""

import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.chaos.trial import DefeatError, Hit, Outcome, difference
from tests.chaos.workspace import OUTPUTS, PATIENCE_S, WORK, Workspace
from tests.slurm.cluster import Cluster, Job, SlurmProject, wait_until
from tests.workflow.project import TEST_CONFIG, Project

TARGET = ["results/7_assemble/test", *TEST_CONFIG]


class SlurmWorkspace(SlurmProject, Workspace):
    """A copy of the finished campaign whose head submits to the cluster."""

    def __init__(self, finished: Project, folder: Path, cluster: Cluster) -> None:
        Workspace.__init__(self, finished, folder)
        self.environment = cluster.visible_to(self.environment)
        self.cluster = cluster
        self.use_profile()

    def job(self, stage: str) -> Job:
        """The running job of a stage."""

        def running() -> list[Job]:
            mine = [job for job in self.cluster.jobs() if job.comment.startswith(f"rule_{stage}_")]
            return [job for job in mine if job.state == "RUNNING"]

        wait_until(running, f"a job of {stage}: {self.said()}")
        return running()[0]

    def said(self) -> str:
        """What the heads have printed."""
        path = self.folder / "head.log"
        return path.read_text() if path.exists() else ""


def render_begun(space: SlurmWorkspace, chance: random.Random) -> tuple[subprocess.Popen, Job, str]:
    """Start a head and wait for a random moment of the shard."""
    space.undo("render")
    head = space.head(*TARGET)
    sets = chance.randint(0, 2)
    content = space.folder / WORK["render"] / "content"
    wait_until(content.exists if not sets else lambda: space.sets_done() >= sets, "sets")
    delay_s = chance.uniform(0, 0.5)
    time.sleep(delay_s)
    return head, space.job("render"), f"{sets} of 3 sets and {delay_s:.2f} s later"


def requeue(space: SlurmWorkspace, chance: random.Random) -> Hit:
    """An administrator requeues the job: it comes back under its number and goes on."""
    head, job, after = render_begun(space, chance)
    space.cluster.ask("scontrol", "requeue", job.job_id)
    code = head.wait(timeout=PATIENCE_S)
    return Hit(f"scontrol requeue after {after}; the run ended with {code}")


def preempt(space: SlurmWorkspace, chance: random.Random) -> Hit:
    """An urgent job takes the node."""
    head, _, after = render_begun(space, chance)
    space.cluster.preempt_all()
    code = head.wait(timeout=PATIENCE_S)
    return Hit(f"preempted after {after}; the run ended with {code}")


def cancelled(space: SlurmWorkspace, chance: random.Random) -> Hit:
    """A colleague's scancel: the attempt is lost, its sets are not."""
    head, job, after = render_begun(space, chance)
    space.cluster.ask("scancel", job.job_id)
    code = head.wait(timeout=PATIENCE_S)
    return Hit(f"scancel after {after}; the run ended with {code}")


def timed_out(space: SlurmWorkspace, chance: random.Random) -> Hit:
    """The job meets its time limit, frozen as if it were slow, and goes on in the next attempt."""
    space.use_profile(
        stages={"render": {"runtime": 1, "slurm_extra": "'--signal=TERM@30'"}}, retries=3
    )
    head, _, after = render_begun(space, chance)
    for process in space.processes(lambda words: OUTPUTS["render"] in words and "--work" in words):
        process.suspend()
    code = head.wait(timeout=PATIENCE_S)
    return Hit(f"frozen until its time limit after {after}; the run ended with {code}")


def head_killed(space: SlurmWorkspace, chance: random.Random) -> Hit:
    """kill -9 of the head: its jobs live on, `ntop orphans` says what to do."""
    head, job, after = render_begun(space, chance)
    head.send_signal(signal.SIGKILL)
    head.wait()
    said = orphans(space)
    if f"scancel {job.job_id}" not in said:
        raise DefeatError(f"ntop orphans does not name job {job.job_id}: {said}")
    way = chance.choice(["scancel", "wait"])
    if way == "scancel":
        space.cluster.ask("scancel", job.job_id)
    wait_until(lambda: not orphans(space), "the orphans to end")
    space.snakemake("--unlock", *TEST_CONFIG)
    return Hit(f"SIGKILL to the head after {after}; ntop orphans: {way}")


def orphans(space: SlurmWorkspace) -> str:
    """What `ntop orphans` says while something runs; empty when nothing does."""
    done = subprocess.run(
        ["ntop", "orphans"], cwd=space.folder, env=space.environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout if done.returncode == 3 else ""


SlurmStrike = Callable[[SlurmWorkspace, random.Random], Hit]
SLURM_KINDS: list[tuple[str, SlurmStrike]] = [
    ("SLURM: requeue", requeue),
    ("SLURM: preempt", preempt),
    ("SLURM: time out", timed_out),
    ("SLURM: scancel", cancelled),
    ("SLURM: kill -9 the head", head_killed),
    ("SLURM: requeue", requeue),
]


def slurm_trials(
    kinds: list[tuple[str, SlurmStrike]], seed: int, first: int, *, finished: Project, place: Path
) -> Iterator[Outcome]:
    """Trials on a throw-away cluster, one after the other."""
    if not kinds:
        return
    cluster = Cluster()
    try:
        cluster.up()
        for index, (name, strike) in enumerate(kinds):
            number, own = first + index, seed + 1000 + index
            space = SlurmWorkspace(finished, place / f"trial{number:03d}", cluster)
            try:
                yield slurm_trial(number, own, name, strike, space=space, finished=finished)
            finally:
                space.end()
                space.remove()
    finally:
        cluster.down()


def slurm_trial(
    number: int,
    seed: int,
    name: str,
    strike: SlurmStrike,
    *,
    space: SlurmWorkspace,
    finished: Project,
) -> Outcome:
    """Disturb, submit again, compare."""
    survived, hit, started = True, Hit("not hit"), time.monotonic()
    try:
        hit = strike(space, random.Random(seed))
        started = time.monotonic()
        again = space.head(*TARGET).wait(timeout=PATIENCE_S)
        outcome = "identical after the same command"
        if again != 0 or space.digest() != finished.digest():
            survived, outcome = False, f"LOST: {again}, {difference(space, finished)}"
    except (AssertionError, DefeatError, subprocess.TimeoutExpired) as error:
        survived, outcome = False, f"LOST: {error}"
    seconds = round(time.monotonic() - started, 1)
    return Outcome(
        number=number,
        seed=seed,
        disturbance=name,
        stage="render",
        hit=hit.what,
        outcome=outcome,
        survived=survived,
        rerun_s=seconds,
    )
