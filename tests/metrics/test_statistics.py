"""The statistics table, on numbers counted by hand."""

from ntop.metrics.statistics import Tally, statistics_rows, statistics_table

ADA, BOB, EVE = ("lab", "ada", "f"), ("lab", "bob", "m"), ("hall", "eve", "n")


def test_rows_go_by_source_then_by_split_then_total():
    train = Tally().with_image(ADA, sizes_px=[(100, 50)]).with_image(ADA, sizes_px=[(200, 150)])
    val = Tally().with_image(BOB, sizes_px=[]).with_image(BOB, sizes_px=[(40, 60)])
    hall = Tally().with_image(EVE, sizes_px=[(10, 20), (30, 40)])
    tallies = {("lab", "train"): train, ("lab", "val"): val, ("hall", "train"): hall}
    rows = {row.dataset: row for row in statistics_rows(tallies, dataset="all")}
    assert list(rows) == [
        "hall-train", "lab-train", "lab-val", "all-train", "all-val", "all total",
    ]  # fmt: skip
    assert (rows["lab-val"].images, rows["lab-val"].subjects) == (2, 1)
    assert (rows["all-train"].mean_width_px, rows["all-train"].mean_height_px) == (85, 65)
    assert (rows["all total"].actors, rows["all total"].male, rows["all total"].female) == (3, 1, 1)
    table = statistics_table(rows.values()).splitlines()
    assert table[0] == "| Dataset | Actors | Subjects | Avg. subject size |"
    assert "| lab-train | 1 (1F) | 2 | 150×100 |" in table
    assert "| hall-train | 1 | 2 | 20×30 |" in table


def test_a_group_in_which_nobody_is_seen_has_no_size():
    rows = statistics_rows({("lab", "val"): Tally().with_image(ADA, sizes_px=[])}, dataset="all")
    assert rows[-1].mean_width_px is None
    assert statistics_table(rows).splitlines()[-1] == "| all total | 1 (1F) | 0 | - |"
