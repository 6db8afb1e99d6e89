"""Where the fit starts: a torso placed on four points, limbs bent the way the joints bend.

Notation: u and f are the directions of a limb's upper and lower bone, n = u x f the normal of the
plane it bends in. At rest u and the hinge axis h are known, so (u, n) <- (u_rest, h_rest) is the
upper bone's rotation; a nearly straight limb takes its hinge axis from the torso instead. Without
this an arm easily ends twisted by half a turn, which no descent undoes.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.landmarks import TORSO_NAMES, BlendedLandmarks, Landmarks
from ntop.body.model import BodyModel
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose
from ntop.conventions import NUM_BETAS, DataError
from ntop.geometry.rotations import axis_angle_from_matrix
from ntop.geometry.triangulation import Triangulation

# upper joint, hinge joint, end; hinge axis at rest (the bend of a straight limb begins about +h)
LIMBS = (
    ("left_shoulder", "left_elbow", "left_wrist", (0.0, -1.0, 0.0)),
    ("right_shoulder", "right_elbow", "right_wrist", (0.0, 1.0, 0.0)),
    ("left_hip", "left_knee", "left_ankle", (1.0, 0.0, 0.0)),
    ("right_hip", "right_knee", "right_ankle", (1.0, 0.0, 0.0)),
)
STRAIGHT_SINE, BENT_SINE = 0.15, 0.4  # below: the torso's axis; above: the limb's own


def initial_pose(
    model: BodyModel, landmarks: Landmarks, blend: BlendedLandmarks, found: Triangulation
) -> BodyPose:
    """Poses of all frames from triangulated landmarks; mean shape.

    A frame without a torso copies the nearest that has one; a limb that is not seen hangs at rest.

    Raises:
        DataError: no frame has a torso.
    """
    frames = found.points_world.shape[0]
    torso = [landmarks.index(name) for name in TORSO_NAMES]
    complete = found.valid[:, torso].all(-1)
    known = torch.nonzero(complete).squeeze(-1)
    if not len(known):
        raise DataError(
            f"body fit: shoulders and hips are triangulated in none of {frames} frames; check the "
            "keypoints and the cameras"
        )
    source = blend.template[torso, :, :3].sum(-2)  # at rest all bones are the identity
    rotation, translation = _rigid(source, found.points_world[:, torso])
    nearest = known[(torch.arange(frames)[:, None] - known).abs().argmin(-1)]
    rotation, translation = rotation[nearest], translation[nearest]
    pelvis = model.joint_template[0]  # SMPL rotates about the pelvis joint
    body_pose = torch.zeros(frames, 23, 3, dtype=torch.float64)
    for limb in LIMBS:
        upper, hinge = _limb_angles(model, landmarks, found, rotation, limb)
        seen = found.valid[:, [landmarks.index(name) for name in limb[:3]]].all(-1)[:, None]
        body_pose[:, SMPL24_NAMES.index(limb[0]) - 1] = torch.where(seen, upper, 0.0)
        body_pose[:, SMPL24_NAMES.index(limb[1]) - 1] = torch.where(seen, hinge, 0.0)
    return BodyPose(
        betas=torch.zeros(frames, NUM_BETAS, dtype=torch.float64),
        global_orient=axis_angle_from_matrix(rotation),
        body_pose=body_pose.flatten(-2),
        transl=translation + rotation @ pelvis - pelvis,
    )


def _limb_angles(
    model: BodyModel,
    landmarks: Landmarks,
    found: Triangulation,
    torso: Float[Tensor, "frame 3 3"],
    limb: tuple[str, str, str, tuple[float, float, float]],
) -> tuple[Float[Tensor, "frame 3"], Float[Tensor, "frame 3"]]:
    """Axis-angles of a limb's upper joint (relative to the torso) and of its hinge."""
    start, middle, end = (found.points_world[:, landmarks.index(name)] for name in limb[:3])
    upper, lower = _unit(middle - start), _unit(end - middle)
    joints = model.joint_template
    rest_upper = _unit(joints[SMPL24_NAMES.index(limb[1])] - joints[SMPL24_NAMES.index(limb[0])])
    hinge = joints.new_tensor(limb[3])
    own = torch.linalg.cross(upper, lower)
    sine = own.norm(dim=-1, keepdim=True)
    trust = ((sine - STRAIGHT_SINE) / (BENT_SINE - STRAIGHT_SINE)).clamp(0, 1)
    axis = trust * _unit(own) + (1 - trust) * (torso @ hinge)
    world = _frame(upper, axis) @ _frame(rest_upper, hinge).mT
    angle = torch.atan2(sine, (upper * lower).sum(-1, keepdim=True))
    return axis_angle_from_matrix(torso.mT @ world), angle * hinge


def _frame(
    along: Float[Tensor, "*batch 3"], across: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation whose columns are `along`, `across` made orthogonal to it, and their product."""
    second = _unit(across - (across * along).sum(-1, keepdim=True) * along)
    return torch.stack([along, second, torch.linalg.cross(along, second)], -1)


def _unit(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    return torch.nn.functional.normalize(vector, dim=-1)


def _rigid(
    source: Float[Tensor, "point 3"], target: Float[Tensor, "frame point 3"]
) -> tuple[Float[Tensor, "frame 3 3"], Float[Tensor, "frame 3"]]:
    """Rotation and translation that bring `source` nearest to each target (Kabsch 1976)."""
    source_mean, target_mean = source.mean(0), target.mean(1)
    covariance = (target - target_mean[:, None]).mT @ (source - source_mean)
    left, _, right = torch.linalg.svd(covariance)
    sign = torch.linalg.det(left @ right)
    flip = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1))
    rotation = left @ flip @ right
    return rotation, target_mean - rotation @ source_mean
