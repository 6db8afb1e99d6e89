"""Poses in which skin folds or parts of the body lie against each other, of the embedded body.

Joints in degrees, in body axes (x left, y up, z forward). Signs: hip forward -x, knee bent +x; left
arm down -z, forward -y, left elbow bent -y; the right arm mirrors y and z.
"""

import math

import torch

from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose

UPRIGHT, ON_THE_BACK = (90.0, 0.0, 0.0), (0.0, 0.0, 0.0)  # the body frame turned about world x
TRANSL_WORLD = (0.3, -0.2, 0.9)

Joints = dict[str, tuple[float, float, float]]


def _arms(x: float, y: float, z: float, *, elbow: float) -> Joints:
    return {
        "left_shoulder": (x, y, z),
        "right_shoulder": (x, -y, -z),
        "left_elbow": (0, -elbow, 0),
        "right_elbow": (0, elbow, 0),
    }


def _legs(*, hip: float, knee: float, out: float = 0.0) -> Joints:
    return {
        "left_hip": (-hip, 0, out),
        "right_hip": (-hip, 0, -out),
        "left_knee": (knee, 0, 0),
        "right_knee": (knee, 0, 0),
    }


HARD_POSES: dict[str, Joints] = {
    "elbows at 140": _arms(0, -20, -30, elbow=140),
    "knees at 140": _arms(0, -70, -20, elbow=10) | _legs(hip=100, knee=140, out=15),
    "crossed arms": {
        "left_shoulder": (0, -35, -65),
        "right_shoulder": (0, 45, 70),
        "left_elbow": (0, -105, 0),
        "right_elbow": (0, 112, 0),
    },
    "hands on hips": _arms(60, 22, -55, elbow=110),
    "sitting": _arms(0, -42, -58, elbow=38) | _legs(hip=90, knee=90),
    "lying": {
        "left_shoulder": (0, 0, -60),
        "right_shoulder": (0, 0, 30),
        "left_elbow": (0, -20, 0),
        "right_elbow": (0, 100, 0),
        "left_hip": (-40, 0, 0),
        "left_knee": (70, 0, 0),
    },
    "raised hands": _arms(0, -20, 72, elbow=12),
}


def hard_pose(name: str) -> BodyPose:
    """One of them, float64, pelvis about a metre above the ground (on it: lying)."""
    orientation = ON_THE_BACK if name == "lying" else UPRIGHT
    joints = torch.zeros(len(SMPL24_NAMES), 3, dtype=torch.float64)
    joints[0] = torch.tensor(orientation)
    for joint, angles in HARD_POSES[name].items():
        joints[SMPL24_NAMES.index(joint)] = torch.tensor(angles, dtype=torch.float64)
    joints *= math.pi / 180
    return BodyPose(
        betas=torch.zeros(10, dtype=torch.float64),
        global_orient=joints[0],
        body_pose=joints[1:].flatten(),
        transl=torch.tensor(TRANSL_WORLD, dtype=torch.float64),
    )
