"""The cameras of an actor's recordings refined on his limbs, and what that gains."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.body.fitting.observations import triangulated_landmarks
from ntop.body.fitting.quality import bone_length_spread_mm
from ntop.body.fitting.recordings import Recording, landmark_rays
from ntop.body.landmarks import LIMB_NAMES, Landmarks
from ntop.conventions import DataError
from ntop.geometry.calibration import RefinementSettings, agreement_px, refine_rig
from ntop.geometry.cameras import Camera
from ntop.geometry.refinement import Observations, observe, resect

# Refinement is scored on every fourth instant, counted from the third; cameras use the others.
FOLD, SCORED = 4, 2
SAME_PLACE_M = 1e-6
SPREAD_TOLERANCE_PX = 40.0  # a camera that misses a limb point by more mixes limbs up


def refine_recordings(
    recordings: list[Recording],
    landmarks: Landmarks,
    *,
    held_out_views: tuple[str, ...],
    min_confidence: float,
    settings: RefinementSettings,
) -> tuple[list[Recording], dict[str, float]]:
    """Recordings with refined extrinsics (shared by all actions), and the errors in pixels.

    Scored: the median reprojection error of plain triangulated limb points on instants that no
    camera was refined on. Held-out cameras are placed, and scored, on even frames only.

    Raises:
        DataError: the actions have different views or camera positions.
    """
    views = recordings[0].views
    for recording in recordings:
        if recording.views != views or not _same_places(recordings[0], recording):
            raise DataError(
                f"{recording.source}/{recording.actor}: actions {recordings[0].action!r} and "
                f"{recording.action!r} have different views or camera positions; set "
                "fit.refine_cameras to false for this source"
            )
    limbs = [landmarks.index(name) for name in LIMB_NAMES]
    observations, for_training, for_held_out = [], [], []
    for recording in recordings:
        weights = (recording.confidence[:, :, limbs] >= min_confidence).double()
        observations.append(
            observe(
                list(recording.cameras),
                recording.pixels[:, :, limbs].transpose(1, 2).flatten(0, 1),
                weights.transpose(1, 2).flatten(0, 1),
            )
        )
        used = ~_scored(recording)
        even = torch.tensor(recording.frames) % 2 == 0
        for_training.append(used.repeat_interleave(len(limbs)))
        for_held_out.append((used & even).repeat_interleave(len(limbs)))
    refined = refine_rig(
        list(recordings[0].cameras),
        Observations.joined(observations),
        held_out=[i for i, view in enumerate(views) if view in held_out_views],
        for_training=torch.cat(for_training),
        for_held_out=torch.cat(for_held_out),
        settings=settings,
    )
    placed = dict(zip(views, refined, strict=True))
    moved = [recording.with_extrinsics(placed) for recording in recordings]
    spreads = _bone_length_spreads_mm(moved, landmarks, min_confidence=min_confidence)
    scores = _scores(recordings, moved, limbs)
    scores |= {f"refine_cameras.bone_length_std_mm.{bone}": s for bone, s in spreads.items()}
    if spreads:
        scores["refine_cameras.bone_length_std_mm"] = max(spreads.values())
    return moved, scores


def place_on_bodies(
    recordings: list[Recording],
    points_world: Float[Tensor, "frame landmark 3"],
    landmarks: Landmarks,
    *,
    views: tuple[str, ...],
    min_confidence: float,
    settings: RefinementSettings,
) -> list[Recording]:
    """Recordings whose `views` are placed so that they see the fitted bodies' landmarks.

    Triangulated points carry each camera's own bias of the detector; a body that also fits the
    silhouettes of the other cameras does not. Only keypoints of even frames are used.

    Raises:
        DataError: fewer than six points are observed.
    """
    chosen = torch.nonzero(landmarks.defined).squeeze(-1)
    placed = {}
    for view in views:
        index, start = recordings[0].views.index(view), 0
        observations, points = [], []
        for recording in recordings:
            count = len(recording.frames)
            even = torch.tensor(recording.frames) % 2 == 0
            certain = recording.confidence[:, index, chosen] >= min_confidence
            observations.append(
                observe(
                    [recording.cameras[index]],
                    recording.pixels[:, index, chosen].reshape(-1, 1, 2),
                    (certain & even[:, None]).double().reshape(-1, 1),
                )
            )
            points.append(points_world[start : start + count, chosen].reshape(-1, 3))
            start += count
        placed[view] = resect(
            recordings[0].cameras[index],
            Observations.joined(observations),
            torch.cat(points),
            prior_weight=settings.prior_weight,
            loss_scale_px=settings.loss_scale_px,
        )
    return [
        recording.with_extrinsics(
            dict(zip(recording.views, recording.cameras, strict=True)) | placed
        )
        for recording in recordings
    ]


def _bone_length_spreads_mm(
    recordings: list[Recording], landmarks: Landmarks, *, min_confidence: float
) -> dict[str, float]:
    """How constant limb bones are on the scored instants: the worst action's spread per bone."""
    worst: dict[str, float] = {}
    for recording in recordings:
        rays = landmark_rays([recording], landmarks, min_confidence=min_confidence)
        found = triangulated_landmarks(rays, tolerance_px=SPREAD_TOLERANCE_PX)
        chosen = _scored(recording)
        spreads = bone_length_spread_mm(found.points_world[chosen], found.valid[chosen], landmarks)
        worst |= {bone: max(spread, worst.get(bone, 0.0)) for bone, spread in spreads.items()}
    return worst


def _scores(before: list[Recording], after: list[Recording], limbs: list[int]) -> dict[str, float]:
    old = {r.action: _agreement(r, limbs) for r in before}
    new = {r.action: _agreement(r, limbs) for r in after}
    scores = {
        "refine_cameras.before_px": _median(torch.cat(list(old.values()))),
        "refine_cameras.heldout_px": _median(torch.cat(list(new.values()))),
    }
    for action in old:
        scores[f"refine_cameras.before_px.{action}"] = _median(old[action])
        scores[f"refine_cameras.heldout_px.{action}"] = _median(new[action])
    return {name: value for name, value in scores.items() if value is not None}


def _agreement(recording: Recording, limbs: list[int]) -> Tensor:
    chosen = _scored(recording) & (torch.tensor(recording.frames) % 2 == 0)
    pixels = recording.pixels[chosen][:, :, limbs].transpose(1, 2).flatten(0, 1)
    observed = (recording.confidence[chosen][:, :, limbs] > 0).transpose(1, 2).flatten(0, 1)
    return agreement_px(list(recording.cameras), pixels, observed)


def _median(errors: Tensor) -> float | None:
    return float(errors.median()) if len(errors) else None


def _scored(recording: Recording) -> Bool[Tensor, " frame"]:
    return torch.arange(len(recording.frames)) % FOLD == SCORED


def _same_places(one: Recording, other: Recording) -> bool:
    def places(recording: Recording) -> Tensor:
        return torch.stack([_place(camera) for camera in recording.cameras])

    return bool((places(one) - places(other)).abs().max() < SAME_PLACE_M)


def _place(camera: Camera) -> Tensor:
    return torch.cat([camera.center_world.double(), camera.rotation.double().flatten()])
