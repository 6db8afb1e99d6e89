"""The tiny campaign through SLURM: undisturbed, preempted, and cut into time slices."""

import re
import shutil
from pathlib import Path

import psutil
import pytest

from tests.slurm.cluster import PATIENCE_S, SlurmProject, wait_until
from tests.workflow.project import TEST_CONFIG

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("slurm")]

AVATAR = "results/4_train/studio/plain"
SHARD = "studio/plain/sit/h1.2_r1.0/000000"
DATASET = "results/7_assemble/test"


@pytest.fixture
def resumed(campaign, project):
    """The finished campaign in another folder, to take results away from."""
    shutil.copytree(campaign.folder, project.folder, dirs_exist_ok=True)
    (project.folder / "head.log").unlink()
    project.use_profile()
    return project


def process_working_on(folder: Path, work: str) -> psutil.Process:
    """The stage's process: not a shell or Snakemake around it."""
    for process in psutil.process_iter(["cmdline", "cwd"]):
        words = process.info["cmdline"] or []
        if process.info["cwd"] == str(folder) and work in words and "--work" in words:
            return process
    raise AssertionError(f"no process works on {work} in {folder}")


def freeze_at(project: SlurmProject, work: str, piece: str) -> None:
    """Freeze the process that fills `work` once `piece` is there: no test depends on speed.

    SLURM wakes a job that it sends SIGTERM.
    """
    path = project.folder / work / "content" / piece
    wait_until(path.exists, f"{path}\n{project.said()}")
    process_working_on(project.folder, work).suspend()


def test_the_whole_campaign_runs_through_slurm_to_its_dataset(campaign):
    assert (campaign.dataset() / "manifest.parquet").is_file()
    assert (campaign.folder / "results/8_evaluate/test/report.html").is_file()
    submitted = len(re.findall(r"submitted with SLURM jobid", campaign.said()))
    assert submitted == 2 + 1 + 1 + 2 + 6 + 6 + 1 + 1  # the eight stages; only `all` stays here
    assert campaign.submit("-n", *TEST_CONFIG) == 0
    assert "Nothing to be done" in campaign.said()


def test_a_preempted_shard_goes_on_at_its_finished_sets(campaign, resumed, cluster):
    shard = resumed.folder / "results/5_render" / SHARD
    for path in (shard, resumed.dataset()):
        shutil.rmtree(path)
    work = f"results/work/5_render/{SHARD}"
    head = resumed.head("results/7_assemble/test", *TEST_CONFIG)
    freeze_at(resumed, work, "000000")
    finished = inodes(resumed.folder / work / "content/000000")
    [job] = [job for job in cluster.jobs() if job.comment.startswith("rule_render")]
    cluster.preempt_all()
    assert head.wait(timeout=PATIENCE_S) == 0, resumed.said()
    assert "Restarts=1" in cluster.ask("scontrol", "show", "job", job.job_id).split()
    assert "Trying to restart" not in resumed.said()  # SLURM's requeue costs no attempt
    assert finished.items() <= inodes(shard).items()  # the same files, not the same pictures again
    assert resumed.digest() == campaign.digest()


def inodes(folder: Path) -> dict[str, int]:
    """The picture files of a folder, by name."""
    return {path.name: path.stat().st_ino for path in folder.rglob("*.png")}


def test_a_training_at_its_time_limit_goes_on_in_the_next_attempt(campaign, resumed):
    shutil.rmtree(resumed.folder / AVATAR)
    # SLURM looks at the clock every half minute: the signal comes 30 to 60 s after the start, on a
    # busy machine perhaps before the training has begun, hence the spare attempts
    soon = {"runtime": 2, "slurm_extra": "'--signal=TERM@60'"}
    resumed.use_profile(stages={"train": soon}, retries=3)
    head = resumed.head(AVATAR, *TEST_CONFIG)
    freeze_at(resumed, "results/work/4_train/studio/plain", "checkpoint.safetensors")
    assert head.wait(timeout=PATIENCE_S) == 0, resumed.said()
    assert "the same command continues there" in resumed.said()
    assert "Trying to restart" in resumed.said()
    name = f"{AVATAR}/avatar.safetensors"
    assert (resumed.folder / name).read_bytes() == (campaign.folder / name).read_bytes()
