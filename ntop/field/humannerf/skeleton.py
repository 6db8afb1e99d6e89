"""The skeleton in canonical space (the T-pose) and in a pose: Gaussian bones, transforms, boxes."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ntop.body.model import BodyModel, part_labels
from ntop.body.skinning import BodyPose, pose_body, rest_body
from ntop.conventions import NUM_JOINTS

BOX_MARGIN_M = 0.3  # of every box beyond the joints
LIMB_SPREAD_M, TRUNK_SPREAD_M = 0.03, 0.06  # standard deviations across a bone
TRUNK = (0, 3, 6, 9, 12, 15)  # pelvis, spine, neck, head
LOWEST_PRIOR = 1e-7  # nowhere is a bone impossible, so that its logarithm exists


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in metres."""

    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class CanonicalSkeleton:
    """The T-pose of one person: what the volume spans and where parts are."""

    box: Box
    joints: Float[np.ndarray, "24 3"]
    bone_ends: Float[np.ndarray, "bone 2 3"]
    bone_owners: Int[np.ndarray, " bone"]
    vertices: cKDTree
    vertex_parts: Int[np.ndarray, " vertex"]

    def parts_at(self, points: Float[np.ndarray, "point 3"]) -> Int[np.ndarray, " point"]:
        """Part value (label + 1) of the nearest vertex."""
        _, nearest = self.vertices.query(points)
        return self.vertex_parts[nearest] + 1


@dataclass(frozen=True)
class PosedSkeleton:
    """One pose. Positions are relative to `origin_world`, so that float32 suffices.

    `maps` take posed positions to canonical ones, one rigid transform per bone. `pose` are the
    axis-angles (rad) that the non-rigid motion is conditioned on.
    """

    origin_world: Float[np.ndarray, " 3"]
    maps: Float[Tensor, "24 3 4"]
    box: Box
    pose: Float[Tensor, " 69"]


def canonical_skeleton(model: BodyModel, betas: tuple[float, ...]) -> CanonicalSkeleton:
    """The person's T-pose.

    A bone moves with the joint it begins at. Leaf bones (head, hands, feet) end as far behind the
    middle of their part as they begin before it.
    """
    rest = rest_body(model, torch.tensor(betas, dtype=torch.float64))
    joints, vertices = rest.joints.numpy(), rest.vertices.numpy()
    parts = part_labels(model).numpy()
    ends, owners = [], []
    for joint in range(NUM_JOINTS):
        children = [c for c, parent in enumerate(model.parents) if parent == joint and c]
        middle = vertices[parts == joint].mean(0) if (parts == joint).any() else joints[joint]
        for end in [joints[c] for c in children] or [2 * middle - joints[joint]]:
            ends.append((joints[joint], end))
            owners.append(joint)
    return CanonicalSkeleton(
        box=joint_box(joints),
        joints=joints,
        bone_ends=np.array(ends),
        bone_owners=np.array(owners),
        vertices=cKDTree(vertices),
        vertex_parts=parts,
    )


def joint_box(joints: Float[np.ndarray, "24 3"]) -> Box:
    """The box around joints, with the method's margin."""
    return Box(joints.min(0) - BOX_MARGIN_M, joints.max(0) + BOX_MARGIN_M)


def posed_skeleton(model: BodyModel, pose: BodyPose) -> PosedSkeleton:
    """Transforms and box of a single pose."""
    exact = pose.double()
    body = pose_body(model, exact)
    joints, bones = body.joints.numpy(), body.posed_from_rest.numpy().copy()
    origin = joints[0].copy()
    bones[:, :3, 3] -= origin
    maps = np.linalg.inv(bones)[:, :3]
    return PosedSkeleton(
        origin_world=origin,
        maps=torch.from_numpy(maps.astype(np.float32)),
        box=joint_box(joints - origin),
        pose=exact.body_pose.float(),
    )


def gaussian_bones(skeleton: CanonicalSkeleton, side: int) -> Float[Tensor, "25 x y z"]:
    """Prior weights of the 24 bones and the background at the nodes of the canonical box.

    A bone is an ellipsoidal Gaussian, as long as the bone (one standard deviation to either end)
    and `LIMB_SPREAD_M` or `TRUNK_SPREAD_M` wide. The background is what is left of one.
    """
    axes = [np.linspace(skeleton.box.low[k], skeleton.box.high[k], side) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    weights = np.zeros((NUM_JOINTS + 1, side, side, side))
    for (start, end), owner in zip(skeleton.bone_ends, skeleton.bone_owners, strict=True):
        spread = TRUNK_SPREAD_M if owner in TRUNK else LIMB_SPREAD_M
        length = np.linalg.norm(end - start)
        direction = (end - start) / length if length > 0 else np.zeros(3)
        offset = nodes - (start + end) / 2
        along = offset @ direction
        across = (offset**2).sum(-1) - along**2
        exponent = along**2 / max(length / 2, spread) ** 2 + across / spread**2
        weights[owner] = np.maximum(weights[owner], np.exp(-exponent / 2))
    weights[-1] = np.clip(1 - weights[:-1].sum(0), 0, 1)
    weights = np.clip(weights, LOWEST_PRIOR, None)
    return torch.from_numpy((weights / weights.sum(0)).astype(np.float32))
