"""Motions written by hand, so that a capture needs no recorded clip, and motions by name.

Keyframes hold axis-angle vectors in degrees in body axes (x left, y up, z forward), eased from
key to key. Signs: hip forward -x, knee bent +x, spine forward +x; left arm down -z, forward -y,
left elbow bent -y; the right arm mirrors y and z.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ntop.body.deepmimic import load_motion
from ntop.body.motions import WORLD_FROM_BODY, Motion
from ntop.body.skeletons import SMPL24_NAMES
from ntop.conventions import NUM_JOINTS, ConfigError
from ntop.geometry.rotations import matrix_from_axis_angle, quaternion_from_matrix

AUTHORED_NAMES = ("range", "reach", "sit", "tpose_turn")

_RATE_HZ = 30
_THIGH_M = 0.41
_LEG_M = 0.82
_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class _Key:
    """One keyframe; joints that are not named are straight."""

    time_s: float
    heading_deg: float = 0.0  # counter-clockwise seen from above
    back_m: float = 0.0  # the pelvis behind its start
    joints_deg: dict[str, _Vector] = field(default_factory=dict)


def named_motion(name: str, clips: Path) -> Motion:
    """The motion of a sequence: `authored:<name>`, or `deepmimic:<name>` out of folder `clips`.

    Raises:
        ConfigError: Neither of the two, or no such motion.
        DataError: The clip's file cannot be used.
    """
    kind, _, title = name.partition(":")
    match kind:
        case "authored":
            return authored_motion(title)
        case "deepmimic":
            path = clips / f"humanoid3d_{title}.txt"
            if not path.is_file():
                have = sorted(p.stem.removeprefix("humanoid3d_") for p in clips.glob("human*.txt"))
                raise ConfigError(f"motion {name!r}: no file {path}; have {have}")
            return load_motion(path)
        case _:
            raise ConfigError(
                f"motion {name!r}: expected 'authored:<name>' or 'deepmimic:<name>'; authored are "
                f"{list(AUTHORED_NAMES)}"
            )


def authored_motion(name: str) -> Motion:
    """A looping motion from keyframes: `range`, `reach`, `sit` or `tpose_turn`.

    Raises:
        ConfigError: No motion of that name.
    """
    match name:
        case "tpose_turn":
            keys = [_Key(6.0 * i / 8, heading_deg=45.0 * i) for i in range(9)]
        case "sit":
            keys = _sit_keys()
        case "reach":
            keys = _reach_keys()
        case "range":
            keys = _range_keys()
        case _:
            raise ConfigError(
                f"no authored motion {name!r}, have {list(AUTHORED_NAMES)}; check the sequences"
            )
    return _motion_from_keys(keys)


def _arms(left: _Vector, right: _Vector) -> dict[str, _Vector]:
    return {"left_shoulder": left, "right_shoulder": right}


def _elbows(left_deg: float, right_deg: float) -> dict[str, _Vector]:
    return {"left_elbow": (0, -left_deg, 0), "right_elbow": (0, right_deg, 0)}


def _leg(side: str, *, hip_deg: float, knee_deg: float, out_deg: float = 0.0) -> dict[str, _Vector]:
    """A leg lifted forward by `hip_deg`, its foot kept level with the ground."""
    sign = 1.0 if side == "left" else -1.0
    return {
        f"{side}_hip": (-hip_deg, 0, sign * out_deg),
        f"{side}_knee": (knee_deg, 0, 0),
        f"{side}_ankle": (hip_deg - knee_deg, 0, -sign * out_deg),
    }


def _legs(*, hip_deg: float, knee_deg: float) -> dict[str, _Vector]:
    return {
        **_leg("left", hip_deg=hip_deg, knee_deg=knee_deg),
        **_leg("right", hip_deg=hip_deg, knee_deg=knee_deg),
    }


def _bend(forward_deg: float, *, twist_deg: float = 0.0, side_deg: float = 0.0) -> dict:
    """The trunk, shared by the three spine joints; twist to the left, side bend to the right."""
    third = (forward_deg / 3, twist_deg / 3, side_deg / 3)
    return {"spine1": third, "spine2": third, "spine3": third}


_ARMS_LOW = _arms((0, 0, -68), (0, 0, 68))


def _sit_keys() -> list[_Key]:
    """Stand, sit down on a seat of knee height, look around, stand up."""
    stand = _ARMS_LOW | _elbows(10, 10)
    lean = _legs(hip_deg=62, knee_deg=58) | _bend(28) | _ARMS_LOW | _elbows(25, 25)
    hands = _arms((0, -42, -58), (0, 42, 58)) | _elbows(38, 38)
    seated = _legs(hip_deg=90, knee_deg=90) | _bend(4) | hands
    keys = [
        (0.0, 0.0, stand),
        (0.7, _THIGH_M * math.sin(math.radians(62)), lean),
        (1.2, _THIGH_M, seated),
        (1.8, _THIGH_M, seated | {"neck": (5, 35, 0)} | _bend(8, twist_deg=15)),
        (2.4, _THIGH_M, seated | {"neck": (10, -35, 0)} | _bend(12, twist_deg=-15)),
        (2.9, _THIGH_M * math.sin(math.radians(62)), lean),
        (3.6, 0.0, stand),
    ]
    return [_Key(time, back_m=back, joints_deg=joints) for time, back, joints in keys]


def _reach_keys() -> list[_Key]:
    """Raise both hands overhead, then one after the other to the side and far up."""
    low = _ARMS_LOW | _elbows(10, 10)
    both = _arms((0, -20, 72), (0, 20, -72)) | _elbows(12, 12) | {"neck": (-15, 0, 0)}
    left = _arms((0, -10, 80), (0, 0, 60)) | _elbows(5, 20) | _bend(0, side_deg=-15)
    right = _arms((0, 0, -60), (0, 10, -80)) | _elbows(20, 5) | _bend(0, side_deg=15)
    poses = [low, both, left, both, right, low]
    return [_Key(0.8 * i, heading_deg=72.0 * i, joints_deg=pose) for i, pose in enumerate(poses)]


def _range_keys() -> list[_Key]:
    """Every limb through its range while the body turns once around, in eight seconds."""
    poses = [
        _ARMS_LOW,
        {},
        _arms((0, 0, 55), (0, 0, -55)) | _elbows(10, 10) | {"neck": (-20, 0, 0)},
        _arms((0, -75, -10), (0, 75, 10)) | _elbows(15, 15)
        | _leg("left", hip_deg=80, knee_deg=90) | {"neck": (10, 25, 0)},
        _arms((0, -10, 0), (0, 10, 0)) | _elbows(90, 90) | _bend(0, twist_deg=40)
        | _leg("right", hip_deg=0, knee_deg=0, out_deg=30),
        _arms((0, -50, -40), (0, 50, 40)) | _elbows(20, 20) | _bend(50)
        | _legs(hip_deg=15, knee_deg=20) | {"neck": (-20, 0, 0)},
        _arms((0, -20, 60), (0, 30, 60)) | _elbows(60, 100) | _bend(0, side_deg=20)
        | _leg("right", hip_deg=75, knee_deg=85),
        _arms((0, -80, 0), (0, 80, 0)) | _elbows(5, 5) | _bend(25)
        | _legs(hip_deg=85, knee_deg=105),
        _arms((0, 0, 40), (0, 0, -40)) | _elbows(125, 125) | _bend(0, twist_deg=-40)
        | {"neck": (0, -30, 0)},
        _arms((0, 30, -50), (0, 60, 30)) | _elbows(30, 50)
        | _leg("left", hip_deg=45, knee_deg=45)
        | {"right_hip": (25, 0, 0), "right_knee": (15, 0, 0), "right_ankle": (-20, 0, 0)},
        _ARMS_LOW,
    ]  # fmt: skip
    return [_Key(0.8 * i, heading_deg=36.0 * i, joints_deg=pose) for i, pose in enumerate(poses)]


def _motion_from_keys(keys: list[_Key]) -> Motion:
    """Sample the keyframes with smooth starts and stops; the heading turns evenly."""
    key_times = torch.tensor([key.time_s for key in keys], dtype=torch.float64)
    joints = torch.zeros(len(keys), NUM_JOINTS, 3, dtype=torch.float64)
    for row, key in enumerate(keys):
        for name, vector in key.joints_deg.items():
            joints[row, SMPL24_NAMES.index(name)] = torch.deg2rad(
                torch.tensor(vector, dtype=torch.float64)
            )
    heading = torch.deg2rad(torch.tensor([key.heading_deg for key in keys], dtype=torch.float64))
    back = torch.tensor([key.back_m for key in keys], dtype=torch.float64)

    count = round(float(key_times[-1]) * _RATE_HZ)
    times = torch.arange(count + 1, dtype=torch.float64) / _RATE_HZ
    after = torch.searchsorted(key_times, times, right=True).clamp(1, len(keys) - 1)
    span = key_times[after] - key_times[after - 1]
    linear = ((times - key_times[after - 1]) / span).clamp(0, 1)
    eased = linear * linear * (3 - 2 * linear)

    rotations = matrix_from_axis_angle(
        torch.lerp(joints[after - 1], joints[after], eased[:, None, None])
    )
    heading = torch.lerp(heading[after - 1], heading[after], linear)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    world_from_body = torch.tensor(WORLD_FROM_BODY, dtype=torch.float64)
    facing = matrix_from_axis_angle(heading[:, None] * up)
    rotations[:, 0] = facing @ world_from_body @ rotations[:, 0]
    backward = facing @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # faces -y at heading 0
    pelvis = torch.lerp(back[after - 1], back[after], eased)[:, None] * backward + _LEG_M * up
    return Motion(
        times_s=times,
        quaternions=quaternion_from_matrix(rotations),
        pelvis_world_m=pelvis,
        leg_length_m=_LEG_M,
        loops=True,
        leaves_floor=False,
    )
