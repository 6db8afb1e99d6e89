"""A capture of the studio that is small enough for tests, with everything given."""

from pathlib import Path
from typing import Any

from ntop.body.model import BodyModel
from ntop.captures.training_views import Tables, training_views
from ntop.config.sections import CaptureConfig
from ntop.config.sources import StudioSource
from ntop.config.tables import Sequence
from ntop.field.views import TrainingViews
from ntop.stages import s1_capture


def tiny_capture(out: Path, *, last: int, **settings: Any) -> Path:
    """The actor `plain` in every 20th frame of the action `range`, up to `last`."""
    source = StudioSource(
        reader="studio", provides=("masks", "keypoints2d", "bodies"), supersampling=2, seed=3,
        **settings,
    )  # fmt: skip
    sequence = Sequence(
        source="studio", actor="plain", action="range", first=0, last=last, step=20, use="train",
        motion="authored:range",
    )  # fmt: skip
    config = CaptureConfig(source_section=source, sequences=(sequence,))
    s1_capture.main(config, "studio", "plain", packages=out.parent, out=out)
    return out


def tiny_views(capture: Path, model: BodyModel) -> TrainingViews:
    """All of its pictures, at full size."""
    names = ("frames", "cameras", "masks", "bodies")
    tables = Tables(*(capture / f"{name}.parquet" for name in names))
    return training_views(tables, model, held_out_views=(), max_person_px=500, margin_m=0.05)
