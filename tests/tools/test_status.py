"""What `ntop status` says of a half-finished run: real files, real processes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ntop import cli
from ntop.config.files import merge, read_files
from ntop.config.plan import planned_jobs
from ntop.config.run import load_files
from ntop.conventions import ConfigError
from ntop.tools.status import brief, describe, survey, table
from tests.tools.run_folder import ROOT, RunFolder, stand_in_for_squeue

TEST_CONFIG = Path("config/test.yaml")
SHARD = "5_render/raw/loose/range"


@pytest.fixture
def run(tmp_path):
    run = RunFolder(tmp_path / "run")
    yield run
    run.end()


def jobs_of(run: RunFolder):
    """Planned jobs by stage folder and key."""
    return {job.name: job for job in planned_jobs(load_test(run))}


def load_test(run: RunFolder):
    return load_files([run.folder / TEST_CONFIG], directory=run.folder)


def look(run: RunFolder):
    return survey([run.folder / TEST_CONFIG], directory=run.folder)


def stage(summary, name: str):
    found = next(item for item in summary.stages if item.name == name)
    return found.done, found.running, found.failed, found.remaining


@pytest.fixture
def half(run):
    """One actor's shards: done, half finished, failed, stopped; the other actor's are waiting."""
    jobs = jobs_of(run)
    for name, job in jobs.items():
        if job.stage in {"capture", "mask", "fit", "train"}:
            run.finish(job, seconds=20)
        if name == f"{SHARD}/h1.2_r1.0/000000":
            run.finish(job, seconds=30)
    half = jobs[f"{SHARD}/h1.2_r1.0/000075"]
    assert half.frames == (75,)
    partial = jobs[f"{SHARD}/h1.0_r0.5/000000"]
    assert partial.frames == (0, 25, 50)
    for name in ("000000", "000025", ".000050.partial"):
        run.write(f"{partial.work}/content/{name}/renders.parquet")
    run.write(partial.log, "set 2/3, 3.0 views/s, 0.1 min left\nstopped after 2 of 3 sets; "
              "run again to go on\n")  # fmt: skip
    run.write(half.log, "one\n\ntwo\nntop render: the avatar is not readable\n")
    return run


def test_a_half_finished_run_is_counted_job_by_job(half):
    summary = look(half)
    assert stage(summary, "train") == (2, 0, 0, 0)
    assert stage(summary, "render") == (1, 0, 1, 4)  # one stopped, three waiting
    assert stage(summary, "annotate") == (0, 0, 0, 6)
    assert (summary.sets_done, summary.sets_planned) == (3 + 2, 14)
    assert (summary.images_done, summary.images_planned) == (45, 126)


def test_pace_and_time_left_come_from_the_finished_jobs(half):
    summary = look(half)
    render = next(item for item in summary.stages if item.name == "render")
    assert render.seconds_per_unit == 10  # 30 s for three sets
    assert render.hours_left == pytest.approx((14 - 5) * 10 / 3600)
    assert summary.images_per_s == pytest.approx(0.9)
    assert summary.unknown_pace == ("annotate", "assemble", "evaluate")
    assert summary.hours_left == pytest.approx(render.hours_left)  # one job at once


def test_before_the_first_shard_the_pace_comes_from_a_log(run):
    job = jobs_of(run)[f"{SHARD}/h1.0_r0.5/000000"]
    run.write(job.log, "set 1/3, 4.0 views/s, 0.1 min left\nset 2/3, 3.0 views/s, 0.1 min left\n")
    run.start(job.output)
    summary = look(run)
    assert stage(summary, "render") == (0, 1, 0, 5)
    assert summary.images_per_s == pytest.approx(3)


def test_a_failure_shows_the_last_words_of_its_log(half):
    (failure,) = look(half).failures
    assert (failure.stage, failure.key) == ("render", "raw/loose/range/h1.2_r1.0/000075")
    assert failure.last_lines == ("one", "two", "ntop render: the avatar is not readable")
    text = "\n".join(describe(look(half)))
    assert "failed: render raw/loose/range/h1.2_r1.0/000075 (logs/5_render/raw/" in text
    assert "  ntop render: the avatar is not readable" in text


def test_a_stopped_shard_is_no_failure_and_says_what_it_keeps(half):
    (stopped,) = look(half).stopped
    assert (stopped.sets_kept, stopped.sets) == (2, 3)
    assert "render raw/loose/range/h1.0_r0.5/000000  2 of 3 sets kept" in "\n".join(
        describe(look(half))
    )


@pytest.mark.parametrize(
    "words",
    [
        "train: stopped after step 7 of 120; the same command continues there\n",
        "Traceback (most recent call last):\n  ...\nKeyboardInterrupt\n",
    ],
)
def test_training_and_ctrl_c_are_stops_as_well(run, words):
    job = jobs_of(run)["4_train/raw/loose"]
    run.write(job.log, words)
    assert stage(look(run), "train") == (0, 0, 0, 2)
    run.write(job.log, words + "ntop train: no mattes\n")
    assert stage(look(run), "train") == (0, 0, 1, 1)


def test_a_working_process_makes_its_job_running_and_its_death_a_failure(run):
    job = jobs_of(run)["4_train/raw/loose"]
    run.write(job.log, "step 1\n")
    process = run.start(job.output)
    assert stage(look(run), "train") == (0, 1, 0, 1)
    process.kill()
    process.wait()
    assert stage(look(run), "train") == (0, 0, 1, 1)


def test_a_process_elsewhere_is_not_ours(run, tmp_path):
    other = RunFolder(tmp_path / "other")
    other.start("results/4_train/raw/loose")
    try:
        assert stage(look(run), "train") == (0, 0, 0, 2)
    finally:
        other.end()


def test_an_output_that_was_removed_is_waiting_not_failed(run):
    job = jobs_of(run)["4_train/raw/loose"]
    run.finish(job, seconds=1)
    os.utime(run.folder / job.log, (1, 1))
    (run.folder / job.output / "skipped.json").unlink()
    (run.folder / job.output).rmdir()
    assert stage(look(run), "train") == (0, 0, 0, 2)


def test_slurms_jobs_are_running_queued_or_gone(run, tmp_path, monkeypatch):
    shards = [job for job in jobs_of(run).values() if job.stage == "render"]
    # a mark loses its job's id when the job begins: then the comment tells
    for job, job_id in zip(shards, (None, "12", "13"), strict=False):
        run.mark(job.output, job_id=job_id)
        run.write(job.log, "set 1/3, 3.0 views/s, 0.1 min left\n")
    name = f"rule_render_wildcards_{shards[0].key.replace('/', '_')}"
    lines = [
        f"11|RUNNING|{run.folder}|{name}",
        f"12|PENDING|{run.folder}|x",
        f"13|RUNNING|/|{name}",
    ]
    path = stand_in_for_squeue(tmp_path / "bin", lines="\n".join(lines))
    monkeypatch.setenv("PATH", path)
    summary = look(run)
    assert stage(summary, "render") == (0, 1, 0, 5)
    assert "queued in SLURM: 1 render jobs" in describe(summary)
    assert [job.key for job in summary.stopped] == [shards[2].key]
    assert "`ntop orphans` explains" in summary.notes[0]


def test_without_squeue_a_mark_is_believed_and_it_says_so(run, tmp_path, monkeypatch):
    run.mark("results/4_train/raw/loose", job_id="11")
    path = stand_in_for_squeue(tmp_path / "bin", error="cannot reach the controller", code=1)
    monkeypatch.setenv("PATH", path)
    summary = look(run)
    assert stage(summary, "train") == (0, 1, 0, 1)
    assert "squeue cannot be asked here" in summary.notes[0]


def test_skipped_sets_are_not_counted_as_images(run):
    job = jobs_of(run)[f"{SHARD}/h1.0_r0.5/000000"]
    run.finish(job, seconds=3)
    run.write(f"{job.output}/skipped.json", '[{"frame": 25, "reason": "no keypoints"}]')
    summary = look(run)
    assert (summary.sets_done, summary.sets_skipped, summary.images_done) == (2, 1, 18)
    assert any("1 without a usable body" in line for line in describe(summary))


def test_the_slowest_shards_come_first(run):
    for second, job in enumerate(j for j in jobs_of(run).values() if j.stage == "render"):
        run.finish(job, seconds=len(job.frames) * (second + 1))
    slowest = look(run).slowest
    assert [slow.seconds_per_set for slow in slowest] == [6, 5, 4, 3, 2]
    assert slowest[0].times_median == pytest.approx(6 / 3.5)


def test_a_finished_run_says_so_and_needs_nothing(run):
    for job in jobs_of(run).values():
        run.finish(job, seconds=1)
    summary = look(run)
    assert all(item.done == item.jobs for item in summary.stages)
    assert "left    nothing: all outputs are there" in describe(summary)


def test_a_running_job_shows_its_rate_and_its_time_left(run):
    job = jobs_of(run)["4_train/raw/loose"]
    run.start(job.output)
    assert [item.last_line for item in look(run).at_work] == ["nothing said yet"]
    run.write(job.log, "train: step 7/120, 3.0 steps/s, 38 s left\n\n")
    run.finish(jobs_of(run)["4_train/studio/plain"], seconds=20)
    assert "  train raw/loose: train: step 7/120, 3.0 steps/s, 38 s left" in describe(look(run))
    assert brief(look(run)) == [
        "ntop: train: 1 of 2 done, 1 running, 20.0 s/job, 20 s of work left",
        "ntop:   raw/loose: train: step 7/120, 3.0 steps/s, 38 s left",
        "ntop: 0 of 126 images, left at least 20 s with one job at once; of capture, mask, fit, "
        "render, annotate, assemble, evaluate no job has ended yet",
    ]


def follower(run, *words: str, every_s: str = "0.1") -> list[str]:
    files = ["--configfile", str(run.folder / TEST_CONFIG)]
    place = ["--directory", str(run.folder), "--every-s", every_s]
    return [sys.executable, "-m", "ntop.cli", "status", *files, *place, *words]


def test_following_says_it_again_until_all_is_done(run):
    with subprocess.Popen(follower(run), stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        for _ in range(2):
            assert process.stdout.readline().startswith("ntop: 0 of 126 images, left unknown")
        for job in jobs_of(run).values():
            run.finish(job, seconds=1)
        *_, last = process.stdout.read().splitlines()
    assert last == "ntop: 126 of 126 images, left nothing: all outputs are there"
    assert process.returncode == 0


def test_following_ends_with_its_shell(run):
    shell = ["sh", "-c", '"$@" & exec sleep 600', "sh", *follower(run)]
    with subprocess.Popen(shell, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout.readline().startswith("ntop: 0 of 126 images")
        process.kill()
        process.stdout.read()  # ends when nobody has it open any more


def test_a_time_that_is_none_is_refused(run, capsys):
    assert cli.main(["status", "--directory", str(run.folder), "--every-s", "0"]) == 2
    assert "expected seconds, more than 0" in capsys.readouterr().err


def test_status_is_quick_and_writes_nothing(half, capsys):
    before = {path: path.stat().st_mtime_ns for path in half.folder.rglob("*")}
    words = ["status", "--directory", str(half.folder), "--json"]
    assert cli.main([*words, "--configfile", str(half.folder / TEST_CONFIG)]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["dataset"] == "test"
    assert figures["images_done"] == 45
    assert {path: path.stat().st_mtime_ns for path in half.folder.rglob("*")} == before


def test_the_base_alone_is_the_demo(run, capsys):
    assert cli.main(["status", "--directory", str(run.folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "dataset demo"
    assert "images  0 of 648" in lines
    assert "left    unknown: of capture, mask, fit, train, render, annotate" in "\n".join(lines)


def test_later_files_merge_over_earlier_ones(tmp_path):
    base = {"a": {"b": 1, "c": [1, 2]}, "d": 4}
    assert merge(base, {"a": {"c": [3]}, "e": {"f": 5}}) == {
        "a": {"b": 1, "c": [3]}, "d": 4, "e": {"f": 5},
    }  # fmt: skip
    assert base == {"a": {"b": 1, "c": [1, 2]}, "d": 4}
    assert merge({"a": 1}, {"a": {"b": 2}}) == {"a": {"b": 2}}
    for name, text, words in (
        ("none.yaml", None, "cannot read configuration"),
        ("bad.yaml", "a: [1", "is not YAML"),
        ("list.yaml", "- 1", "expected keys and values"),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        with pytest.raises(ConfigError, match=words):
            read_files([tmp_path / name])


def test_a_table_is_aligned():
    assert table([("a", "bb"), ("ccc", "d")]) == ["a    bb", "ccc   d"]
