"""Who is rendered in the benchmarks: a body made by recipe, and a finished demo's avatars.

The recipe needs no training and no download, so that `make bench` works on a fresh clone: the
embedded body as a field of 5 mm voxels, its surface as hard as a trained one's, painted with bands.
Where `make demo` has run, the avatars of its real and its studio source are measured as well.
"""

import functools
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ntop.body.model import BodyModel, load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.field.avatar import Avatar, load_avatar
from ntop.field.canonical import (
    CanonicalGrid,
    canonical_body,
    distance_grid,
    number_bricks,
    void_values,
)
from ntop.field.posing import PosedAvatar, pose_avatar
from ntop.field.quality import RenderSettings
from ntop.geometry.cameras import Camera
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.storage import schemas
from ntop.storage.tables import read_table

SIZE_PX = 1000
RIGS = {"h1.0_r0.5": (1.0, 0.5), "h1.2_r1.0": (1.2, 1.0)}  # height above the pelvis, ring radius
VOXEL_M = 0.005
SHELL_M = 0.03
RAW_PER_M = 1600.0  # trained avatars rise by 8 within a voxel
RAW_LIMIT = 8.0
BAND_M = 0.04
BAND_RAW = 1.5


@dataclass(frozen=True)
class Subject:
    """An avatar in a pose; lengths in metres."""

    name: str
    avatar: Avatar
    model: BodyModel
    pose: BodyPose

    def posed(self, settings: RenderSettings) -> PosedAvatar:
        """Ready to be looked at."""
        return pose_avatar(self.avatar, self.model, self.pose, settings=settings)

    def joints_world(self) -> Float[np.ndarray, "joint 3"]:
        """For the paper's box."""
        return pose_body(self.model, self.pose).joints.numpy()

    def cameras(self, rig: str) -> dict[str, Camera]:
        """The nine views of a rig."""
        pelvis = torch.from_numpy(self.joints_world()[0])
        return top_view_cameras(Rig(*RIGS[rig], SIZE_PX, SIZE_PX, SIZE_PX / math.pi), pelvis)


def chosen_results() -> Path | None:
    """The results folder given on the command line or at hand, if a demo has trained in it."""
    given = Path(sys.argv[1]) if sys.argv[1:] else Path("results")
    return given if (given / "4_train").is_dir() else None


def subjects(results: Path | None) -> list[Subject]:
    """The body made by recipe, and one pose of each avatar of a demo's results folder."""
    return [painted(), *(trained_subjects(results) if results else [])]


@functools.lru_cache(maxsize=1)
def painted() -> Subject:
    """The recipe: arms lowered, one knee raised."""
    model, betas = load_body_model(), (0.0,) * 10
    body = canonical_body(model, betas)
    distances, _, origin = distance_grid(body, spacing_m=VOXEL_M, reach_m=SHELL_M)
    blocks = np.array(distances.shape) // 4
    split = distances.reshape(blocks[0], 4, blocks[1], 4, blocks[2], 4).transpose(0, 2, 4, 1, 3, 5)
    bricks, positions = number_bricks((np.abs(split) <= SHELL_M).any(axis=(3, 4, 5)))
    inner = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * positions[1:, None] + inner).reshape(-1, 3) * VOXEL_M
    values = void_values(len(positions))
    raw = -RAW_PER_M * split[tuple(positions[1:].T)].ravel()
    values[64:, 0] = np.clip(raw, -RAW_LIMIT, RAW_LIMIT)
    values[64:, 1:] = BAND_RAW * np.sin(2 * math.pi / BAND_M * nodes)
    light = np.zeros((9, 3), np.float32)
    light[0], light[2] = 0.8, 0.2
    grid = CanonicalGrid(values, bricks, positions, origin, VOXEL_M)
    body_pose = torch.zeros(69, dtype=torch.float64)
    body_pose[47], body_pose[50] = -1.1, 1.1  # shoulders about z: the arms hang
    body_pose[0], body_pose[9] = -0.9, 1.2  # left hip and knee about x
    pose = BodyPose(
        betas=torch.zeros(10, dtype=torch.float64),
        global_orient=torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64),
        body_pose=body_pose,
        transl=torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64),
    )
    return Subject("painted", Avatar(grid, light, betas, SHELL_M, 0), model, pose)


def trained_subjects(results: Path) -> list[Subject]:
    """One avatar per source, in the pose of the first set that was rendered of it."""
    found = []
    for source in sorted((results / "4_train").glob("*")):
        actor = sorted(source.glob("*"))[0]
        tables = sorted((results / "5_render" / source.name / actor.name).rglob("renders.parquet"))
        if not tables:
            continue
        row = read_table(tables[0], schema=schemas.RENDER)[0]
        names = ("betas", "global_orient_rad", "body_pose_rad", "transl_m")
        pose = BodyPose(*(torch.tensor(row[name], dtype=torch.float64) for name in names))
        found.append(Subject(source.name, load_avatar(actor), load_body_model(), pose))
    return found
