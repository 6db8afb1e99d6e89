"""The fit itself: one `betas` and all frames' poses at the maximum of one log-likelihood.

Terms, each a sum of squared misses over spreads: triangulated landmarks (to get near), landmarks'
rays in pixels, silhouettes' borders in metres, pose and shape priors, smoothness between
neighbouring frames. Observations are robust: a miss far beyond its spread stops pulling
(Geman & McClure 1985). Smoothness is robust too, so that frames that do not follow each other in
time, only in number, are not bent towards each other.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ntop.body.fitting.initial import initial_pose
from ntop.body.fitting.observations import (
    ContourRays,
    LandmarkRays,
    contour_misses_m,
    landmark_misses_px,
)
from ntop.body.fitting.priors import pose_penalty
from ntop.body.landmarks import BlendedLandmarks, Landmarks
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, PosedBody, pose_body
from ntop.conventions import NUM_JOINTS
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.geometry.triangulation import Triangulation

TRANSL_UNIT_M = 0.3  # a lever of the body: makes metres and radians steps of like size
# Adam: how far an unknown moves per step (radians, 0.3 m, one beta) at first, and how many steps
COARSE_STRIDE, POINT_STEPS = 0.06, 250
FINE_STRIDE, RAY_STEPS = 0.02, 300
CONTOUR_STRIDE, CONTOUR_STEPS = 0.01, 120


@dataclass(frozen=True)
class FitSettings:
    """Spreads of the fit's terms."""

    landmark_px: float = 6.0
    landmark_m: float = 0.03
    contour_m: float = 0.008
    contour_weight: float = 0.5  # neighbouring border points are not independent
    betas: float = 1.5
    acceleration_m: float = 0.003  # second difference of a joint from frame to frame
    turn_rad: float = 0.03  # second difference of a joint's rotation matrix entries
    pose_weight: float = 1.0


@dataclass(frozen=True)
class BodyFit:
    """Fitted poses (leading axis: frame) and the learned offsets of the landmarks."""

    pose: BodyPose
    offsets_m: Float[Tensor, "landmark 3"]


@dataclass(frozen=True)
class FitProblem:
    """What stays the same during a fit.

    Attributes:
        model: reduced body whose vertices are the joints and the contour candidates.
        landmarks: the skeleton; blend: its points as blends of the bones.
        neighbours: triples of frames that follow each other in number.
        on_descent: called after every step of a descent.
    """

    model: BodyModel
    landmarks: Landmarks
    blend: BlendedLandmarks
    neighbours: Int[Tensor, "triple 3"]
    settings: FitSettings
    on_descent: Callable[[], None] = lambda: None


def fit_landmarks(problem: FitProblem, rays: LandmarkRays, found: Triangulation) -> BodyFit:
    """The bodies that meet triangulated landmarks, then their rays.

    Raises:
        DataError: no frame shows shoulders and hips to two cameras.
    """
    settings = problem.settings

    def meet_points(_: PosedBody, points: Tensor) -> Tensor:
        squared = (points - found.points_world).square().sum(-1) / settings.landmark_m**2
        # pseudo-Huber: it never stops pulling, because a T-pose starts far away
        return (2 * ((1 + squared).sqrt() - 1) * found.valid).sum()

    def meet_rays(_: PosedBody, points: Tensor) -> Tensor:
        return ray_cost(rays, points, settings)

    pose = initial_pose(problem.model, problem.landmarks, problem.blend, found)
    start = BodyFit(pose, torch.zeros_like(found.points_world[0]))
    # each frame alone first: smoothness makes the problem stiff, and its knee hides large errors
    alone = replace(problem, neighbours=problem.neighbours[:0])
    near = _maximise(alone, start, meet_points, stride=COARSE_STRIDE, descents=POINT_STEPS)
    return _maximise(problem, near, meet_rays, stride=FINE_STRIDE, descents=RAY_STEPS)


def fit_contours(
    problem: FitProblem, start: BodyFit, rays: LandmarkRays, contours: ContourRays
) -> BodyFit:
    """The fit that also brings the matched vertices to the silhouettes' borders."""
    settings = problem.settings

    def cost(posed: PosedBody, points: Tensor) -> Tensor:
        miss = contour_misses_m(contours, posed.vertices) / settings.contour_m
        border = (contours.weights * _robust(miss, knee=4.0)).sum()
        return ray_cost(rays, points, settings) + settings.contour_weight * border

    return _maximise(problem, start, cost, stride=CONTOUR_STRIDE, descents=CONTOUR_STEPS)


