import json
import math
from pathlib import Path

import pytest
import torch

from ntop.body.authored_motions import AUTHORED_NAMES, authored_motion, named_motion
from ntop.body.deepmimic import load_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget, sample_motion
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import pose_body, pose_joints
from ntop.conventions import ConfigError, DataError
from ntop.geometry.rotations import axis_angle_from_matrix, matrix_from_quaternion

MODEL = load_body_model()
SHAPES = {"mean": torch.zeros(10), "short": torch.tensor([-2.0, 1.0] + [0.0] * 8)}
JOINT = {name: index for index, name in enumerate(SMPL24_NAMES)}

# Columns of DeepMimic's humanoid (DeepMimic axes: x forward, y up, z right).
ROOT, ROOT_TURN, CHEST = 1, 4, 8
RIGHT_HIP, RIGHT_KNEE, RIGHT_SHOULDER, RIGHT_ELBOW = 16, 20, 25, 29
QUATERNIONS = (4, 8, 12, 16, 21, 25, 30, 35, 39)


def quaternion(axis: tuple[float, float, float], degrees: float) -> list[float]:
    half = math.radians(degrees) / 2
    return [math.cos(half), *(math.sin(half) * x for x in axis)]


def frame(*, duration_s: float = 0.1, **columns: list[float]) -> list[float]:
    """A standing frame with some columns replaced, e.g. `at_16=[...]`."""
    row = [duration_s] + [0.0] * 43
    row[ROOT + 1] = 0.85
    for start in QUATERNIONS:
        row[start] = 1.0
    for name, values in columns.items():
        start = int(name.removeprefix("at_"))
        row[start : start + len(values)] = values
    return row


def write_clip(path: Path, frames: list[list[float]], *, loop: str = "none") -> Path:
    path.write_text(json.dumps({"Loop": loop, "Frames": frames}), encoding="utf-8")
    return path


def joints_of(path: Path, *times_s: float) -> torch.Tensor:
    pose = retarget(load_motion(path), MODEL, torch.zeros(10), frame_times_s=torch.tensor(times_s))
    return pose_joints(MODEL, pose)


def lowest_m(pose) -> torch.Tensor:
    return pose_body(MODEL, pose).vertices[..., 2].amin(-1)


# --- authored -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", AUTHORED_NAMES)
@pytest.mark.parametrize("shape", SHAPES)
def test_something_touches_the_floor_in_every_frame(name, shape):
    motion = authored_motion(name)
    times = torch.linspace(0, 1.3 * motion.duration_s, 17)
    pose = retarget(motion, MODEL, SHAPES[shape], frame_times_s=times)
    assert lowest_m(pose).abs().max() < 1e-5  # metres; float32
    assert pose_joints(MODEL, pose)[0, 0, :2].abs().max() < 1e-5


def test_sitting_puts_the_pelvis_at_knee_height_with_still_feet():
    motion = authored_motion("sit")
    times = torch.tensor([0.0, 0.7, 1.2, 1.8])
    joints = pose_joints(MODEL, retarget(motion, MODEL, torch.zeros(10), frame_times_s=times))
    pelvis, knee, ankle = (joints[:, JOINT[name]] for name in ("pelvis", "left_knee", "left_ankle"))
    assert 0.90 < pelvis[0, 2] < 1.05
    for seated in (2, 3):
        assert (pelvis[seated, 2] - knee[seated, 2] - 0.08).abs() < 0.02  # hips lie below it
        assert knee[seated, 1] < pelvis[seated, 1] - 0.35  # thighs forward, towards -y
    assert (ankle[1:] - ankle[0]).norm(dim=-1).max() < 0.06


def test_tpose_turn_turns_evenly_with_arms_out():
    motion = authored_motion("tpose_turn")
    times = torch.tensor([0.0, 1.5, 3.0, 6.0])
    joints = pose_joints(MODEL, retarget(motion, MODEL, torch.zeros(10), frame_times_s=times))
    reach = joints[:, JOINT["left_wrist"]] - joints[:, JOINT["right_wrist"]]
    expected = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)]  # counter-clockwise from above
    for vector, direction in zip(reach, expected, strict=True):
        torch.testing.assert_close(
            vector / vector.norm(), torch.tensor(direction).float(), atol=5e-3, rtol=0
        )


