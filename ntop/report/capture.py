"""One actor's recording as the report looks at it: pictures, mattes, cameras, bodies by key."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ntop.body.skinning import BodyPose
from ntop.conventions import DataError
from ntop.geometry.cameras import Camera
from ntop.report.inputs import ActorFolders
from ntop.storage import schemas
from ntop.storage.cameras import CameraKey, read_cameras
from ntop.storage.frames import iterate_frames, read_frame
from ntop.storage.images import read_matte
from ntop.storage.remedies import remedy
from ntop.storage.tables import Row, read_table

FrameKey = tuple[str, int, str]  # action, frame, view
PoseKey = tuple[str, int]  # action, frame


@dataclass(frozen=True)
class Recording:
    """The tables of one actor, usable rows only."""

    folders: ActorFolders

    @cached_property
    def frames(self) -> dict[FrameKey, Row]:
        """Pictures by key."""
        return _by_view(self.folders.capture / "frames.parquet", schemas.FRAME)

    @cached_property
    def mattes(self) -> dict[FrameKey, Row]:
        """Soft masks by key."""
        return _by_view(self.folders.mattes / "masks.parquet", schemas.MASK)

    @cached_property
    def bodies(self) -> dict[PoseKey, Row]:
        """Body poses by key."""
        rows = read_table(self.folders.bodies / "bodies.parquet", schema=schemas.BODY)
        return {(r["action"], r["frame"]): r for r in rows if not r["reason"]}

    @cached_property
    def cameras(self) -> dict[CameraKey, Camera]:
        """Refined cameras, where they were refined."""
        return read_cameras(self.folders.bodies / "cameras.parquet")

    def picture(self, key: FrameKey) -> UInt8[np.ndarray, "height width 3"]:
        """One picture, RGB."""
        return read_frame(self._frame_table, self.frames[key])

    def pictures(self, keys: list[FrameKey]) -> dict[FrameKey, np.ndarray]:
        """Several pictures; every video is decoded once."""
        missing = sorted(set(keys) - set(self.frames))
        if missing:
            raise DataError(
                f"{self._frame_table}: no usable frames {missing}; {remedy(self._frame_table)}"
            )
        rows = [self.frames[key] for key in keys]
        return {
            (row["action"], row["frame"], row["view"]): picture
            for row, picture in iterate_frames(self._frame_table, rows)
        }

    def matte(self, key: FrameKey) -> Float[np.ndarray, "height width"]:
        """One soft mask in [0, 1]."""
        return read_matte(self.folders.mattes / self.mattes[key]["mask_path"])

    def pose(self, key: PoseKey) -> BodyPose:
        """One body pose, float64."""
        return pose_of(self.bodies[key])

    @property
    def _frame_table(self) -> Path:
        return self.folders.capture / "frames.parquet"


def pose_of(row: Row) -> BodyPose:
    """The body pose in a row of any table that has the body columns, or in a manifest person."""

    def column(name: str) -> torch.Tensor:
        return torch.tensor(row[name], dtype=torch.float64)

    return BodyPose(
        betas=column("betas"),
        global_orient=column("global_orient_rad"),
        body_pose=column("body_pose_rad"),
        transl=column("transl_m"),
    )


def _by_view(path: Path, schema: schemas.pa.Schema) -> dict[FrameKey, Row]:
    rows = read_table(path, schema=schema)
    return {(r["action"], r["frame"], r["view"]): r for r in rows if not r["reason"]}
