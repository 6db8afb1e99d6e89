"""3D points from several views: weighted, robust against wrong observations, honest about geometry.

Notation: ray i starts at camera centre `c_i` with unit direction `d_i`; `P_i = I - d_i d_i^T` is
the part of a vector across the ray. A point X minimises `sum w_i |P_i (X - c_i)|^2 / |X - c_i|^2`,
the squared angles between rays and point: that is what a detector's pixel noise is made of.
Bearings serve every lens, also beyond 90 degrees, where x / z does not exist.
"""

from dataclasses import dataclass
from itertools import combinations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera

MAX_CONDITION = 1e6  # of the 3 x 3 normal matrix; beyond, a point slides along its rays
REWEIGHTINGS = 5  # of the 1 / distance^2 weights; converges to 1e-6 m in 2-3 for real rigs
CAUCHY_SHARE = 0.1  # of the tolerance: the angle at which a ray counts half (a detector's noise)
CAUCHY_STEPS = 15  # of the reweighting; moves real points by less than 0.1 mm afterwards


@dataclass(frozen=True)
class Triangulation:
    """Points with their validity.

    Attributes:
        points_world: metres; zero where not valid.
        valid: at least two rays agree and the geometry fixes the point.
        used: the rays that agree with the point (all false where not valid).
        angle_rad: between each observed ray and the point; pi where the ray was not observed.
        condition: of the normal matrix, capped at 1e12.
    """

    points_world: Float[Tensor, "*batch 3"]
    valid: Bool[Tensor, "*batch"]
    used: Bool[Tensor, "*batch camera"]
    angle_rad: Float[Tensor, "*batch camera"]
    condition: Float[Tensor, "*batch"]


def triangulate(
    centers_world: Float[Tensor, "camera 3"],
    directions_world: Float[Tensor, "*batch camera 3"],
    weights: Float[Tensor, "*batch camera"],
) -> Triangulation:
    """The point nearest in angle to all rays with a positive weight (float64).

    Raises:
        DataError: a number is not finite or a weight is negative.
    """
    _refuse_bad_numbers(centers_world, directions_world, weights)
    centers, directions = centers_world.double(), directions_world.double()
    weights = weights.double()
    points, condition, fixed = _nearest_points(centers, directions, weights)
    angles, ahead = _angles(points, centers=centers, directions=directions, weights=weights)
    used = (weights > 0) & ahead
    valid = fixed & (used.sum(-1) >= 2)
    return Triangulation(
        torch.where(valid[..., None], points, torch.zeros_like(points)),
        valid,
        used & valid[..., None],
        angles,
        condition,
    )


def triangulate_robust(
    centers_world: Float[Tensor, "camera 3"],
    directions_world: Float[Tensor, "*batch camera 3"],
    weights: Float[Tensor, "*batch camera"],
    *,
    tolerance_rad: float,
) -> Triangulation:
    """As `triangulate`, after dropping rays that miss the point by more than `tolerance_rad`.

    Every pair of cameras proposes a point; the one with the smallest truncated squared angle over
    all cameras (MSAC: Torr & Zisserman 2000) decides who belongs. Exhaustive, hence deterministic:
    a capture has a handful of cameras. With two cameras nothing can be dropped, only refused.
    Those who belong are weighted by how well they agree (Cauchy's loss): a detector errs in one
    view more than in the others, and a mean would follow it.

    Raises:
        DataError: a number is not finite or a weight is negative.
    """
    _refuse_bad_numbers(centers_world, directions_world, weights)
    centers, directions = centers_world.double(), directions_world.double()
    weights = weights.double()
    cameras = range(centers.shape[0])
    best_cost = torch.full(weights.shape[:-1], torch.inf, dtype=torch.float64)
    best = torch.zeros_like(weights, dtype=torch.bool)
    for pair in combinations(cameras, 2):
        chosen = torch.zeros_like(weights)
        chosen[..., list(pair)] = weights[..., list(pair)]
        both = (chosen > 0).sum(-1) == 2
        points, _, fixed = _nearest_points(centers, directions, chosen)
        angles, ahead = _angles(points, centers=centers, directions=directions, weights=weights)
        agrees = ahead & (angles <= tolerance_rad)
        cost = (weights * (angles / tolerance_rad).square().clamp(max=1.0)).sum(-1)
        better = both & fixed & (agrees.sum(-1) >= 2) & (cost < best_cost)
        best_cost = torch.where(better, cost, best_cost)
        best = torch.where(better[..., None], agrees, best)
    found = triangulate(centers, directions, weights * best)
    for _ in range(CAUCHY_STEPS):
        share = (found.angle_rad / (CAUCHY_SHARE * tolerance_rad)).square()
        found = triangulate(centers, directions, weights * best / (1 + share))
    return found


