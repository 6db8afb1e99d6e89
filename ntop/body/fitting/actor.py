"""The fit of one actor over all his recordings: landmarks, then silhouettes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.fitting.contours import View, candidate_vertices, match_contours
from ntop.body.fitting.observations import LandmarkRays, triangulated_landmarks
from ntop.body.fitting.solver import (
    CONTOUR_STEPS,
    POINT_STEPS,
    RAY_STEPS,
    BodyFit,
    FitProblem,
    FitSettings,
    fit_contours,
    fit_landmarks,
    landmark_points,
)
from ntop.body.landmarks import Landmarks, blend_landmarks, reduced_model
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, pose_body
from ntop.geometry.triangulation import Triangulation

CANDIDATE_CELL_M = 0.02
CONTOUR_REACH_M = (0.12, 0.08, 0.05, 0.03)  # per round; the last decides what counts as matched
MAX_SMOOTH_STEP = 5  # frames further apart say nothing about each other


@dataclass(frozen=True)
class ActorFit:
    """Poses of all frames and what they were fitted to.

    Attributes:
        pose: leading axis frame, float64.
        found: triangulated landmarks; points_world: the body's own landmarks.
        error_mm: median distance between both, per frame (0 where nothing was triangulated).
    """

    pose: BodyPose
    joints_world: Float[Tensor, "frame 24 3"]
    found: Triangulation
    points_world: Float[Tensor, "frame landmark 3"]
    error_mm: Float[Tensor, " frame"]


def fit_actor(
    model: BodyModel,
    landmarks: Landmarks,
    rays: LandmarkRays,
    views: list[View],
    *,
    frames: list[tuple[str, int]],
    outlier_px: float,
    settings: FitSettings,
    on_descent: Callable[[], None] = lambda: None,
) -> ActorFit:
    """One shape and a pose per frame; `frames` are (action, frame), ascending.

    `views` hold the mattes' borders (none: landmarks alone decide). `on_descent` is called as often
    as `num_descents` says.

    Raises:
        DataError: no frame shows shoulders and hips to two cameras.
    """
    found = triangulated_landmarks(rays, tolerance_px=outlier_px)
    problem = FitProblem(
        model=reduced_model(model, torch.arange(0)),
        landmarks=landmarks,
        blend=blend_landmarks(model, landmarks),
        neighbours=neighbours(frames),
        settings=settings,
        on_descent=on_descent,
    )
    fit = fit_landmarks(problem, rays, found)
    if views:
        candidates = candidate_vertices(model, cell_m=CANDIDATE_CELL_M)
        problem = replace(problem, model=reduced_model(model, candidates))
        full = model.to(fit.pose.transl)
        for reach_m in CONTOUR_REACH_M:
            contours = match_contours(full, fit.pose, views, candidates=candidates, reach_m=reach_m)
            fit = fit_contours(problem, fit, rays, contours)
    return _measured(problem, fit, found)


def num_descents(*, with_views: bool) -> int:
    """How many steps down a fit takes, with mattes or without."""
    return POINT_STEPS + RAY_STEPS + with_views * len(CONTOUR_REACH_M) * CONTOUR_STEPS


def neighbours(frames: list[tuple[str, int]]) -> Tensor:
    """Index triples of equally spaced frames of one action that follow each other."""
    triples = []
    for i in range(1, len(frames) - 1):
        (first, a), (middle, b), (last, c) = frames[i - 1 : i + 2]
        if first == middle == last and 0 < b - a == c - b <= MAX_SMOOTH_STEP:
            triples.append((i - 1, i, i + 1))
    return torch.tensor(triples, dtype=torch.int64).reshape(-1, 3)


def _measured(problem: FitProblem, fit: BodyFit, found: Triangulation) -> ActorFit:
    posed = pose_body(problem.model, fit.pose)
    points = landmark_points(problem, fit, posed)
    distance = (points - found.points_world).norm(dim=-1)
    errors = [
        1000 * float(distance[i][mask].median()) if bool(mask.any()) else 0.0
        for i, mask in enumerate(found.valid)
    ]
    return ActorFit(fit.pose, posed.joints, found, points, torch.tensor(errors))
