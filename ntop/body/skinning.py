"""Linear blend skinning in SMPL's semantics, and the joints alone for fitting.

Steps as in SMPL (Loper et al. 2015): shape the template, regress the rest joints, add pose
offsets, chain the joint rotations, blend the bones' rigid transforms. Differentiable; leading
dimensions are free; the dtype is that of the pose (float32 or float64).
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.geometry.rotations import matrix_from_axis_angle


@dataclass(frozen=True)
class BodyPose:
    """SMPL parameters: axis-angle in radians, `transl` in metres (world)."""

    betas: Float[Tensor, "*batch beta"]
    global_orient: Float[Tensor, "*batch 3"]
    body_pose: Float[Tensor, "*batch 69"]
    transl: Float[Tensor, "*batch 3"]

    def at(self, index: int) -> "BodyPose":
        """One pose of a batch."""
        return BodyPose(
            betas=self.betas[index],
            global_orient=self.global_orient[index],
            body_pose=self.body_pose[index],
            transl=self.transl[index],
        )

    def double(self) -> "BodyPose":
        """The same in float64."""
        return BodyPose(
            betas=self.betas.double(),
            global_orient=self.global_orient.double(),
            body_pose=self.body_pose.double(),
            transl=self.transl.double(),
        )


@dataclass(frozen=True)
class PosedBody:
    """A body in the world.

    `posed_from_rest` maps the shaped T-pose (body frame) to the world, one rigid transform per
    bone, `transl` included. Pose offsets, where a model has them, act before it.
    """

    vertices: Float[Tensor, "*batch vertex 3"]
    joints: Float[Tensor, "*batch 24 3"]
    posed_from_rest: Float[Tensor, "*batch 24 4 4"]


class RestBody(NamedTuple):
    """The shaped body in zero pose: T-pose, y up, facing +z, metres."""

    vertices: Float[Tensor, "*batch vertex 3"]
    joints: Float[Tensor, "*batch 24 3"]


def rest_body(model: BodyModel, betas: Float[Tensor, "*batch beta"]) -> RestBody:
    """The shaped body before posing, in the body frame."""
    model = model.to(betas)
    return RestBody(_shaped_vertices(model, betas), _rest_joints(model, betas))


def pose_body(model: BodyModel, pose: BodyPose) -> PosedBody:
    """Vertices, joints and bone transforms of a posed body, in the world.

    `global_orient` rotates about the pelvis joint; `transl` is added last (SMPL's convention).
    """
    model = model.to(pose.betas)
    rest_vertices = _shaped_vertices(model, pose.betas)
    rotations = _joint_rotations(pose)
    if model.posedirs is not None:
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        features = (rotations[..., 1:, :, :] - identity).flatten(-3)
        offsets = features @ model.posedirs.flatten(0, 1).mT
        rest_vertices = rest_vertices + offsets.unflatten(-1, (-1, 3))
    joints, posed_from_rest = _chain(model, pose, rotations)
    # Blend the three upper rows of each transform; the last row is constant.
    blended = model.lbs_weights @ posed_from_rest[..., :3, :].flatten(-2)
    blended = blended.unflatten(-1, (3, 4))
    vertices = (blended[..., :3] * rest_vertices[..., None, :]).sum(-1) + blended[..., 3]
    return PosedBody(vertices, joints, posed_from_rest)


def pose_joints(model: BodyModel, pose: BodyPose) -> Float[Tensor, "*batch 24 3"]:
    """The 24 joints in the world without the vertices: what fitting iterates on."""
    model = model.to(pose.betas)
    return _chain(model, pose, _joint_rotations(pose))[0]


def coco17_points(
    model: BodyModel, vertices: Float[Tensor, "*batch vertex 3"]
) -> Float[Tensor, "*batch 17 3"]:
    """COCO's 17 keypoints of posed vertices, in the vertices' frame."""
    return model.to(vertices).coco17_regressor @ vertices


def _shaped_vertices(
    model: BodyModel, betas: Float[Tensor, "*batch beta"]
) -> Float[Tensor, "*batch vertex 3"]:
    return _add_shape(model.v_template, model.offsets_per_beta, betas)


def _rest_joints(
    model: BodyModel, betas: Float[Tensor, "*batch beta"]
) -> Float[Tensor, "*batch 24 3"]:
    return _add_shape(model.joint_template, model.joint_shapedirs.movedim(-1, 0), betas)


def _add_shape(
    template: Float[Tensor, "point 3"],
    offsets_per_beta: Float[Tensor, "beta point 3"],
    betas: Float[Tensor, "*batch beta"],
) -> Float[Tensor, "*batch point 3"]:
    """Template plus shape offsets, one beta after the other.

    As one matrix product the rounding would change with the number of threads [measured].
    """
    shaped = template.expand(*betas.shape[:-1], *template.shape).clone()
    for beta, offsets in zip(betas.unbind(-1), offsets_per_beta, strict=True):
        shaped.addcmul_(beta[..., None, None], offsets)
    return shaped


def _joint_rotations(pose: BodyPose) -> Float[Tensor, "*batch 24 3 3"]:
    axis_angles = torch.cat([pose.global_orient, pose.body_pose], -1).unflatten(-1, (24, 3))
    return matrix_from_axis_angle(axis_angles)


def _chain(
    model: BodyModel, pose: BodyPose, rotations: Float[Tensor, "*batch 24 3 3"]
) -> tuple[Float[Tensor, "*batch 24 3"], Float[Tensor, "*batch 24 4 4"]]:
    """World joints and rest-to-world bone transforms: forward kinematics from the pelvis out."""
    rest_joints = _rest_joints(model, pose.betas)
    world_rotations = [rotations[..., 0, :, :]]
    world_joints = [rest_joints[..., 0, :] + pose.transl]
    for joint, parent in enumerate(model.parents[1:], start=1):
        bone = rest_joints[..., joint, :] - rest_joints[..., parent, :]
        parent_rotation = world_rotations[parent]
        world_joints.append(world_joints[parent] + (parent_rotation @ bone[..., None]).squeeze(-1))
        world_rotations.append(parent_rotation @ rotations[..., joint, :, :])
    rotation, joints = torch.stack(world_rotations, -3), torch.stack(world_joints, -2)
    translation = joints - (rotation @ rest_joints[..., None]).squeeze(-1)
    upper = torch.cat([rotation, translation[..., None]], -1)
    last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=upper.dtype, device=upper.device)
    posed_from_rest = torch.cat([upper, last_row.expand(*upper.shape[:-2], 1, 4)], -2)
    return joints, posed_from_rest
