import time

import pytest

from ntop.report.costs import cost_table, cost_values, stage_costs, with_own
from ntop.storage.benchmarks import Usage, read_usage
from tests.report.small_world import write_benchmark


@pytest.fixture
def costs(world):
    return stage_costs(world.benchmarks, actors={"studio/plain", "real/p00"}, dataset="tiny")


def table_of(costs, **options):
    table = cost_table(costs, num_images=10, **options)
    return {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}


def test_costs_sum_times_and_take_the_largest_memory_of_this_datasets_jobs(costs):
    values = cost_values(costs)
    assert values["seconds.train"] == 22.0
    assert values["peak_memory_gb.train"] == 2.0
    assert values["seconds.annotate"] == 0.1
    assert values["peak_memory_gb.annotate"] is None  # too short to be sampled
    assert values["seconds.render"] is values["seconds.assemble"] is None
    assert len(values) == 16


def test_the_table_has_hours_load_memory_and_shares_per_image(costs):
    rows = table_of(costs)
    assert rows["train"] == {
        "stage": "train", "jobs": "2", "wall hours": "0.0061", "CPU hours": "0.0117",
        "mean load": "1.91", "largest memory (GB)": "2.00", "wall s per image": "2.20",
        "CPU s per image": "4.20",
    }  # fmt: skip
    assert rows["annotate"]["CPU hours"] == rows["render"]["wall hours"] == "–"
    assert rows["all stages"]["jobs"] == "3"
    assert rows["all stages"]["wall s per image"] == "2.21"
    # a job without CPU time does not dilute the load of the others
    assert rows["all stages"]["mean load"] == "1.91"


def test_nothing_measured_is_no_table(tmp_path):
    costs = stage_costs(tmp_path, actors={"a/b"}, dataset="d")
    assert cost_table(costs, num_images=1) is None
    assert set(cost_values(costs).values()) == {None}


def test_gpu_hours_appear_once_jobs_asked_for_gpus(tmp_path):
    for shard, gpus in (("0", 2), ("1", 0)):
        cells = {"s": "1800", "max_rss": "1", "cpu_time": "60"}
        cells["resources"] = str({"tmpdir": "/tmp", "gpu": gpus})
        # an extended table names all inputs in one cell: more than Python's csv takes
        cells["input_size_mb"] = str({f"results/5_render/{i:060d}": 0.1 for i in range(4000)})
        write_benchmark(tmp_path / f"5_render/s/a/{shard}.tsv", **cells)
    costs = stage_costs(tmp_path, actors={"s/a"}, dataset="d")
    rows = table_of(costs)
    assert rows["render"]["wall hours"] == rows["render"]["GPU hours"] == "1.0000"
    assert rows["train"]["GPU hours"] == "–"
    assert rows["all stages"]["GPU hours"] == "1.0000"


def test_evaluate_measures_itself(costs):
    own = cost_values(with_own(costs, started=time.monotonic() - 5))
    assert 5 <= own["seconds.evaluate"] < 60
    assert 0.05 < own["peak_memory_gb.evaluate"] < 20
    assert own["seconds.train"] == 22.0


@pytest.mark.parametrize("text", ["", "s\tmax_rss\n", "s\n-\n", "max_rss\n3\n", "s\nnan\n"])
def test_an_unusable_table_is_nothing(tmp_path, text):
    path = tmp_path / "t.tsv"
    path.write_text(text)
    assert read_usage(path) is None
    assert read_usage(tmp_path / "absent.tsv") is None


@pytest.mark.parametrize("resources", ["-", "{'gpu': 'none'}", "[1]", "{broken"])
def test_unreadable_resources_leave_the_times(tmp_path, resources):
    write_benchmark(tmp_path / "t.tsv", s="3.5", resources=resources)
    assert read_usage(tmp_path / "t.tsv") == Usage(3.5)
