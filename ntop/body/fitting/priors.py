"""What a human pose is likely to be, where the cameras leave it open.

Axes are those of the rest pose (T-pose, y up, facing +z, left = +x), radians. A knee bends about
+x; the left elbow about -y, the right one about +y. All terms are squared and divided by the
square of a spread, so that they add up with the observations' as one log-likelihood.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.skeletons import SMPL24_NAMES

# Spread of each rotation component. Left sides stand for both. Small values are no stiffness but
# axes that the joint does not have.
SPREAD_RAD = {
    "left_hip": (0.7, 0.3, 0.35), "left_knee": (0.8, 0.06, 0.06),
    "left_ankle": (0.3, 0.15, 0.2), "left_foot": (0.02, 0.02, 0.02),
    "spine1": (0.2, 0.15, 0.15), "spine2": (0.2, 0.15, 0.15), "spine3": (0.2, 0.15, 0.15),
    "neck": (0.25, 0.25, 0.2), "head": (0.25, 0.25, 0.2), "left_collar": (0.1, 0.15, 0.15),
    "left_shoulder": (0.6, 0.9, 0.9), "left_elbow": (0.4, 1.2, 0.06),
    "left_wrist": (0.15, 0.3, 0.3), "left_hand": (0.02, 0.02, 0.02),
}  # fmt: skip
# Range of a component where anatomy ends it, (lowest, highest). Right sides mirror: x keeps its
# sign, y and z change it.
LIMITS_RAD = {
    ("left_knee", 0): (0.0, 2.6), ("left_elbow", 1): (-2.6, 0.0), ("left_hip", 0): (-2.3, 0.6),
    ("left_hip", 1): (-0.7, 0.9), ("left_hip", 2): (-0.6, 1.2), ("left_ankle", 0): (-0.6, 0.9),
    ("left_wrist", 2): (-1.2, 1.2), ("left_elbow", 0): (-1.4, 1.4),
}  # fmt: skip
LIMIT_SPREAD_RAD = 0.05


def spreads() -> Float[Tensor, "23 3"]:
    """Spread of every component of `body_pose`, in radians."""
    rows = [SPREAD_RAD[name.replace("right", "left")] for name in SMPL24_NAMES[1:]]
    return torch.tensor(rows, dtype=torch.float64)


def limits() -> tuple[Float[Tensor, "23 3"], Float[Tensor, "23 3"]]:
    """Lowest and highest value of every component of `body_pose`, in radians (open: +-pi)."""
    low = torch.full((23, 3), -torch.pi, dtype=torch.float64)
    high = torch.full((23, 3), torch.pi, dtype=torch.float64)
    for (name, axis), (lowest, highest) in LIMITS_RAD.items():
        left = SMPL24_NAMES.index(name) - 1
        right = SMPL24_NAMES.index(name.replace("left", "right")) - 1
        low[left, axis], high[left, axis] = lowest, highest
        mirrored = (lowest, highest) if axis == 0 else (-highest, -lowest)
        low[right, axis], high[right, axis] = mirrored
    return low, high


def pose_penalty(body_pose: Float[Tensor, "*batch 69"]) -> Float[Tensor, "*batch"]:
    """Squared distance from the rest pose in spreads, plus what lies beyond the limits."""
    angles = body_pose.unflatten(-1, (23, 3))
    low, high = limits()
    beyond = (angles - high).clamp(min=0) + (low - angles).clamp(min=0)
    within = (angles / spreads()).square().sum((-1, -2))
    return within + (beyond / LIMIT_SPREAD_RAD).square().sum((-1, -2))
