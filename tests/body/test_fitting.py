"""The fit: bodies whose truth is known are recovered, and what is held out stays held out."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ntop.body.fitting import actor, solver
from ntop.body.fitting.actor import fit_actor, neighbours
from ntop.body.fitting.contours import View, matte_border
from ntop.body.fitting.initial import initial_pose
from ntop.body.fitting.observations import LandmarkRays, triangulated_landmarks
from ntop.body.fitting.priors import limits, pose_penalty
from ntop.body.fitting.quality import body_height_m, check_upright, frame_reasons
from ntop.body.fitting.recordings import Recording, landmark_rays
from ntop.body.fitting.rig import refine_recordings
from ntop.body.fitting.silhouettes import draw_silhouette, silhouette_iou
from ntop.body.fitting.solver import FitSettings
from ntop.body.landmarks import (
    LIMB_NAMES,
    blend_landmarks,
    landmarks_on,
    reduced_model,
)
from ntop.body.model import load_body_model
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose, pose_body, pose_joints
from ntop.conventions import DataError
from ntop.geometry.calibration import RefinementSettings
from ntop.geometry.cameras import Camera, Pinhole
from ntop.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle

MODEL = load_body_model()
LENS = Pinhole(500.0, 500.0, 250.0, 250.0, 500, 500, (-0.05, 0.1, 5e-4, 5e-4, 0.0))
SETTINGS = FitSettings(landmark_px=2.0)
# y up, facing +z -> z up, facing -y
UPRIGHT = torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64)


def ring(count: int) -> list[Camera]:
    """Cameras around a person at the origin, slightly above his hips."""
    cameras = []
    for index in range(count):
        angle = 2 * math.pi * index / count + 0.3
        forward = -torch.tensor([math.cos(angle), math.sin(angle), 0.15], dtype=torch.float64)
        forward = forward / forward.norm()
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        center = -3.0 * forward + torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64)
        cameras.append(Camera(LENS, center, rotation))
    return cameras


def some_poses(count: int, seed: int = 0) -> BodyPose:
    """A person who turns, bends elbows and knees, and lifts his arms."""
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    angles = torch.zeros(count, 23, 3, dtype=torch.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        angles[:, SMPL24_NAMES.index(f"{side}_shoulder") - 1, 2] = sign * between(-1.0, 0.5)
        angles[:, SMPL24_NAMES.index(f"{side}_shoulder") - 1, 1] = sign * between(-0.7, 0.2)
        angles[:, SMPL24_NAMES.index(f"{side}_elbow") - 1, 1] = -sign * between(0.2, 1.6)
        angles[:, SMPL24_NAMES.index(f"{side}_hip") - 1, 0] = between(-1.0, 0.1)
        angles[:, SMPL24_NAMES.index(f"{side}_knee") - 1, 0] = between(0.1, 1.2)
    angles[:, SMPL24_NAMES.index("spine2") - 1, 0] = between(0.0, 0.3)
    spin = torch.zeros(count, 3, dtype=torch.float64)
    spin[:, 2] = between(-1.5, 1.5)
    matrices = matrix_from_axis_angle(spin) @ matrix_from_axis_angle(UPRIGHT)
    betas = torch.tensor([0.5, -0.8, 0.3, 0.4, -0.5, 0.2, 0.3, -0.2, 0.1, 0.2]).double()
    transl = torch.stack([between(-0.2, 0.2), between(-0.2, 0.2), between(-0.1, 0.1)], -1)
    return BodyPose(
        betas.expand(count, -1), axis_angle_from_matrix(matrices), angles.flatten(1), transl
    )


def record(
    poses: BodyPose,
    cameras: list[Camera],
    *,
    skeleton: str,
    noise_px: float,
    offsets_m: dict[str, tuple[float, float, float]] | None = None,
) -> Recording:
    """Keypoints of known bodies; `offsets_m` displaces landmarks in their bones' rest frames."""
    landmarks = landmarks_on(MODEL, skeleton)
    posed = pose_body(MODEL.to(poses.betas), poses)
    points = blend_landmarks(MODEL, landmarks).points(posed.posed_from_rest, poses.betas[0])
    for name, offset in (offsets_m or {}).items():
        index = landmarks.index(name)
        turn = posed.posed_from_rest[:, landmarks.bones[index], :3, :3]
        points[:, index] += turn @ torch.tensor(offset, dtype=torch.float64)
    pixels = torch.stack([camera.project(points)[0] for camera in cameras], 1)
    generator = torch.Generator().manual_seed(4)
    pixels += noise_px * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return Recording(
        source="made", actor="up", action="move", frames=tuple(range(len(points))),
        views=tuple(f"cam{i}" for i in range(len(cameras))), cameras=tuple(cameras),
        skeleton=skeleton, pixels=pixels,
        confidence=torch.ones(pixels.shape[:-1], dtype=torch.float64) * landmarks.defined,
    )  # fmt: skip


