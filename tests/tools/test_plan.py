import json
from pathlib import Path

import pytest

from ntop.config.plan import planned_jobs
from ntop.config.run import load_files
from ntop.conventions import ConfigError
from ntop.tools import plan
from tests.tools.run_folder import ROOT, RunFolder

HEADER = "source\tactor\taction\tfirst\tlast\tstep\tuse\tmotion\n"


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    return RunFolder(tmp_path / "run")


def write_tables(folder: RunFolder, *, actors: int, actions: int, frames: int) -> None:
    """Studio actors with a training line and some render lines each."""
    names = [f"a{i:02d}" for i in range(actors)]
    lines = [f"studio\t{name}\tval\tn\n" for name in names]
    folder.write("config/actors.tsv", "source\tactor\tsplit\tgender\n" + "".join(lines))
    lines = []
    for name in names:
        lines.append(f"studio\t{name}\trange\t0\t90\t10\ttrain\tauthored:range\n")
        lines += [
            f"studio\t{name}\tdance{k}\t0\t{frames - 1}\t1\trender\tauthored:range\n"
            for k in range(actions)
        ]
    folder.write("config/sequences.tsv", HEADER + "".join(lines))


def freeze(folder: RunFolder, **options) -> dict:
    out = folder.folder / "plan.json"
    plan.main(out, directory=folder.folder, **options)
    return json.loads(out.read_text())


def use_plan(folder: RunFolder) -> list[Path]:
    return [folder.write("planned.yaml", "plan: plan.json\n")]


def render_jobs(folder: RunFolder):
    run = load_files(use_plan(folder), directory=folder.folder)
    jobs = planned_jobs(run)
    return {job.key: job.frames for job in jobs if job.stage == "render"}


def test_a_shard_lasts_as_long_as_asked(folder):
    write_tables(folder, actors=2, actions=2, frames=500)
    found = freeze(folder, views_per_s=3.0, minutes_per_job=10)
    assert found["sets_per_shard"] == 200  # 10 min x 3 views/s / 9 views
    assert [len(frames) for frames in render_jobs(folder).values()] == [200, 200, 100] * 8
    assert found["estimate"]["images"] == 2 * 2 * 2 * 500 * 9
    assert found["estimate"]["minutes_per_job"] == 10.0


def test_a_configured_size_is_followed_unless_minutes_are_given(folder):
    write_tables(folder, actors=1, actions=1, frames=50)
    sized = [folder.write("sized.yaml", "render: {sets_per_shard: 7}\n")]
    assert freeze(folder, configfile=sized)["sets_per_shard"] == 7
    found = freeze(folder, configfile=sized, refreeze=True, views_per_s=3.0, minutes_per_job=10)
    assert found["sets_per_shard"] == 200


def test_the_pace_is_that_of_finished_jobs(folder):
    write_tables(folder, actors=1, actions=1, frames=20)
    run = load_files([], directory=folder.folder)
    for job in planned_jobs(run):
        if job.stage == "render":
            folder.finish(job, seconds=45.0)  # 10 sets: 2 views/s
    found = freeze(folder)
    assert "2.00 views/s in 4 finished render jobs" in found["estimate"]["basis"]
    assert found["sets_per_shard"] == 400


def test_additions_keep_every_shard_and_the_size(folder):
    write_tables(folder, actors=2, actions=2, frames=500)
    first = freeze(folder, views_per_s=3.0)
    before = render_jobs(folder)
    write_tables(folder, actors=3, actions=3, frames=500)
    with pytest.raises(ConfigError, match=r"a02/dance0: not in the plan[^$]*run `ntop plan` again"):
        render_jobs(folder)
    second = freeze(folder, views_per_s=30.0)  # a faster machine does not change the size
    after = render_jobs(folder)
    assert second["sets_per_shard"] == first["sets_per_shard"]
    assert {key: after[key] for key in before} == before
    assert len(after) > len(before)