def ray_cost(rays: LandmarkRays, points: Tensor, settings: FitSettings) -> Tensor:
    """How badly landmarks miss their rays."""
    miss = landmark_misses_px(rays, points) / settings.landmark_px
    return (rays.weights * _robust(miss, knee=4.0)).sum()


def landmark_points(
    problem: FitProblem, fit: BodyFit, posed: PosedBody
) -> Float[Tensor, "frame landmark 3"]:
    """The skeleton's points on posed bodies, offsets included."""
    turn = posed.posed_from_rest[..., problem.landmarks.bones, :3, :3]
    points = problem.blend.points(posed.posed_from_rest, fit.pose.betas[0])
    return points + (turn @ fit.offsets_m[..., None]).squeeze(-1)


def _maximise(
    problem: FitProblem,
    start: BodyFit,
    observation_cost: Callable[[PosedBody, Tensor], Tensor],
    *,
    stride: float,
    descents: int,
) -> BodyFit:
    """Adam on all unknowns at once, its stride falling to zero.

    Its step per unknown stands in for the missing second derivatives: a knee and a shape
    coefficient differ by orders of magnitude in curvature, and L-BFGS needed three times as long.
    """
    betas = start.pose.betas[0].clone().requires_grad_()
    orient = start.pose.global_orient.clone().requires_grad_()
    body = start.pose.body_pose.clone().requires_grad_()
    transl = (start.pose.transl / TRANSL_UNIT_M).clone().requires_grad_()
    sigma = problem.landmarks.offset_sigma_m.double()[:, None]
    offsets = (start.offsets_m / sigma.clamp(min=1e-6)).clone().requires_grad_()
    frames = orient.shape[0]

    def current() -> BodyFit:
        pose = BodyPose(betas.expand(frames, -1), orient, body, transl * TRANSL_UNIT_M)
        return BodyFit(pose, sigma * _mirrored(offsets, problem.landmarks.mirror))

    optimiser = torch.optim.Adam([betas, orient, body, transl, offsets], betas=(0.9, 0.95))
    for step in range(descents):
        for group in optimiser.param_groups:
            group["lr"] = stride * 0.5 * (1 + math.cos(math.pi * step / descents))
        optimiser.zero_grad()
        fit = current()
        posed = pose_body(problem.model, fit.pose)
        points = landmark_points(problem, fit, posed)
        cost = observation_cost(posed, points) + _prior_cost(problem, fit, posed, offsets)
        cost.backward()
        optimiser.step()
        problem.on_descent()
    with torch.no_grad():
        fit = current()
        pose = BodyPose(*(getattr(fit.pose, field.name).clone() for field in fields(BodyPose)))
        return BodyFit(pose, fit.offsets_m.clone())


def _prior_cost(problem: FitProblem, fit: BodyFit, posed: PosedBody, offsets: Tensor) -> Tensor:
    settings = problem.settings
    pose = settings.pose_weight * pose_penalty(fit.pose.body_pose).sum()
    # shape and offsets are single values against observations of all frames
    shape = fit.pose.betas.shape[0] * (fit.pose.betas[0] / settings.betas).square().sum()
    offset = fit.pose.betas.shape[0] * offsets.square().sum()
    before, here, after = problem.neighbours.unbind(-1)
    joints = posed.vertices[:, :NUM_JOINTS]
    bend = (joints[before] - 2 * joints[here] + joints[after]).norm(dim=-1)
    rotations = matrix_from_axis_angle(
        torch.cat([fit.pose.global_orient, fit.pose.body_pose], -1).unflatten(-1, (24, 3))
    )
    turn = (rotations[before] - 2 * rotations[here] + rotations[after]).flatten(-2).norm(dim=-1)
    smooth = _robust(bend / settings.acceleration_m, knee=6.0).sum()
    return pose + shape + offset + smooth + _robust(turn / settings.turn_rad, knee=6.0).sum()


def _robust(miss: Tensor, *, knee: float) -> Tensor:
    """Squared miss near zero, at most knee^2 far away."""
    squared = miss.square()
    return squared / (1 + squared / knee**2)


def _mirrored(offsets: Tensor, mirror: Tensor) -> Tensor:
    """Offsets averaged with the mirror image of the other side's."""
    flip = offsets.new_tensor([-1.0, 1.0, 1.0])
    return 0.5 * (offsets + flip * offsets[mirror])
