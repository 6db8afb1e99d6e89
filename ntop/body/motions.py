"""Motions apart from any body: joint rotations and a root path over time, and their retargeting.

Clips come from files (`deepmimic.py`) or are authored (`authored_motions.py`). Body axes: x left,
y up, z forward. World: z up. A standing body with zero heading faces world -y, its left is
world +x.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose, pose_body, rest_body
from ntop.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

# Body frame (y up, facing +z) -> world (z up, facing -y), as a matrix acting on columns.
WORLD_FROM_BODY = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))

_FLOOR_WINDOW_S = 0.3  # half width: longer than a stride's flight, shorter than lying down
_FLIGHT_DEAD_BAND_M = 0.03  # a lowest point this near the floor counts as contact
_FRAMES_AT_ONCE = 32  # bounds the memory of posed vertices


@dataclass(frozen=True)
class Motion:
    """A clip: local joint rotations and the pelvis' path, sampled in time.

    `quaternions` are (w, x, y, z); entry 0 maps the body frame to the world. `pelvis_world_m`
    belongs to a character whose legs measure `leg_length_m` and is scaled when retargeted. A
    clip that `loops` carries path and heading on from one round to the next; any other holds its
    ends. Unless it `leaves_floor`, something touches the floor in every frame.
    """

    times_s: Float[Tensor, " sample"]
    quaternions: Float[Tensor, "sample 24 4"]
    pelvis_world_m: Float[Tensor, "sample 3"]
    leg_length_m: float
    loops: bool
    leaves_floor: bool

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last."""
        return float(self.times_s[-1] - self.times_s[0])


@dataclass(frozen=True)
class MotionSample:
    """What a motion says at some times: quaternions and the pelvis of the clip's character."""

    quaternions: Float[Tensor, "time 24 4"]
    pelvis_world_m: Float[Tensor, "time 3"]


def sample_motion(motion: Motion, times_s: Float[Tensor, " time"]) -> MotionSample:
    """The motion at any times: rotations by slerp, the pelvis linearly between samples.

    Before its start a motion rests; past its end a looping one goes on from where it is, in the
    direction it then faces, and any other rests.
    """
    times_s = times_s.to(motion.times_s).clamp(min=motion.times_s[0])
    if motion.loops:
        rounds = torch.floor((times_s - motion.times_s[0]) / motion.duration_s)
        local_s = times_s - rounds * motion.duration_s
    else:
        rounds = torch.zeros_like(times_s)
        local_s = times_s.clamp(max=motion.times_s[-1])
    after = torch.searchsorted(motion.times_s, local_s, right=True)
    after = after.clamp(1, len(motion.times_s) - 1)
    start_s, end_s = motion.times_s[after - 1], motion.times_s[after]
    fraction = ((local_s - start_s) / (end_s - start_s))[:, None]
    pelvis = torch.lerp(motion.pelvis_world_m[after - 1], motion.pelvis_world_m[after], fraction)
    quaternions = _slerp(
        motion.quaternions[after - 1], motion.quaternions[after], fraction[..., None]
    )
    rounds = rounds.to(torch.int64)
    if rounds.any():
        turns, origins = _rounds(motion, count=int(rounds.max()) + 1)
        pelvis = (turns[rounds] @ (pelvis - origins[0])[..., None]).squeeze(-1) + origins[rounds]
        facing = turns[rounds] @ matrix_from_quaternion(quaternions[:, 0])
        quaternions[:, 0] = quaternion_from_matrix(facing)
    return MotionSample(quaternions, pelvis)


def _rounds(
    motion: Motion, *, count: int
) -> tuple[Float[Tensor, "round 3 3"], Float[Tensor, "round 3"]]:
    """Heading and starting point (at the height of the first) of each round of a loop."""
    facing = matrix_from_quaternion(motion.quaternions[[0, -1], 0])
    change = facing[1] @ facing[0].T
    yaw = torch.atan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1])
    turn = matrix_from_axis_angle(torch.stack([torch.zeros_like(yaw), torch.zeros_like(yaw), yaw]))
    travel = motion.pelvis_world_m[-1] - motion.pelvis_world_m[0]
    travel = travel * torch.tensor([1.0, 1.0, 0.0], dtype=travel.dtype)
    turns, origins = [torch.eye(3, dtype=turn.dtype)], [motion.pelvis_world_m[0]]
    for _ in range(count - 1):
        origins.append(origins[-1] + turns[-1] @ travel)
        turns.append(turn @ turns[-1])
    return torch.stack(turns), torch.stack(origins)


def retarget(
    motion: Motion,
    model: BodyModel,
    betas: Float[Tensor, " beta"],
    *,
    frame_times_s: Float[Tensor, " frame"],
) -> BodyPose:
    """The motion on a given body: in the world, on the floor z = 0, from x = y = 0 at time 0.

    The path scales with the legs. The lowest vertex of every frame is put on z = 0; in a clip
    that leaves the floor, a flight keeps its height less a small dead band. A frame depends on
    its time only, not on the other frames asked for.
    """
    pose = _unsnapped(motion, model, betas, times_s=frame_times_s)
    lowest = _lowest_vertex(model, pose)
    height = -lowest
    if motion.leaves_floor:
        height = height + _flight(motion, model, pose, times_s=frame_times_s, lowest=lowest)
    transl = torch.cat([pose.transl[:, :2], (pose.transl[:, 2] + height)[:, None]], -1)
    return BodyPose(pose.betas, pose.global_orient, pose.body_pose, transl)