def test_a_changed_sequence_is_refused_until_the_plan_starts_anew(folder):
    write_tables(folder, actors=1, actions=1, frames=500)
    first = freeze(folder, views_per_s=3.0)
    write_tables(folder, actors=1, actions=1, frames=400)
    with pytest.raises(ConfigError, match="0-399 step 1 authored:range, planned 0-499 step 1"):
        freeze(folder)
    assert json.loads((folder.folder / "plan.json").read_text()) == first
    assert freeze(folder, views_per_s=30.0, refreeze=True)["runs"] != first["runs"]


@pytest.mark.parametrize("content", ["", "{}", '{"format": 2}'])
def test_a_damaged_plan_is_named(folder, content):
    write_tables(folder, actors=1, actions=1, frames=5)
    folder.write("plan.json", content)
    with pytest.raises(ConfigError, match=r"plan .*plan\.json is not usable"):
        render_jobs(folder)


def test_a_plan_that_is_not_there_says_how_to_make_it(folder):
    write_tables(folder, actors=1, actions=1, frames=5)
    with pytest.raises(ConfigError, match=r"ntop plan --out .*plan\.json"):
        render_jobs(folder)


def test_jobs_shorter_or_longer_than_sensible_are_refused(folder):
    with pytest.raises(ConfigError, match="expected 10 to 60"):
        freeze(folder, minutes_per_job=1)


def test_gpu_hours_are_those_of_jobs_that_ask_for_gpus(folder):
    """3600 images at 1 view/s are an hour; the training's 200 s are assumed."""
    write_tables(folder, actors=1, actions=1, frames=200)
    folder.write("profiles/default/config.yaml", "rerun-incomplete: true\n")
    cluster = "set-resources:\n  train: {gpu: 2, runtime: 9}\n  render: {runtime: 60 * attempt}\n"
    profile = folder.write("cluster/config.yaml", cluster).parent
    hours = 200 / 3600

    def gpu_hours(**options):
        found = freeze(folder, views_per_s=1.0, **options)["estimate"]
        assert found["hours"] == 1.06
        return found["gpu_hours"], found["basis"].rpartition("by ")[2]

    assert gpu_hours() == (0, "the rules")
    assert gpu_hours(profile=profile) == (round(2 * hours, 2), str(profile))
    words = ["train:gpu=1", "render:gpu=1", "render:mem_mb=100"]
    assert gpu_hours(set_resources=words) == (1.06, "--set-resources")
    # as in Snakemake, the command line replaces the profile's lines, and profiles/default wins
    assert gpu_hours(profile=profile, set_resources=["render:gpu=1"]) == (1.0, "--set-resources")
    default = folder.write("profiles/default/config.yaml", "set-resources: ['render:gpu=3']\n")
    assert gpu_hours(profile=profile) == (3.0, str(default.parent))


def test_the_shipped_profiles_ask_for_no_gpu(folder):
    write_tables(folder, actors=1, actions=1, frames=5)
    assert freeze(folder, profile=ROOT / "profiles/slurm")["estimate"]["gpu_hours"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"profile": Path("nowhere")}, r"cannot read profile nowhere/config.yaml: No such file"),
        ({"set_resources": ["render:gpu=1 * attempt"]}, "render asks for gpu='1 . attempt'"),
        ({"set_resources": ["render=1"]}, "'render=1' is no resource"),
    ],
)
def test_gpus_that_cannot_be_read_are_named(folder, options, message):
    write_tables(folder, actors=1, actions=1, frames=5)
    with pytest.raises(ConfigError, match=message):
        freeze(folder, **options)


def test_a_paper_sized_campaign_stays_under_five_thousand_jobs(folder):
    """43 actors, 63.4 thousand sets, 570 thousand images (NToP, table 1), at today's pace."""
    write_tables(folder, actors=43, actions=15, frames=49)
    found = freeze(folder)
    assert found["estimate"]["sets"] == 63_210
    assert found["estimate"]["images"] == 568_890
    assert found["estimate"]["jobs"] < 5000