def camera_rays(
    cameras: list[Camera], pixels: Float[Tensor, "*batch camera 2"]
) -> tuple[Float[Tensor, "*batch camera 3"], Bool[Tensor, "*batch camera"]]:
    """World directions through one pixel per camera (float64), and whether the lens covers it."""
    rays = [camera.rays(pixels[..., i, :].double()) for i, camera in enumerate(cameras)]
    directions = torch.stack([direction for direction, _ in rays], -2)
    return directions, torch.stack([valid for _, valid in rays], -1)


def camera_centers(cameras: list[Camera]) -> Float[Tensor, "camera 3"]:
    """Optical centres in the world (float64)."""
    return torch.stack([camera.center_world.double() for camera in cameras])


def reprojection_errors_px(
    cameras: list[Camera],
    points_world: Float[Tensor, "*batch 3"],
    pixels: Float[Tensor, "*batch camera 2"],
) -> Float[Tensor, "*batch camera"]:
    """Pixel distance between each observation and the point's image (float64).

    Meaningful where the point is valid and observed; behind a camera it is arbitrary but finite.
    """
    projected = torch.stack([camera.project(points_world.double())[0] for camera in cameras], -2)
    return (projected - pixels.double()).norm(dim=-1)


def _nearest_points(
    centers: Float[Tensor, "camera 3"],
    directions: Float[Tensor, "*batch camera 3"],
    weights: Float[Tensor, "*batch camera"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Points, condition of their normal matrix, and whether the geometry fixes them."""
    across = torch.eye(3, dtype=torch.float64) - directions[..., :, None] * directions[..., None, :]
    identity = torch.eye(3, dtype=torch.float64)
    scale = weights
    for _ in range(REWEIGHTINGS):
        normal = (scale[..., None, None] * across).sum(-3)
        target = (scale[..., None, None] * across @ centers[..., None]).sum(-3)
        eigenvalues = torch.linalg.eigvalsh(normal)
        fixed = eigenvalues[..., 0] * MAX_CONDITION > eigenvalues[..., 2].clamp(min=1e-300)
        safe = torch.where(fixed[..., None, None], normal, identity)
        points = torch.linalg.solve(safe, target).squeeze(-1)
        distance = (points[..., None, :] - centers).norm(dim=-1).clamp(min=1e-3)
        # relative to the nearest camera, so that the matrix stays of order one
        scale = weights * (distance.amin(-1, keepdim=True) / distance).square()
    smallest = eigenvalues[..., 0].clamp(min=1e-12 * eigenvalues[..., 2].clamp(min=1e-300))
    return points, (eigenvalues[..., 2] / smallest).clamp(min=1.0), fixed


def _angles(
    points: Float[Tensor, "*batch 3"],
    *,
    centers: Float[Tensor, "camera 3"],
    directions: Float[Tensor, "*batch camera 3"],
    weights: Float[Tensor, "*batch camera"],
) -> tuple[Float[Tensor, "*batch camera"], Bool[Tensor, "*batch camera"]]:
    """Angle between each ray and the point, and whether the point lies ahead on an observed ray."""
    offsets = points[..., None, :] - centers
    along = (offsets * directions).sum(-1)
    sideways = (offsets - along[..., None] * directions).norm(dim=-1)
    observed = weights > 0
    angles = torch.where(observed, torch.atan2(sideways, along), torch.full_like(along, torch.pi))
    return angles, observed & (along > 0)


def _refuse_bad_numbers(
    centers: Float[Tensor, "camera 3"],
    directions: Float[Tensor, "*batch camera 3"],
    weights: Float[Tensor, "*batch camera"],
) -> None:
    finite = centers.isfinite().all() & directions.isfinite().all() & weights.isfinite().all()
    if not bool(finite) or bool((weights < 0).any()):
        bad: Int[Tensor, " batch"] = (~directions.isfinite()).any(-1).sum()
        raise DataError(
            f"triangulation: got {int(bad)} rays that are not finite, or a bad centre or weight; "
            "expected finite rays and weights >= 0; give missing observations weight 0"
        )
