"""The per-pose work: an avatar in a pose, ready for any number of views."""

import functools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.field.avatar import Avatar
from ntop.field.canonical import (
    CanonicalGrid,
    Occupancy,
    PartLabels,
    canonical_body,
    dense_voxels,
    label_grid,
)
from ntop.field.kernels.packed import PackedDensity
from ntop.field.kernels.tables import EMPTY_RAW
from ntop.field.marching import Scene
from ntop.field.packing import packed_density, packed_scene
from ntop.field.quality import RenderSettings
from ntop.field.warp import PoseWarp, occupied, pose_warp, with_octants

CELL_M = 0.012  # of the warp grid; a coarser one bends wrongly at joints (0.02: -0.6 dB)


@dataclass(frozen=True)
class PosedAvatar:
    """All that the views of one pose share; `density` is `grid`'s, packed, where it is known."""

    grid: CanonicalGrid
    warp: PoseWarp
    light: Float[np.ndarray, "9 3"]
    labels: PartLabels
    density: PackedDensity | None = None

    @functools.cached_property
    def scene(self) -> Scene:
        """What rays march through, packed once for all views."""
        return packed_scene(
            self.grid, self.warp.tables, self.light, self.labels, density=self.density
        )


def pose_avatar(
    avatar: Avatar,
    model: BodyModel,
    pose: BodyPose,
    *,
    settings: RenderSettings | None = None,
    cell_m: float = CELL_M,
) -> PosedAvatar:
    """The per-pose work, once for all views: warp grid and occupancy of a single pose."""
    settings = settings or RenderSettings()
    body = canonical_body(model, avatar.betas)
    warp = pose_warp(body, model, pose, cell_m=cell_m, reach_m=avatar.reach_m)
    shared = _shared(avatar, model)
    if settings.cells:
        tables = occupied(warp.tables, shared.dense, extent=settings.extent)
    else:
        tables = with_octants(warp.tables, np.full_like(warp.tables.occupancy, 255))
    return PosedAvatar(
        grid=avatar.grid,
        warp=replace(warp, tables=tables),
        light=avatar.light.astype(np.float32),
        labels=shared.labels,
        density=shared.density,
    )


@dataclass(frozen=True)
class _Shared:
    """What is the same in every pose of an avatar; it holds what its key names."""

    avatar: Avatar
    model: BodyModel
    dense: Occupancy
    density: PackedDensity
    labels: PartLabels


_SHARED: dict[tuple[int, int], _Shared] = {}


def _shared(avatar: Avatar, model: BodyModel) -> _Shared:
    """Made for an avatar's first pose, and kept for the last avatar."""
    key = (id(avatar), id(model))
    if key not in _SHARED:
        _SHARED.clear()
        _SHARED[key] = _Shared(
            avatar,
            model,
            dense_voxels(avatar.grid, raw_threshold=EMPTY_RAW),
            packed_density(avatar.grid),
            label_grid(canonical_body(model, avatar.betas)),
        )
    return _SHARED[key]
