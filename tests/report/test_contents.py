"""Counts over a manifest against a slow twin."""

import math

import numpy as np
import pyarrow.parquet as pq
import pytest

from ntop.conventions import DataError
from ntop.report import contents
from ntop.report.contents import angles_deg, contents_charts, read_contents


def test_counts_equal_a_slow_twin_whatever_the_batch(world, monkeypatch):
    manifest = world.dataset / "manifest.parquet"
    rows = pq.read_table(manifest).to_pylist()
    persons = [person for row in rows for person in row["persons"]]
    monkeypatch.setattr(contents, "BATCH_ROWS", 5)
    found = read_contents(manifest)
    assert found.subjects == len(persons) == 36
    widths = [int(person["bbox_xywh_px"][2] // 10) for person in persons]
    assert found.widths.tolist() == np.bincount(widths, minlength=400).tolist()
    flags = np.array([person["visibility_smpl24"] for person in persons])
    assert found.in_frame.tolist() == (flags > 0).sum(0).tolist()
    assert found.visible.tolist() == (flags == 2).sum(0).tolist()
    # nobody leans (all stand), and the left knee is bent by 0.6 rad in every other frame
    assert found.inclinations[:2].sum() == 36
    bent = int(math.degrees(0.6) // 5)
    assert found.knee_angles[bent - 1 : bent + 2].sum() == 18


def test_angles_of_known_vectors():
    a = np.array([[1.0, 0, 0], [1, 0, 0], [0, 2, 0], [1e-9, 0, 1]])
    b = np.array([[3.0, 0, 0], [-1, 0, 0], [0, 0, 5], [0, 0, 1]])
    assert angles_deg(a, b) == pytest.approx([0, 180, 90, math.degrees(1e-9)])


def test_charts_show_shares_of_all_subjects(world):
    charts = contents_charts(read_contents(world.dataset / "manifest.parquet"))
    assert list(charts) == ["subject size", "pose", "joints in frame", "joints visible"]
    assert charts["joints in frame"].elements.count("100 %") > 10
    assert contents_charts(contents.Contents()) == {}


def test_an_unreadable_manifest_is_named(tmp_path):
    (tmp_path / "manifest.parquet").write_bytes(b"no table")
    with pytest.raises(DataError, match=r"manifest\.parquet.*--forcerun"):
        read_contents(tmp_path / "manifest.parquet")