def rays_of(recording: Recording) -> LandmarkRays:
    landmarks = landmarks_on(MODEL, recording.skeleton)
    return landmark_rays([recording], landmarks, min_confidence=0.3)


def fitted(recording: Recording, views: list[View] | None = None, **options):
    # unrelated poses: frames ten apart are not smoothed
    return fit_actor(
        MODEL, landmarks_on(MODEL, recording.skeleton), rays_of(recording), views or [],
        frames=[("move", 10 * frame) for frame in recording.frames],
        outlier_px=15.0, settings=SETTINGS, **options,
    )  # fmt: skip


@pytest.mark.parametrize("with_views", [False, True])
def test_the_announced_steps_are_taken(monkeypatch, with_views):
    for name, steps in (("POINT_STEPS", 3), ("RAY_STEPS", 4), ("CONTOUR_STEPS", 2)):
        monkeypatch.setattr(solver, name, steps)
        monkeypatch.setattr(actor, name, steps)
    poses = some_poses(3)
    recording = record(poses, ring(4), skeleton="smpl24", noise_px=0.0)
    mask = outline(poses, 0, recording.cameras[0])
    views = [View(0, recording.cameras[0], matte_border(mask.astype(np.float32)))] * with_views
    taken = []
    fitted(recording, views, on_descent=lambda: taken.append(1))
    assert len(taken) == actor.num_descents(with_views=with_views) == 7 + 8 * with_views


def joint_errors_mm(fit, poses: BodyPose) -> torch.Tensor:
    return 1000 * (fit.joints_world - pose_joints(MODEL, poses)).norm(dim=-1)


@pytest.mark.parametrize("skeleton", ["smpl24", "coco17", "mediapipe33"])
def test_blended_landmarks_are_the_regressed_points_of_the_posed_body(skeleton):
    landmarks, poses = landmarks_on(MODEL, skeleton), some_poses(3)
    posed = pose_body(MODEL.to(poses.betas), poses)
    points = torch.cat([posed.joints, posed.vertices], 1)
    blended = blend_landmarks(MODEL, landmarks).points(posed.posed_from_rest, poses.betas[0])
    error = (blended - landmarks.regressor.double() @ points).norm(dim=-1)
    assert error[:, landmarks.defined].max() < 1e-6  # metres; float32 model


def test_unknown_skeleton_is_refused():
    with pytest.raises(DataError, match="smpl24, coco17 or mediapipe33"):
        landmarks_on(MODEL, "openpose25")


def test_reduced_body_poses_like_the_full_one():
    chosen, poses = torch.arange(0, 13000, 1000), some_poses(2)
    full = pose_body(MODEL.to(poses.betas), poses)
    small = pose_body(reduced_model(MODEL, chosen), poses)
    assert torch.allclose(small.vertices[:, 24:], full.vertices[:, chosen], atol=1e-6)
    assert torch.allclose(small.vertices[:, :24], full.joints, atol=1e-6)


def test_start_bends_limbs_the_right_way():
    poses = some_poses(12, seed=3)
    recording = record(poses, ring(4), skeleton="smpl24", noise_px=0.0)
    landmarks = landmarks_on(MODEL, "smpl24")
    found = triangulated_landmarks(rays_of(recording), tolerance_px=15)
    start = initial_pose(
        reduced_model(MODEL, torch.arange(0)), landmarks, blend_landmarks(MODEL, landmarks), found
    )
    low, high = limits()
    angles = start.body_pose.unflatten(-1, (23, 3))
    for name, axis in (("left_elbow", 1), ("right_elbow", 1), ("left_knee", 0), ("right_knee", 0)):
        joint = SMPL24_NAMES.index(name) - 1
        bend = angles[:, joint, axis]
        assert ((bend >= low[joint, axis]) & (bend <= high[joint, axis])).all()
        true_bend = poses.body_pose.unflatten(-1, (23, 3))[:, joint, axis]
        assert (bend - true_bend).abs().max() < 0.05  # radians; the mean shape's bones
    assert (pose_joints(MODEL, start) - pose_joints(MODEL, poses)).norm(dim=-1).max() < 0.2


@pytest.mark.parametrize("skeleton", ["smpl24", "coco17"])
def test_known_bodies_are_recovered(skeleton):
    poses = some_poses(5)
    fit = fitted(record(poses, ring(6), skeleton=skeleton, noise_px=1.0))
    limbs = [SMPL24_NAMES.index(name) for name in LIMB_NAMES]
    errors = joint_errors_mm(fit, poses)[:, limbs]
    assert errors.median() < 15  # 1 px of noise is 6 mm at 3 m
    assert errors.max() < 60
    assert fit.error_mm.max() < 15