def test_range_moves_every_limb_and_shows_every_side():
    motion = authored_motion("range")
    quaternions = motion.quaternions
    angles = axis_angle_from_matrix(matrix_from_quaternion(quaternions)).norm(dim=-1)
    for side in ("left", "right"):
        for limb, least_deg in (("shoulder", 60), ("elbow", 90), ("hip", 70), ("knee", 80)):
            assert math.degrees(angles[:, JOINT[f"{side}_{limb}"]].max()) > least_deg
    forward = matrix_from_quaternion(quaternions[:, 0])[:, :2, 2]
    heading = torch.atan2(forward[:, 1], forward[:, 0]).sort().values
    assert heading.diff().max() < math.radians(10)


def test_raised_hands_are_above_the_head():
    motion = authored_motion("reach")
    pose = retarget(motion, MODEL, torch.zeros(10), frame_times_s=torch.tensor([0.8]))
    joints = pose_joints(MODEL, pose)[0]
    for side in ("left", "right"):
        assert joints[JOINT[f"{side}_wrist"], 2] > joints[JOINT["head"], 2] + 0.2


@pytest.mark.parametrize("name", AUTHORED_NAMES)
def test_authored_loops_close(name):
    motion = authored_motion(name)
    ends = motion.times_s[-1] + torch.tensor([-1e-6, 1e-6])
    before, after = pose_joints(MODEL, retarget(motion, MODEL, torch.zeros(10), frame_times_s=ends))
    assert (before - after).norm(dim=-1).max() < 1e-4


def test_a_frame_does_not_depend_on_the_others_asked_for():
    motion = authored_motion("range")
    times = torch.tensor([0.3, 2.9, 5.1])
    together = retarget(motion, MODEL, torch.zeros(10), frame_times_s=times)
    for index in range(3):
        alone = retarget(motion, MODEL, torch.zeros(10), frame_times_s=times[index : index + 1])
        torch.testing.assert_close(alone.body_pose[0], together.body_pose[index])
        torch.testing.assert_close(alone.transl[0], together.transl[index], atol=1e-6, rtol=0)


def test_between_samples_a_joint_turns_at_constant_speed(tmp_path):
    frames = [frame(**{f"at_{RIGHT_HIP}": quaternion((0, 0, 1), angle)}) for angle in (0.0, 80.0)]
    motion = load_motion(write_clip(tmp_path / "hip.txt", frames))
    sample = sample_motion(motion, torch.tensor([0.0, 0.025, 0.05, 0.1], dtype=torch.float64))
    turned = matrix_from_quaternion(sample.quaternions[:, JOINT["right_hip"]])
    angles = torch.rad2deg(axis_angle_from_matrix(turned).norm(dim=-1))
    expected = torch.tensor([0.0, 20.0, 40.0, 80.0], dtype=torch.float64)
    torch.testing.assert_close(angles, expected, atol=1e-9, rtol=0)


def test_half_turns_are_crossed_the_short_way(tmp_path):
    frames = [
        frame(**{f"at_{ROOT_TURN}": quaternion((0, 1, 0), angle)}) for angle in (170.0, 190.0)
    ]
    motion = load_motion(write_clip(tmp_path / "turn.txt", frames))
    sample = sample_motion(motion, torch.tensor([0.05], dtype=torch.float64))
    forward = matrix_from_quaternion(sample.quaternions[0, 0])[:, 2]
    expected = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # half a turn from -y
    torch.testing.assert_close(forward, expected, atol=1e-9, rtol=0)


# --- DeepMimic files, written here in their layout ------------------------------------------------


def test_a_standing_clip_stands_with_hanging_arms(tmp_path):
    joints = joints_of(write_clip(tmp_path / "stand.txt", [frame(), frame()]), 0.0)[0]
    assert joints[JOINT["head"], 2] > 1.4
    for side, sign in (("left", 1), ("right", -1)):
        shoulder, elbow, wrist = (
            joints[JOINT[f"{side}_{part}"]] for part in ("shoulder", "elbow", "wrist")
        )
        for upper, lower in ((shoulder, elbow), (elbow, wrist)):
            down = (lower - upper) / (lower - upper).norm()
            torch.testing.assert_close(down, torch.tensor([0.0, 0.0, -1.0]), atol=0.01, rtol=0)
        assert sign * shoulder[0] > 0.1  # facing -y, left is +x


