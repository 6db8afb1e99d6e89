"""Tables of fitted bodies: one row per frame, `betas` the same in all rows of an actor."""

from pathlib import Path

import numpy as np
import torch

from ntop.body.skinning import BodyPose
from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.tables import Row, read_table


def read_bodies(path: Path) -> list[Row]:
    """Rows of a body table, sorted as written.

    Raises:
        DataError: unreadable, empty, several actors or several shapes in one table, or a number
            that is not finite.
    """
    rows = read_table(path, schema=schemas.BODY)
    if not rows:
        raise DataError(f"{path}: no bodies; run the fit stage again")
    actors = {(row["source"], row["actor"]) for row in rows}
    shapes = {tuple(row["betas"]) for row in rows}
    if len(actors) > 1 or len(shapes) > 1:
        raise DataError(
            f"{path}: {len(actors)} actors with {len(shapes)} shapes, expected one actor with one "
            "`betas`; split the table by actor"
        )
    for row in rows:
        numbers = np.concatenate([row[name] for name, _ in schemas.BODY_COLUMNS])
        if not np.isfinite(numbers).all():
            raise DataError(
                f"{path}: {row['source']}/{row['actor']} {row['action']} frame {row['frame']}: "
                "a pose parameter is not finite; run the fit stage again"
            )
    return rows


def body_pose_from_rows(rows: list[Row]) -> BodyPose:
    """Poses of the given rows in their order, float64; the leading axis is the row."""
    return BodyPose(
        betas=_column(rows, "betas"),
        global_orient=_column(rows, "global_orient_rad"),
        body_pose=_column(rows, "body_pose_rad"),
        transl=_column(rows, "transl_m"),
    )


def body_rows(
    pose: BodyPose,
    joints_world: torch.Tensor,
    *,
    source: str,
    actor: str,
    frames: list[tuple[str, int]],
    errors_mm: list[float],
    reasons: list[str],
) -> list[Row]:
    """Rows of schema BODY; `frames` are (action, frame), leading axis of `pose` and joints."""
    return [
        {
            "source": source,
            "actor": actor,
            "action": action,
            "frame": frame,
            "betas": pose.betas[index].tolist(),
            "global_orient_rad": pose.global_orient[index].tolist(),
            "body_pose_rad": pose.body_pose[index].tolist(),
            "transl_m": pose.transl[index].tolist(),
            "joints3d_world_m": joints_world[index].flatten().tolist(),
            "error_mm": errors_mm[index],
            "reason": reasons[index],
        }
        for index, (action, frame) in enumerate(frames)
    ]


def _column(rows: list[Row], name: str) -> torch.Tensor:
    return torch.tensor([row[name] for row in rows], dtype=torch.float64)