def test_a_detectors_own_idea_of_hips_is_learned():
    moved = {
        "left_hip": (0.02, 0.03, 0.02), "right_hip": (-0.02, 0.03, 0.02),
        "left_ear": (0.0, 0.0, -0.02), "right_ear": (0.0, 0.0, -0.02),
    }  # fmt: skip
    poses = some_poses(6)
    fit = fitted(record(poses, ring(4), skeleton="mediapipe33", noise_px=1.0, offsets_m=moved))
    knees = [SMPL24_NAMES.index(name) for name in ("left_knee", "right_knee")]
    assert joint_errors_mm(fit, poses)[:, knees].median() < 15
    hips = [landmarks_on(MODEL, "mediapipe33").index(name) for name in moved][:2]
    distance = (fit.points_world - fit.found.points_world).norm(dim=-1)
    assert distance[:, hips].median() < 0.015  # metres, of the 0.041 that they were moved


def test_a_camera_that_swaps_sides_is_dropped():
    poses = some_poses(4)
    recording = record(poses, ring(4), skeleton="smpl24", noise_px=0.5)
    mirror = landmarks_on(MODEL, "smpl24").mirror
    pixels = recording.pixels.clone()
    pixels[:, 2] = pixels[:, 2, mirror]
    fit = fitted(replace(recording, pixels=pixels))
    limbs = [SMPL24_NAMES.index(name) for name in LIMB_NAMES]
    assert not fit.found.used[:, limbs, 2].all()
    assert joint_errors_mm(fit, poses)[:, limbs].median() < 15


def outline(poses: BodyPose, frame: int, camera: Camera) -> np.ndarray:
    vertices = pose_body(MODEL.to(poses.betas), poses).vertices[frame]
    pixels = camera.project(vertices)[0].numpy()
    return draw_silhouette(pixels, MODEL.faces.numpy(), width=500, height=500)


def overlap(poses: BodyPose, truth: dict[tuple[int, int], np.ndarray], cameras) -> float:
    pairs = [(outline(poses, frame, cameras[view]), mask) for (frame, view), mask in truth.items()]
    return float(np.mean([(one & other).sum() / (one | other).sum() for one, other in pairs]))


def test_silhouettes_improve_on_joints():
    poses, cameras = some_poses(2), ring(4)
    recording = record(poses, cameras, skeleton="coco17", noise_px=1.5)
    truth = {(f, v): outline(poses, f, cameras[v]) for f in range(2) for v in range(4)}
    views = [
        View(frame, cameras[view], matte_border(mask.astype(np.float32)))
        for (frame, view), mask in truth.items()
    ]
    by_joints = overlap(fitted(recording).pose, truth, cameras)
    by_outlines = overlap(fitted(recording, views).pose, truth, cameras)
    assert by_outlines > by_joints + 0.01
    assert by_outlines > 0.95


def test_silhouette_iou_of_the_true_pose_is_nearly_one():
    poses, camera = some_poses(1), ring(4)[1]
    single = BodyPose(poses.betas[0], poses.global_orient[0], poses.body_pose[0], poses.transl[0])
    matte = outline(poses, 0, camera).astype(np.float32)
    assert silhouette_iou(MODEL, single, camera, matte=matte) > 0.999
    aside = replace(single, transl=single.transl + torch.tensor([0.0, 0.0, 0.1]))
    assert silhouette_iou(MODEL, aside, camera, matte=matte) < 0.85


def test_border_points_lie_on_the_edge_and_look_out():
    v, u = np.mgrid[:200, :240] + 0.5
    disc = ((u - 120) ** 2 + (v - 90) ** 2 < 60**2).astype(np.float32)
    border = matte_border(disc)
    offset = border.points_px - [120, 90]
    radius = np.linalg.norm(offset, axis=1)
    assert len(radius) > 15
    assert np.abs(radius - 60).max() < 1.5
    assert ((offset / radius[:, None] * border.normals).sum(1) > 0.95).all()


def test_an_empty_matte_has_no_border():
    assert matte_border(np.zeros((50, 60), np.float32)).points_px.shape == (0, 2)


def test_silhouette_covers_a_square_of_two_triangles():
    corners = np.array([[10.0, 20.0], [10.0, 60.0], [50.0, 60.0], [50.0, 20.0]])
    mask = draw_silhouette(corners, np.array([[0, 1, 2], [0, 2, 3]]), width=80, height=90)
    assert abs(int(mask.sum()) - 1600) <= 90  # its border pixels, of 40 x 40
    assert not draw_silhouette(
        corners, np.array([[2, 1, 0], [3, 2, 0]]), width=80, height=90
    ).any()  # from behind


