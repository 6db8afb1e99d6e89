import numpy as np
import pytest

from ntop.conventions import DataError
from ntop.report.exhibits import Exhibit, contact_image, table_exhibit, write_exhibits
from ntop.report.gallery import representative_sets
from ntop.report.inputs import Dataset
from ntop.report.page import Table
from ntop.report.scores import ImageScores, score_curves
from ntop.report.summary import left_out_table


def test_a_contact_sheet_has_nine_tiles_and_marks_on_them(world):
    dataset = Dataset.read(world.dataset)
    key = representative_sets(dataset, world.studio)["h1.2_r1.0"]
    sheet = contact_image(dataset, key)
    assert sheet.shape == (1584, 1500, 3)
    orange = (np.abs(sheet.astype(int) - (234, 88, 12)).max(-1) < 30).astype(int)
    for row in range(3):
        for column in range(3):
            tile = orange[528 * row : 528 * (row + 1), 500 * column : 500 * (column + 1)]
            assert tile.sum() > 50, (row, column)  # each view shows visible keypoints


def test_names_hold_the_words_and_are_unique(tmp_path):
    exhibit = Exhibit("scores", ("a", "b", "mask IoU"), "svg", b"x")
    assert exhibit.file == "scores-a-b-mask_IoU.svg"
    write_exhibits([exhibit], tmp_path / "e")
    assert (tmp_path / "e/scores-a-b-mask_IoU.svg").read_bytes() == b"x"
    with pytest.raises(DataError, match="several exhibits are named"):
        write_exhibits([exhibit, exhibit], tmp_path / "e")


def test_a_table_in_a_file_of_its_own_is_escaped():
    content = table_exhibit("run", "t", table=Table(("a<b",), (("1",),), text="x & y")).content
    assert b"a&lt;b" in content and b"x &amp; y" in content


def test_score_curves_fall_from_best_to_worst():
    scores = [ImageScores(20.0 + i, 25.0, 0.9, 0.5 + i / 10, 10.0, 11.0) for i in (0, 2, 1)]
    charts = score_curves(scores, what="s/a")
    assert list(charts) == ["PSNR", "mask IoU"]
    points = charts["mask IoU"].elements.split('points="')[1].split('"')[0].split()
    heights = [float(point.split(",")[1]) for point in points]
    assert heights == sorted(heights)  # downwards on the screen


def test_what_was_left_out_is_counted_by_reason(world):
    skipped = [{"source": "real", "actor": "p00", "frame": i, "reason": "no body"} for i in (1, 2)]
    table = left_out_table({"skipped": skipped}, list(world.actors))
    assert table.rows == (("render", "real/p00", "no body", "2"),)
    nothing = left_out_table({"skipped": []}, list(world.actors))
    assert nothing.rows == () and nothing.text.startswith("Every planned set")