def test_hinges_and_hips_bend_the_right_way(tmp_path):
    bent = frame(
        **{
            f"at_{RIGHT_KNEE}": [-math.pi / 2],  # DeepMimic's knees bend with negative angles
            f"at_{RIGHT_ELBOW}": [math.pi / 2],
            "at_30": quaternion((0, 0, 1), 90),  # left hip, about "right": thigh forward
        }
    )
    joints = joints_of(write_clip(tmp_path / "bent.txt", [bent, bent]), 0.0)[0]

    def bone(start: str, end: str) -> torch.Tensor:
        vector = joints[JOINT[end]] - joints[JOINT[start]]
        return vector / vector.norm()

    forward, backward = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(bone("right_knee", "right_ankle"), backward, atol=0.01, rtol=0)
    torch.testing.assert_close(bone("right_elbow", "right_wrist"), forward, atol=0.01, rtol=0)
    torch.testing.assert_close(bone("left_hip", "left_knee"), forward, atol=0.01, rtol=0)


def test_shoulder_chest_and_root_rotations_change_basis(tmp_path):
    # Right arm raised sideways: about DeepMimic's x (forward) by -90, so that down turns right.
    row = frame(
        **{
            f"at_{RIGHT_SHOULDER}": quaternion((1, 0, 0), -90),
            f"at_{ROOT_TURN}": quaternion((0, 1, 0), 90),  # a quarter turn to the left
        }
    )
    joints = joints_of(write_clip(tmp_path / "arm.txt", [row, row]), 0.0)[0]
    arm = joints[JOINT["right_wrist"]] - joints[JOINT["right_shoulder"]]
    # now faces +x, so the right is -y
    torch.testing.assert_close(arm / arm.norm(), torch.tensor([0.0, -1.0, 0.0]), atol=0.01, rtol=0)
    bow = frame(**{f"at_{CHEST}": quaternion((0, 0, 1), -60)})
    joints = joints_of(write_clip(tmp_path / "bow.txt", [bow, bow]), 0.0)[0]
    trunk = joints[JOINT["neck"]] - joints[JOINT["spine3"]]
    lean = math.degrees(math.atan2(-trunk[1], trunk[2]))
    assert abs(lean - 60) < 3  # the resting neck is not exactly above the chest


def test_a_frame_lasts_as_long_as_its_own_column_says(tmp_path):
    frames = [
        frame(duration_s=0.1),
        frame(duration_s=0.3, at_1=[0.1, 0.85, 0.0]),
        frame(duration_s=0.0, at_1=[0.4, 0.85, 0.0]),  # the last one's does not count
    ]
    motion = load_motion(write_clip(tmp_path / "uneven.txt", frames))
    assert motion.times_s.tolist() == pytest.approx([0.0, 0.1, 0.4])


def test_a_clip_starts_over_the_origin_wherever_it_was_recorded(tmp_path):
    rows = [frame(at_1=[x, 0.85, 7.0]) for x in (3.0, 3.5)]
    pelvis = joints_of(write_clip(tmp_path / "far.txt", rows), 0.0, 0.1)[:, 0]
    assert pelvis[0, :2].abs().max() < 1e-5
    assert -0.55 < pelvis[1, 1] < -0.45


def walk(tmp_path: Path, *, loop: str) -> Path:
    """A stiff walk of 0.4 m in 0.4 s with slightly bobbing root, legs swinging in antiphase."""
    frames = []
    for step in range(5):
        swing = 25 * math.cos(math.pi * step / 2)
        frames.append(
            frame(
                **{
                    f"at_{ROOT}": [0.1 * step, 0.85 + 0.02 * (step % 2), 0.0],
                    f"at_{RIGHT_HIP}": quaternion((0, 0, 1), swing),
                    "at_30": quaternion((0, 0, 1), -swing),
                }
            )
        )
    return write_clip(tmp_path / "humanoid3d_walk.txt", frames, loop=loop)


def test_walking_goes_forward_on_the_floor_at_hip_height(tmp_path):
    times = torch.linspace(0, 0.4, 9)
    pose = retarget(
        load_motion(walk(tmp_path, loop="none")), MODEL, torch.zeros(10), frame_times_s=times
    )
    posed = pose_body(MODEL, pose)
    assert posed.vertices[..., 2].amin(-1).abs().max() < 1e-5
    pelvis = posed.joints[:, 0]
    assert 0.85 < float(pelvis[:, 2].min()) <= float(pelvis[:, 2].max()) < 1.02
    leg_ratio = 0.828 / 0.8314  # this body's legs to DeepMimic's
    torch.testing.assert_close(
        pelvis[-1, :2] - pelvis[0, :2], torch.tensor([0.0, -0.4 * leg_ratio]), atol=2e-3, rtol=0
    )


