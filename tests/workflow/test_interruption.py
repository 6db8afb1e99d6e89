"""kill -9 of everything at random moments, then the same command again: the same bytes."""

import contextlib
import fcntl
import random
import signal
import subprocess
import time

import psutil
import pytest

KILLS_PER_STAGE = 3
PATIENCE_S = 240

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("campaign")]


def kill_during(project, stage: str, delay_s: float) -> bool:
    """Start the workflow and kill its whole process group `delay_s` into a job of `stage`.

    Returns whether it was still running then.
    """
    logs = project.folder / "logs" / stage
    started = time.time()
    process = subprocess.Popen(
        project.command(),
        cwd=project.folder,
        env=project.environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    while process.poll() is None and time.time() - started < PATIENCE_S:
        if any(path.stat().st_mtime > started for path in logs.rglob("*.log")):
            break
        time.sleep(0.05)
    time.sleep(delay_s)
    running = process.poll() is None
    if running:
        # the jobs have process groups of their own: whoever pulls the plug stops them all
        family = psutil.Process(process.pid)
        for member in [family, *family.children(recursive=True)]:
            with contextlib.suppress(psutil.NoSuchProcess):
                member.send_signal(signal.SIGKILL)
        process.wait()
    return running


def test_a_killed_campaign_ends_with_the_same_dataset(campaign, project):
    generator = random.Random(20261123)
    killed = []
    for stage in ("4_train", "5_render"):
        for _ in range(KILLS_PER_STAGE):
            killed.append(kill_during(project, stage, generator.uniform(0, 4)))
    assert sum(killed) >= 2 * KILLS_PER_STAGE - 1, killed
    done = project.run()
    assert done.returncode == 0, done.stdout + done.stderr
    assert project.digest() == campaign.digest()
    leftovers = [p for p in (project.folder / "results").rglob(".*") if p.name != ".run.lock"
                 and p.name != ".snakemake_timestamp"]  # fmt: skip
    assert leftovers == []


def test_a_second_run_beside_a_running_one_is_refused(project):
    (project.folder / "results").mkdir()
    project.environment["NTOP_LOCK_WAIT_S"] = "1"
    with (project.folder / "results/.run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = project.run()
    assert done.returncode != 0
    assert "another run works" in done.stderr
