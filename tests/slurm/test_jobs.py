"""What single jobs meet on a cluster: failure, GPUs, and a head that is told to stop."""

import re
import signal
from pathlib import Path

import psutil
import pytest

from tests.slurm.cluster import wait_until
from tests.workflow.project import TEST_CONFIG

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("slurm")]

SHARD = "studio/plain/sit/h1.2_r1.0/000000"


def test_failing_jobs_leave_readable_logs_whose_paths_are_named(project):
    (project.folder / "results/5_render" / SHARD).mkdir(parents=True)  # and nothing in it
    targets = [f"results/6_annotate/{SHARD}.parquet", "data/packages/no_such_package"]
    words = ["--allowed-rules", "annotate", "fetch", "--retries", "0", *TEST_CONFIG]
    assert project.submit(*targets, *words) == 1
    log = f"logs/6_annotate/{SHARD}.log"
    text = (project.folder / log).read_text()
    assert "ntop annotate:" in text
    assert "Traceback" not in text
    said = project.said()
    assert f"log: {log}" in said
    assert text.strip() in said  # show-failed-logs: nobody has to open it
    [of_slurm] = re.findall(r"submitted with SLURM jobid \d+ \(log: (\S+)\)", said)
    assert Path(of_slurm).is_relative_to(project.folder / "logs/slurm")
    assert "annotate" in Path(of_slurm).read_text()
    assert "localrule fetch:" in said  # beside the head: compute nodes seldom reach the internet
    assert "log: logs/0_fetch/no_such_package.log" in said


def test_two_jobs_never_share_a_gpu_and_others_see_none(project):
    words = ["--snakefile", "toy.smk", "gpu/a.txt", "gpu/b.txt", "cpu.txt"]
    assert project.submit(*words) == 0, project.said()
    seen = {n: (project.folder / f"gpu/{n}.txt").read_text().strip() for n in "ab"}
    assert sorted(seen.values()) == ["0", "1"]
    assert (project.folder / "cpu.txt").read_text().strip() == "none"


def test_an_interrupted_head_cancels_its_jobs_and_leaves_no_lock(project, cluster):
    words = ["--snakefile", "toy.smk", "endless/a.txt", "endless/b.txt"]
    head = project.head(*words)
    begun = [project.folder / f"endless/{n}.begun" for n in "ab"]
    wait_until(lambda: all(path.exists() for path in begun), "both jobs to run")
    mine = {job.job_id for job in cluster.jobs()}
    head.send_signal(signal.SIGINT)  # Ctrl-C
    assert head.wait(timeout=60) == 1, project.said()
    wait_until(lambda: not mine & {job.job_id for job in cluster.jobs()}, "the jobs to be gone")
    ended = {job.job_id: job.state for job in cluster.jobs("-t", "all")}
    assert {ended[job_id] for job_id in mine} == {"CANCELLED"}
    alive = [p for p in psutil.process_iter(["cwd", "name"]) if p.info["name"] == "sleep"]
    assert str(project.folder) not in {p.info["cwd"] for p in alive}
    assert project.submit(*words, "-n") == 0, project.said()  # neither locked nor incomplete