def test_a_looping_walk_goes_on_and_another_stops(tmp_path):
    times = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    loop = sample_motion(load_motion(walk(tmp_path, loop="wrap")), times)
    travelled = loop.pelvis_world_m[1:] - loop.pelvis_world_m[:-1]
    expected = torch.tensor([0.0, -0.4, 0.0], dtype=torch.float64).expand(2, 3)
    torch.testing.assert_close(travelled, expected, atol=1e-9, rtol=0)
    torch.testing.assert_close(loop.quaternions[2], loop.quaternions[0], atol=1e-9, rtol=0)
    once = sample_motion(load_motion(walk(tmp_path, loop="none")), times)
    torch.testing.assert_close(once.pelvis_world_m[2], once.pelvis_world_m[1], atol=0, rtol=0)


def test_a_loop_that_turns_goes_on_in_its_new_direction(tmp_path):
    turning = [
        frame(**{f"at_{ROOT}": [0.0, 0.85, 0.0]}),
        frame(**{f"at_{ROOT}": [0.4, 0.85, 0.0], f"at_{ROOT_TURN}": quaternion((0, 1, 0), 90)}),
    ]
    motion = load_motion(write_clip(tmp_path / "turn.txt", turning, loop="wrap"))
    sample = sample_motion(motion, torch.tensor([0.0, 0.1, 0.2, 0.3], dtype=torch.float64))
    expected = torch.tensor([[0, 0], [0, -0.4], [0.4, -0.4], [0.4, 0]], dtype=torch.float64)
    torch.testing.assert_close(sample.pelvis_world_m[:, :2], expected, atol=1e-9, rtol=0)


def leap_frames() -> list[list[float]]:
    """Standing, a ballistic leap of 0.4 s (0.196 m high), standing; straight legs."""
    frames = []
    for step in range(37):
        time_s = step / 30 - 0.4
        height = 0.5 * 9.81 * time_s * (0.4 - time_s) if 0 < time_s < 0.4 else 0.0
        frames.append(frame(duration_s=1 / 30, **{f"at_{ROOT}": [0.0, 0.85 + height, 0.0]}))
    return frames


def test_only_clips_that_leave_the_floor_leave_it(tmp_path):
    frames = [0, 5, 10, 18, 26, 36]
    times = torch.tensor(frames) / 30
    heights = {}
    for name in ("jump", "crawl"):
        motion = load_motion(write_clip(tmp_path / f"humanoid3d_{name}.txt", leap_frames()))
        heights[name] = lowest_m(retarget(motion, MODEL, torch.zeros(10), frame_times_s=times))
        assert heights[name].min() > -1e-5
    assert heights["crawl"].max() < 1e-5
    assert 0.15 < heights["jump"].max() < 0.18  # 0.196 m less the dead band of 0.03 m
    assert heights["jump"].argmax() == frames.index(18)  # half way through the leap
    assert heights["jump"][[0, 1, 2, 4, 5]].max() < 1e-5


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("walk", "not a DeepMimic clip"),
        ('{"Frames": [[1.0]]}', "Loop"),
        (json.dumps({"Loop": "wrap", "Frames": [[0.1] * 20] * 3}), r"\(3, 20\).*44"),  # quadruped
        (json.dumps({"Loop": "wrap", "Frames": [[0.1] * 44]}), r"\(1, 44\)"),
        (json.dumps({"Loop": "wrap", "Frames": [[0.1] * 44, [0.1] * 43]}), "not a DeepMimic clip"),
        (json.dumps({"Loop": "wrap", "Frames": [[0.0] * 44] * 2}), "lasts 0.0 s"),
    ],
)
def test_other_files_are_refused(tmp_path, content, words):
    path = tmp_path / "clip.txt"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(DataError, match=rf"clip\.txt.*{words}"):
        load_motion(path)


def test_motions_by_name(tmp_path):
    walk(tmp_path, loop="wrap")
    assert named_motion("deepmimic:walk", tmp_path).loops
    assert named_motion("authored:sit", tmp_path).duration_s == pytest.approx(3.6)
    with pytest.raises(ConfigError, match=r"deepmimic:fly.*\['walk'\]"):
        named_motion("deepmimic:fly", tmp_path)
    with pytest.raises(ConfigError, match=r"'fly'.*tpose_turn"):
        named_motion("authored:fly", tmp_path)
    with pytest.raises(ConfigError, match="expected 'authored:<name>'"):
        named_motion("sit", tmp_path)
