"""Sample ids: stable, distinct, and a function of the key alone."""

from dataclasses import replace

from ntop.conventions import VIEWS
from ntop.storage.keys import SetKey

KEY = SetKey("lab", "ada", "wave", "h1.2_r1.0", 7)


def test_an_id_never_changes():
    # published datasets name their samples by it
    assert KEY.sample_id("centre") == "c69d2e9d75f6a6b5"
    assert KEY.image_name("ne") == "000007_ne.png"


def test_ids_differ_by_every_part_of_the_key():
    others = [
        replace(KEY, source="x"), replace(KEY, actor="x"), replace(KEY, action="x"),
        replace(KEY, rig="x"), replace(KEY, frame=8), KEY,
    ]  # fmt: skip
    assert len({key.sample_id(view) for key in others for view in VIEWS}) == 6 * len(VIEWS)