def test_pose_prior_is_mirror_symmetric_and_knows_hinges():
    random = torch.Generator().manual_seed(6)
    angles = 0.5 * torch.randn(4, 23, 3, generator=random, dtype=torch.float64)
    mirror = landmarks_on(MODEL, "smpl24").mirror[1:] - 1
    mirrored = angles[:, mirror] * torch.tensor([1.0, -1.0, -1.0])
    assert torch.allclose(pose_penalty(angles.flatten(1)), pose_penalty(mirrored.flatten(1)))
    knee = torch.zeros(2, 23, 3, dtype=torch.float64)
    knee[:, SMPL24_NAMES.index("left_knee") - 1, 0] = torch.tensor([0.8, -0.8]).double()
    forwards, backwards = pose_penalty(knee.flatten(1))
    assert backwards > 50 * forwards


def test_only_neighbours_in_time_are_smoothed():
    frames = [("a", 0), ("a", 1), ("a", 2), ("a", 4), ("b", 0), ("b", 20), ("b", 40)]
    assert neighbours(frames).tolist() == [[0, 1, 2]]
    assert neighbours([("a", 0)]).shape == (0, 3)


def disturbed(camera: Camera, seed: int) -> Camera:
    turn = 0.02 * torch.randn(3, generator=torch.Generator().manual_seed(seed)).double()
    return replace(camera, rotation=matrix_from_axis_angle(turn) @ camera.rotation)


def refined(recording: Recording) -> tuple[list[Camera], dict[str, float]]:
    landmarks = landmarks_on(MODEL, recording.skeleton)
    (moved,), scores = refine_recordings(
        [recording], landmarks, held_out_views=("cam3",), min_confidence=0.3,
        settings=RefinementSettings(),
    )  # fmt: skip
    return list(moved.cameras), scores


def same(one: Camera, other: Camera) -> bool:
    return torch.equal(one.rotation, other.rotation) and torch.equal(
        one.center_world, other.center_world
    )


def test_refinement_keeps_the_held_out_camera_out():
    truth = ring(4)
    recording = record(some_poses(24), truth, skeleton="smpl24", noise_px=1.0)
    wrong = tuple(disturbed(camera, seed) for seed, camera in enumerate(truth))
    recording = replace(recording, cameras=wrong)
    cameras, scores = refined(recording)
    assert scores["refine_cameras.before_px"] > 2 * scores["refine_cameras.heldout_px"]
    # other keypoints in the held-out camera move that camera alone
    even = recording.pixels.clone()
    even[4, 3] += 40
    others, _ = refined(replace(recording, pixels=even))
    assert all(same(one, other) for one, other in zip(cameras[:3], others[:3], strict=True))
    assert not same(cameras[3], others[3])
    # on odd frames, and on scored instants, they move nothing at all
    odd = recording.pixels.clone()
    odd[1::2, 3] += 40
    odd[2::4] += 40
    others, _ = refined(replace(recording, pixels=odd))
    assert all(same(one, other) for one, other in zip(cameras, others, strict=True))


def test_actions_with_other_camera_places_are_refused():
    recording = record(some_poses(8), ring(4), skeleton="smpl24", noise_px=0.0)
    other = replace(recording, action="later", cameras=tuple(ring(4)[::-1]))
    with pytest.raises(DataError, match=r"fit\.refine_cameras to false"):
        refine_recordings(
            [recording, other], landmarks_on(MODEL, "smpl24"), held_out_views=(),
            min_confidence=0.3, settings=RefinementSettings(),
        )  # fmt: skip


def test_no_torso_anywhere_is_an_error():
    recording = record(some_poses(3), ring(3), skeleton="smpl24", noise_px=0.0)
    confidence = recording.confidence.clone()
    confidence[:, 1:] = 0  # one camera only
    with pytest.raises(DataError, match="shoulders and hips are triangulated in none of 3"):
        fitted(replace(recording, confidence=confidence))


def test_a_head_below_the_feet_is_a_wrong_world():
    joints = pose_joints(MODEL, some_poses(4))
    check_upright(joints, "made/up")
    with pytest.raises(DataError, match="not z-up"):
        check_upright(joints * torch.tensor([1.0, 1.0, -1.0]), "made/up")


def test_a_giant_is_refused():
    assert 1.4 < body_height_m(MODEL, torch.zeros(10)) < 2.0
    giant = replace(MODEL, v_template=2 * MODEL.v_template)
    with pytest.raises(DataError, match="check the unit"):
        body_height_m(giant, torch.zeros(10))


def test_unusable_frames_get_a_reason():
    valid = torch.ones(3, 20, dtype=torch.bool)
    valid[1, 5:] = False
    reasons = frame_reasons(valid, torch.tensor([10.0, 10.0, 200.0]))
    assert reasons[0] == ""
    assert "5 triangulated landmarks" in reasons[1]
    assert "200 mm" in reasons[2]
