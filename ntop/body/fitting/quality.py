"""Whether fitted bodies can be true: bone lengths, height, upright, errors per frame."""

from jaxtyping import Bool, Float
from torch import Tensor

from ntop.body.landmarks import Landmarks
from ntop.body.model import BodyModel
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import rest_body
from ntop.conventions import DataError

HEIGHT_RANGE_M = (1.2, 2.2)
MAX_JOINT_ERROR_MM = 80.0  # median over landmarks: beyond, limbs are mixed up
MIN_LANDMARKS = 8
BONES = (
    ("shoulder", "elbow"),
    ("elbow", "wrist"),
    ("hip", "knee"),
    ("knee", "ankle"),
)


def bone_length_spread_mm(
    points_world: Float[Tensor, "frame landmark 3"],
    valid: Bool[Tensor, "frame landmark"],
    landmarks: Landmarks,
) -> dict[str, float]:
    """Standard deviation over frames of each limb bone's triangulated length, in millimetres.

    A bone seen in fewer than three frames is left out.
    """
    spread = {}
    for side in ("left", "right"):
        for start, end in BONES:
            a, b = landmarks.index(f"{side}_{start}"), landmarks.index(f"{side}_{end}")
            seen = valid[:, a] & valid[:, b]
            if int(seen.sum()) >= 3:
                length = (points_world[seen, a] - points_world[seen, b]).norm(dim=-1)
                spread[f"{side}_{start}_{end}"] = 1000 * float(length.std())
    return spread


def body_height_m(model: BodyModel, betas: Float[Tensor, " beta"]) -> float:
    """Height of the standing rest body.

    Raises:
        DataError: it is no person's height, so units or cameras are wrong.
    """
    vertical = rest_body(model, betas).vertices[:, 1]
    height = float(vertical.max() - vertical.min())
    low, high = HEIGHT_RANGE_M
    if not low <= height <= high:
        raise DataError(
            f"fitted body is {height:.2f} m tall, expected {low}-{high} m; check the unit of the "
            "calibration"
        )
    return height


def check_upright(joints_world: Float[Tensor, "frame 24 3"], where: str) -> None:
    """Refuse a recording in which the person stands on his head most of the time.

    Raises:
        DataError: the head is well below the feet in more than half of the frames.
    """
    z = joints_world[..., 2]
    feet = z[:, [SMPL24_NAMES.index("left_ankle"), SMPL24_NAMES.index("right_ankle")]].mean(-1)
    below = z[:, SMPL24_NAMES.index("head")] < feet - 0.3
    if float(below.double().mean()) > 0.5:
        raise DataError(
            f"{where}: the head is below the feet in {int(below.sum())} of {len(below)} frames; "
            "the source's world is not z-up: correct its reader"
        )


def frame_reasons(
    valid: Bool[Tensor, "frame landmark"], errors_mm: Float[Tensor, " frame"]
) -> list[str]:
    """Why a frame's body is not usable; empty where it is."""
    reasons = []
    for count, error in zip(valid.sum(-1).tolist(), errors_mm.tolist(), strict=True):
        if count < MIN_LANDMARKS:
            reasons.append(f"{count} triangulated landmarks, need {MIN_LANDMARKS}")
        elif error > MAX_JOINT_ERROR_MM:
            reasons.append(f"landmarks miss the body by {error:.0f} mm (median)")
        else:
            reasons.append("")
    return reasons
