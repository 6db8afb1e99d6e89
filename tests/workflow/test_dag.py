"""What Snakemake plans, without running a stage."""

import json
import re
import shutil
import zipfile
from pathlib import Path

import pytest

from ntop.config.plan import planned_jobs
from ntop.config.run import load_files
from ntop.stages import STAGES
from ntop.tools import plan
from tests.workflow.project import ROOT, TEST_CONFIG


def planned(text: str) -> dict[str, int]:
    """Rule -> number of jobs, from the table of a dry run."""
    return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", text, re.MULTILINE)}


def test_a_plain_call_finds_the_default_profile_and_plans_the_demo(project):
    done = project.snakemake("-n", "--quiet", "rules")
    assert done.returncode == 0, done.stderr
    assert "profiles/default" in done.stdout + done.stderr
    jobs = planned(done.stdout + done.stderr)
    assert (jobs["capture"], jobs["mask"], jobs["fit"], jobs["train"]) == (2, 1, 1, 2)
    assert jobs["render"] == jobs["annotate"] > 2
    assert (jobs["assemble"], jobs["evaluate"]) == (1, 1)


def test_what_a_source_brings_along_is_not_in_the_plan(project):
    done = project.snakemake("-n", "-p", *TEST_CONFIG)
    assert done.returncode == 0, done.stderr
    assert "results/2_mask/raw/loose" in done.stdout
    assert "results/2_mask/studio/plain" not in done.stdout
    assert "results/3_fit/studio/plain" not in done.stdout


def test_a_gpu_that_a_rule_is_given_reaches_its_lease(project):
    words = ["-n", "-p", *TEST_CONFIG, "--resources", "gpu=2", "--set-resources", "render:gpu=1"]
    done = project.snakemake(*words)
    assert done.returncode == 0, done.stderr
    assert "exec ntop lease -n 1 -- ntop render" in done.stdout
    assert "exec ntop lease -n 0 -- ntop train" in done.stdout


@pytest.mark.parametrize("words", [[], TEST_CONFIG])
def test_the_plan_that_status_reads_is_snakemakes(project, words):
    done = project.snakemake("-n", *words)
    assert done.returncode == 0, done.stderr
    outputs = re.findall(r"^    output: (results/.*)$", done.stdout, re.MULTILINE)
    paths = [project.folder / word for word in words[1:]]
    jobs = planned_jobs(load_files(paths, directory=project.folder))
    assert sorted(outputs) == sorted(job.output for job in jobs)


def test_a_frozen_plan_cuts_the_shards(project):
    plan.main(project.folder / "plan.json", directory=project.folder, views_per_s=100)
    done = project.snakemake("-n", "--quiet", "rules", "--config", "plan=plan.json")
    assert done.returncode == 0, done.stderr
    # 5 sequences x 2 rigs, each in one shard now
    assert planned(done.stdout + done.stderr)["render"] == 10


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train={'stepz': 3}"], "train.stepz: unknown key; check the spelling"),
        (["heights_above_pelvis_m=[1.2]"], "use render.rigs"),
    ],
)
def test_a_wrong_key_stops_at_once_with_advice(project, words, message):
    done = project.snakemake("-n", "--config", *words)
    assert done.returncode != 0
    assert message in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_an_actor_in_two_splits_stops_at_once(project):
    with (project.folder / "config/actors.tsv").open("a") as table:
        table.write("studio\tplain\ttrain\tm\n")
    done = project.snakemake("-n")
    assert done.returncode != 0
    assert "studio/plain is listed twice" in done.stdout + done.stderr


def test_one_actor_can_be_asked_for_alone(project):
    target = "results/6_annotate/studio/plain/done"
    done = project.snakemake(target, "-n", "--quiet", "rules", *TEST_CONFIG)
    assert planned(done.stdout) == {
        "capture": 1, "train": 1, "render": 2, "annotate": 2, "actor": 1, "total": 7,
    }  # fmt: skip


def test_an_actor_without_shards_is_no_target(project):
    done = project.snakemake("-n", "results/6_annotate/studio/nobody/done", *TEST_CONFIG)
    assert done.returncode != 0
    assert "has no render line of studio/nobody" in done.stdout + done.stderr


def test_a_new_actor_adds_its_own_jobs_only(project):
    before = planned(project.snakemake("-n", "--quiet", "rules", *TEST_CONFIG).stdout)
    with (project.folder / "config/test/actors.tsv").open("a") as table:
        table.write("studio\tloose\ttrain\tf\n")
    with (project.folder / "config/test/sequences.tsv").open("a") as table:
        table.write("studio\tloose\trange\t0\t50\t25\ttrain\tauthored:range\t-\n")
        table.write("studio\tloose\tsit\t0\t20\t20\trender\tauthored:sit\t-\n")
    after = planned(project.snakemake("-n", "--quiet", "rules", *TEST_CONFIG).stdout)
    added = {name: after[name] - before[name] for name in after if after[name] != before[name]}
    assert {k: v for k, v in added.items() if k != "total"} == {
        "capture": 1, "train": 1, "render": 2, "annotate": 2,
    }  # fmt: skip


