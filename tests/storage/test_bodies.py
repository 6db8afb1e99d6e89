"""Body tables: poses come back exactly; tables that mix people or hold NaN are refused."""

import pytest
import torch

from ntop.body.skinning import BodyPose
from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.bodies import body_pose_from_rows, body_rows, read_bodies
from ntop.storage.tables import Row, write_table

FRAMES = [("move", 0), ("move", 4), ("stand", 1)]


def poses() -> BodyPose:
    random = torch.Generator().manual_seed(1)

    def values(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    return BodyPose(values(10).expand(3, -1), values(3, 3), values(3, 69), values(3, 3))


def rows(pose: BodyPose) -> list[Row]:
    return body_rows(
        pose, torch.zeros(3, 24, 3), source="made", actor="up", frames=FRAMES,
        errors_mm=[1.0, 2.0, 3.0], reasons=["", "", "too few landmarks"],
    )  # fmt: skip


def test_poses_come_back_exactly(tmp_path):
    pose = poses()
    write_table(rows(pose), schema=schemas.BODY, path=tmp_path / "b.parquet")
    read = read_bodies(tmp_path / "b.parquet")
    assert [(row["action"], row["frame"]) for row in read] == FRAMES
    assert read[2]["reason"] == "too few landmarks"
    again = body_pose_from_rows(read)
    for name in ("betas", "global_orient", "body_pose", "transl"):
        assert torch.equal(getattr(again, name), getattr(pose, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r[1].update(actor="other"), "2 actors"),
        (lambda r: r[1].update(betas=[0.0] * 10), "2 shapes"),
        (lambda r: r[1].update(transl_m=[0.0, float("nan"), 0.0]), "move frame 4.*not finite"),
        (lambda r: r.clear(), "no bodies"),
    ],
)
def test_unusable_tables_are_refused(tmp_path, change, message):
    table = rows(poses())
    change(table)
    write_table(table, schema=schemas.BODY, path=tmp_path / "b.parquet")
    with pytest.raises(DataError, match=message):
        read_bodies(tmp_path / "b.parquet")