def _flight(
    motion: Motion,
    model: BodyModel,
    pose: BodyPose,
    *,
    times_s: Float[Tensor, " time"],
    lowest: Float[Tensor, " time"],
) -> Float[Tensor, " time"]:
    """How far the lowest vertex is to stay above the floor.

    The clip's own floor is the running minimum of its lowest vertex, over a window that outlasts
    a flight; what rises above it by more than the dead band is flight.
    """
    samples_s = torch.arange(
        float(motion.times_s[0]), float(motion.times_s[-1]), 1 / 30, dtype=torch.float64
    )
    clip = _unsnapped(motion, model, pose.betas[0], times_s=samples_s)
    wrap_s = motion.duration_s if motion.loops else None
    floor = _running_floor(_lowest_vertex(model, clip), samples_s, wrap_s=wrap_s)
    floor = _floor_at(motion, times_s, samples_s=samples_s, floor=floor)
    return (lowest - floor - _FLIGHT_DEAD_BAND_M).clamp(min=0)


def _unsnapped(
    motion: Motion,
    model: BodyModel,
    betas: Float[Tensor, " beta"],
    *,
    times_s: Float[Tensor, " time"],
) -> BodyPose:
    """The motion on the body, its pelvis path scaled and started at x = y = 0, floor unknown."""
    sample = sample_motion(motion, times_s)
    rest_joints = rest_body(model, betas).joints.to(torch.float64)
    path = sample.pelvis_world_m.clone()
    path[:, :2] -= motion.pelvis_world_m[0, :2]
    path = path * (_leg_length_m(rest_joints) / motion.leg_length_m)
    axis_angles = axis_angle_from_matrix(matrix_from_quaternion(sample.quaternions)).to(betas)
    return BodyPose(
        betas=betas.expand(len(times_s), -1),
        global_orient=axis_angles[:, 0],
        body_pose=axis_angles[:, 1:].flatten(1),
        transl=(path - rest_joints[0]).to(betas),
    )


def _leg_length_m(rest_joints: Float[Tensor, "24 3"]) -> float:
    """Hip to knee to ankle, mean of both sides."""
    total = 0.0
    for side in ("left", "right"):
        leg = [SMPL24_NAMES.index(f"{side}_{part}") for part in ("hip", "knee", "ankle")]
        total += float(rest_joints[leg].diff(dim=0).norm(dim=-1).sum())
    return total / 2


def _lowest_vertex(model: BodyModel, pose: BodyPose) -> Float[Tensor, " frame"]:
    """World z of each frame's lowest vertex."""
    lowest = []
    for start in range(0, len(pose.transl), _FRAMES_AT_ONCE):
        part = slice(start, start + _FRAMES_AT_ONCE)
        frames = BodyPose(
            pose.betas[part], pose.global_orient[part], pose.body_pose[part], pose.transl[part]
        )
        lowest.append(pose_body(model, frames).vertices[..., 2].amin(-1))
    return torch.cat(lowest)


def _running_floor(
    lowest: Float[Tensor, " sample"], times_s: Float[Tensor, " sample"], *, wrap_s: float | None
) -> Float[Tensor, " sample"]:
    """Running minimum, then running mean over the same window: never above the lowest vertex."""
    apart_s = (times_s[:, None] - times_s).abs()
    if wrap_s is not None:
        apart_s = torch.minimum(apart_s, wrap_s - apart_s)
    near = apart_s <= _FLOOR_WINDOW_S
    least = torch.where(near, lowest, torch.inf).amin(1)
    return torch.where(near, least, 0.0).sum(1) / near.sum(1)


def _floor_at(
    motion: Motion,
    times_s: Float[Tensor, " time"],
    *,
    samples_s: Float[Tensor, " sample"],
    floor: Float[Tensor, " sample"],
) -> Float[Tensor, " time"]:
    """The clip's floor, between samples linearly."""
    start_s = motion.times_s[0]
    local_s = times_s.to(samples_s)
    if motion.loops:
        local_s = start_s + torch.remainder(local_s - start_s, motion.duration_s)
    local_s = local_s.clamp(samples_s[0], samples_s[-1])
    after = torch.searchsorted(samples_s, local_s, right=True).clamp(1, len(samples_s) - 1)
    span_s = samples_s[after] - samples_s[after - 1]
    fraction = ((local_s - samples_s[after - 1]) / span_s).to(floor)
    return torch.lerp(floor[after - 1], floor[after], fraction)


def _slerp(
    start: Float[Tensor, "*batch 4"],
    end: Float[Tensor, "*batch 4"],
    fraction: Float[Tensor, "*#batch 1"],
) -> Float[Tensor, "*batch 4"]:
    """Constant-speed rotation the short way round; linear where the two are almost equal."""
    cosine = (start * end).sum(-1, keepdim=True)
    end = torch.where(cosine < 0, -end, end)
    angle = torch.acos(cosine.abs().clamp(max=1.0))
    small = angle < 1e-4  # there sin(angle) cancels and the chord is the arc
    sine = torch.where(small, torch.ones_like(angle), torch.sin(angle))
    start_weight = torch.where(small, 1 - fraction, torch.sin((1 - fraction) * angle) / sine)
    end_weight = torch.where(small, fraction, torch.sin(fraction * angle) / sine)
    return start_weight * start + end_weight * end