def test_the_slurm_profile_gives_every_job_its_time_memory_and_signal(project):
    done = project.snakemake("-n", "--profile", "profiles/slurm")
    assert done.returncode == 0, done.stdout + done.stderr
    pattern = r"^rule (\w+):$.*?^    resources: (.*?)$"
    resources = dict(re.findall(pattern, done.stdout, re.MULTILINE | re.DOTALL))
    assert {name for _, name, _ in STAGES} < set(resources)
    for text in resources.values():
        assert re.search(r"\bmem_mb=\d+", text)
        assert re.search(r"\bruntime=\d+", text)
    signals = {name for name, text in resources.items() if "slurm_extra=--signal=TERM@" in text}
    assert signals == {"train", "render"}  # the stages that continue where they stopped


@pytest.mark.workflow
@pytest.mark.xdist_group("campaign")
class TestAfterTheCampaign:
    def test_a_second_run_does_nothing_and_says_so(self, campaign):
        done = campaign.run()
        assert done.returncode == 0, done.stderr
        assert "Nothing to be done" in done.stdout + done.stderr

    @pytest.mark.parametrize(
        ("change", "expected"),
        [
            ("train={'steps': 151}", {"train", "render", "annotate", "assemble", "evaluate"}),
            (
                "sources={'raw': {'overrides': {'train': {'reach_m': 0.06}}}}",
                {"train", "render", "annotate", "assemble", "evaluate"},
            ),
            ("render={'seed': 5}", {"render", "annotate", "assemble", "evaluate"}),
        ],
    )
    def test_a_changed_value_reruns_its_stage_and_nothing_upstream(
        self, campaign, change, expected
    ):
        done = campaign.snakemake("-n", "--quiet", "rules", *TEST_CONFIG, "--config", change)
        assert set(planned(done.stdout)) - {"all", "total"} == expected, done.stderr

    def test_a_bumped_version_reruns_its_stage_and_nothing_upstream(self, campaign, tmp_path):
        package = tmp_path / "ntop"
        shutil.copytree(ROOT / "ntop", package, ignore=shutil.ignore_patterns("__pycache__"))
        stages = package / "stages/__init__.py"
        stages.write_text(stages.read_text().replace('(6, "annotate", 1)', '(6, "annotate", 99)'))
        done = campaign.snakemake("-n", "--quiet", "rules", *TEST_CONFIG, PYTHONPATH=str(tmp_path))
        assert set(planned(done.stdout)) - {"all", "total"} == {"annotate", "assemble", "evaluate"}

    def test_snakemakes_report_holds_sheets_curves_and_tables_with_labels(self, campaign, tmp_path):
        done = campaign.snakemake("--report", str(tmp_path / "report.zip"), *TEST_CONFIG)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Missing metadata" not in done.stderr
        with zipfile.ZipFile(tmp_path / "report.zip") as archive:
            page = archive.read("report/report.html").decode()
            sizes = {Path(item.filename).name: item.file_size for item in archive.infolist()}
        decode, found = json.JSONDecoder().raw_decode, {}
        for name in ("categories", "results"):
            found[name], _ = decode(page, page.index(f"var {name} = {{") + len(f"var {name} = "))
        assert {name: set(subs) for name, subs in found["categories"].items()} == {
            "Nine views": {"raw", "studio"}, "Training": {"raw", "studio"}, "Scores": {"studio"},
            "Dataset": {"test"}, "Run": {"test"},
        }  # fmt: skip
        labels = {Path(path).name: item["labels"] for path, item in found["results"].items()}
        assert labels["views-raw-loose-h1.0_r0.5.jpg"] == {"actor": "raw/loose", "rig": "h1.0_r0.5"}
        assert labels["training-raw-loose-training_rays.svg"]["curve"] == "training rays"
        assert labels["scores-studio-plain-mask_IoU_against_truth.svg"]["actor"] == "studio/plain"
        assert labels["run-costs.html"] == {"table": "costs"}
        assert labels["contents-subject_size.svg"] == {"figure": "subject size"}
        assert len(labels) == 19 and all(labels.values())
        assert all(item["caption"].strip() for item in found["results"].values())
        assert all(sizes[name] > 500 for name in labels)  # the files themselves are in the zip
        assert "An annotated top-view fisheye pose dataset" in page

    def test_every_job_left_a_log_and_a_benchmark(self, campaign):
        logs = {p.relative_to(campaign.folder / "logs").with_suffix("")
                for p in (campaign.folder / "logs").rglob("*.log")}  # fmt: skip
        times = {p.relative_to(campaign.folder / "results/benchmarks").with_suffix("")
                 for p in (campaign.folder / "results/benchmarks").rglob("*.tsv")}  # fmt: skip
        assert Path("4_train/raw/loose") in times
        assert {p for p in logs if p.parts[0] != "0_fetch"} == times


def test_the_workflow_is_lint_clean(project):
    done = project.snakemake("--lint")
    assert done.returncode == 0, done.stdout + done.stderr
