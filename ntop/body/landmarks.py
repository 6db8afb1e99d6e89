"""Where the points of a detector's skeleton lie on the body.

Every landmark is a fixed mean of *fit points*: the 24 joints followed by all vertices, posed. What
detectors mean by "hip" differs by centimetres from any model's joint, but by the same amount in
all frames: a landmark may therefore carry a constant offset in the rest frame of its bone, learned
with a prior of `offset_sigma_m` (zero: the landmark is exact by definition).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.body.skeletons import (
    COCO17_NAMES,
    COCO17_PARTS,
    MEDIAPIPE33_NAMES,
    MEDIAPIPE33_TO_COCO17,
    SMPL24_NAMES,
)
from ntop.conventions import NUM_JOINTS, DataError

TORSO_NAMES = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
LIMB_NAMES = tuple(
    f"{side}_{part}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
)  # what cameras are refined on

# Offsets are learned in the frame of the bone that leads to the point, not of the bone behind it:
# a shoulder must not wander when the arm turns.
MEDIAPIPE_BONES = {
    "nose": "head", "left_eye": "head", "right_eye": "head", "left_ear": "head",
    "right_ear": "head", "left_shoulder": "spine3", "right_shoulder": "spine3",
    "left_elbow": "left_shoulder", "right_elbow": "right_shoulder", "left_wrist": "left_elbow",
    "right_wrist": "right_elbow", "left_pinky": "left_wrist", "right_pinky": "right_wrist",
    "left_index": "left_wrist", "right_index": "right_wrist", "left_hip": "pelvis",
    "right_hip": "pelvis", "left_knee": "left_hip", "right_knee": "right_hip",
    "left_ankle": "left_knee", "right_ankle": "right_knee", "left_heel": "left_ankle",
    "right_heel": "right_ankle", "left_foot_index": "left_ankle",
    "right_foot_index": "right_ankle",
}  # fmt: skip
MEDIAPIPE_SIGMA_M = {"hip": 0.04, "ear": 0.03, "nose": 0.03, "eye": 0.03, "pinky": 0.03}
DEFAULT_SIGMA_M = 0.02


@dataclass(frozen=True)
class Landmarks:
    """A skeleton's points on the body; `names` in the detector's order.

    Attributes:
        regressor: rows sum to one, over the 24 joints followed by all vertices; a row of zeros
            means that the body does not define this point (it gets no weight).
        bones: whose rest frame the offset of each point lives in.
        offset_sigma_m: how far the offset may go (prior); zero fixes it at zero.
        mirror: index of the same point on the other side (itself on the midline); offsets of a
            pair are mirror images.
    """

    names: tuple[str, ...]
    regressor: Float[Tensor, "landmark point"]
    bones: Int[Tensor, " landmark"]
    offset_sigma_m: Float[Tensor, " landmark"]
    mirror: Int[Tensor, " landmark"]

    @property
    def defined(self) -> Tensor:
        """Which points the body defines."""
        return self.regressor.abs().sum(-1) > 0

    def index(self, name: str) -> int:
        """Position of a point by name."""
        return self.names.index(name)


def landmarks_on(model: BodyModel, skeleton: str) -> Landmarks:
    """The landmarks of skeleton `smpl24`, `coco17` or `mediapipe33`.

    Raises:
        DataError: another skeleton.
    """
    num_points = NUM_JOINTS + model.v_template.shape[0]
    match skeleton:
        case "smpl24":
            return _without_offsets(
                SMPL24_NAMES, torch.eye(NUM_JOINTS, num_points), bones=range(NUM_JOINTS)
            )
        case "coco17":
            regressor = torch.zeros(17, num_points)
            regressor[:, NUM_JOINTS:] = model.coco17_regressor
            return _without_offsets(COCO17_NAMES, regressor, bones=COCO17_PARTS)
        case "mediapipe33":
            return _mediapipe(model, num_points)
    raise DataError(
        f"keypoints of skeleton {skeleton!r} cannot be fitted; expected smpl24, coco17 or "
        "mediapipe33"
    )


@dataclass(frozen=True)
class BlendedLandmarks:
    """Landmarks as blends of bone transforms: what a posed body's landmarks are, without vertices.

    Posed vertices are linear in the bones' transforms, hence so is any mean of them: landmark l is
    `sum_k G_k q_lk`, with `q` (homogeneous) linear in betas. Exact for models without pose offsets;
    pose offsets (millimetres at these points) are left out.
    """

    template: Float[Tensor, "landmark joint 4"]
    shapedirs: Float[Tensor, "landmark joint 4 beta"]

    def points(
        self,
        posed_from_rest: Float[Tensor, "*batch joint 4 4"],
        betas: Float[Tensor, " beta"],
    ) -> Float[Tensor, "*batch landmark 3"]:
        """Landmarks in the world (float64)."""
        blend = self.template + self.shapedirs @ betas
        return torch.einsum("...kij,lkj->...li", posed_from_rest[..., :3, :], blend)


def blend_landmarks(model: BodyModel, landmarks: Landmarks) -> BlendedLandmarks:
    """The landmarks of a body as blends of its bones (float64)."""
    regressor = landmarks.regressor.double()
    joints, chosen = regressor[:, :NUM_JOINTS], regressor[:, NUM_JOINTS:]
    vertices = torch.nonzero(chosen.abs().sum(0)).squeeze(-1)
    share = chosen[:, vertices, None] * model.lbs_weights[vertices].double()  # (landmark, v, joint)
    template = torch.einsum("lvk,vc->lkc", share, model.v_template[vertices].double())
    shape = torch.einsum("lvk,vcb->lkcb", share, model.shapedirs[vertices].double())
    template = template + joints[..., None] * model.joint_template.double()
    shape = shape + joints[..., None, None] * model.joint_shapedirs.double()
    weight = (share.sum(1) + joints)[..., None]
    return BlendedLandmarks(
        torch.cat([template, weight], -1),
        torch.cat([shape, torch.zeros_like(shape[:, :, :1])], -2),
    )


def reduced_model(model: BodyModel, vertices: Int[Tensor, " chosen"]) -> BodyModel:
    """A body whose "vertices" are the 24 joints followed by chosen vertices: cheap to pose.

    Joints become vertices that hang on their own bone alone, so that posing the reduced body gives
    exactly the joints and vertices of the full one. Float64.
    """
    bones = torch.eye(NUM_JOINTS, dtype=model.v_template.dtype)
    posedirs = model.posedirs
    if posedirs is not None:
        still = posedirs.new_zeros(NUM_JOINTS, *posedirs.shape[1:])
        posedirs = torch.cat([still, posedirs[vertices]])
    reduced = replace(
        model,
        v_template=torch.cat([model.joint_template, model.v_template[vertices]]),
        shapedirs=torch.cat([model.joint_shapedirs, model.shapedirs[vertices]]),
        posedirs=posedirs,
        joint_regressor=torch.eye(NUM_JOINTS, NUM_JOINTS + vertices.numel()),
        lbs_weights=torch.cat([bones, model.lbs_weights[vertices]]),
        coco17_regressor=torch.zeros(17, NUM_JOINTS + vertices.numel()),
        faces=torch.zeros(0, 3, dtype=torch.int64),
    )
    return reduced.to(torch.zeros(1, dtype=torch.float64))


def _without_offsets(
    names: tuple[str, ...], regressor: Tensor, *, bones: Iterable[int]
) -> Landmarks:
    return Landmarks(
        names=names,
        regressor=regressor,
        bones=torch.tensor(list(bones)),
        offset_sigma_m=torch.zeros(len(names)),
        mirror=_mirror(names),
    )


def _mediapipe(model: BodyModel, num_points: int) -> Landmarks:
    regressor = torch.zeros(len(MEDIAPIPE33_NAMES), num_points)
    regressor[list(MEDIAPIPE33_TO_COCO17), NUM_JOINTS:] = model.coco17_regressor
    for side in ("left", "right"):
        hand = SMPL24_NAMES.index(f"{side}_hand")  # the middle knuckle
        for finger in ("pinky", "index"):
            regressor[MEDIAPIPE33_NAMES.index(f"{side}_{finger}"), hand] = 1.0
        foot = _foot_vertices(model, side)
        depth = model.v_template[foot, 2]
        heel, toe = foot[depth.argsort()[:8]], foot[depth.argsort()[-8:]]
        for name, chosen in ((f"{side}_heel", heel), (f"{side}_foot_index", toe)):
            regressor[MEDIAPIPE33_NAMES.index(name), NUM_JOINTS + chosen] = 1.0 / len(chosen)
    bones, sigmas = [], []
    for index, name in enumerate(MEDIAPIPE33_NAMES):
        if name not in MEDIAPIPE_BONES:  # eye corners, mouth, thumbs: say nothing about the pose
            regressor[index] = 0
        bones.append(SMPL24_NAMES.index(MEDIAPIPE_BONES.get(name, "head")))
        sigmas.append(MEDIAPIPE_SIGMA_M.get(name.split("_")[-1], DEFAULT_SIGMA_M))
    return Landmarks(
        names=MEDIAPIPE33_NAMES,
        regressor=regressor,
        bones=torch.tensor(bones),
        offset_sigma_m=torch.tensor(sigmas),
        mirror=_mirror(MEDIAPIPE33_NAMES),
    )


def _foot_vertices(model: BodyModel, side: str) -> Int[Tensor, " vertex"]:
    labels = model.lbs_weights.argmax(-1)
    ankle, foot = SMPL24_NAMES.index(f"{side}_ankle"), SMPL24_NAMES.index(f"{side}_foot")
    return torch.nonzero((labels == ankle) | (labels == foot)).squeeze(-1)


def _mirror(names: tuple[str, ...]) -> Int[Tensor, " landmark"]:
    swap = {"left": "right", "right": "left"}
    other = ["_".join(swap.get(word, word) for word in name.split("_")) for name in names]
    return torch.tensor([names.index(name) for name in other])
