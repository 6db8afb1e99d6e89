"""Camera extrinsics refined on body keypoints: a small bundle adjustment with a prior.

Notation: camera c maps `X_c = exp(w_c) (R_c X + t_c) + s_c`, with the increments w (rad) and s (m)
as its six unknowns; b is an observed unit bearing in the camera frame, (e1, e2) two unit vectors
across it. The residual is `scale (e1, e2) . X_c / |X_c|`, the miss in pixels at the optical axis:
the same formula for every lens, without distortion and without x / z.

Body keypoints are the target that every recording has. Their noise averages out over many poses,
while a wrong camera shifts all of them alike. `prior_weight` (pixels per radian and per metre)
fixes the gauge: without it the whole scene may drift.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from torch import Tensor

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Lens
from ntop.geometry.rotations import cross_matrix, matrix_from_axis_angle
from ntop.geometry.triangulation import Triangulation, camera_centers, triangulate

CAMERA_UNKNOWNS = 6


@dataclass(frozen=True)
class Observations:
    """Keypoints seen by several cameras, as bearings; point p is one joint at one instant.

    Attributes:
        bearings_camera: unit vectors in each camera's own frame.
        scale_px: pixels per radian of the lens that saw it.
        weights: >= 0; zero where the camera did not see the point.
    """

    bearings_camera: Float[Tensor, "point camera 3"]
    scale_px: Float[Tensor, "point camera"]
    weights: Float[Tensor, "point camera"]

    @staticmethod
    def joined(parts: list["Observations"]) -> "Observations":
        """Observations of several recordings by the same cameras, one after the other."""
        return Observations(
            torch.cat([part.bearings_camera for part in parts]),
            torch.cat([part.scale_px for part in parts]),
            torch.cat([part.weights for part in parts]),
        )


def pixels_per_radian(lens: Lens) -> float:
    """Scale of a lens on its axis."""
    return 0.5 * (lens.fx + lens.fy)


def observe(
    cameras: list[Camera],
    pixels: Float[Tensor, "point camera 2"],
    weights: Float[Tensor, "point camera"],
) -> Observations:
    """Bearings of pixels; those that a lens does not cover get weight zero (float64)."""
    bearings, scales, valid = [], [], []
    for index, camera in enumerate(cameras):
        direction, covered = camera.lens.unproject(pixels[:, index].double())
        bearings.append(direction)
        valid.append(covered)
        scale = pixels_per_radian(camera.lens)
        scales.append(torch.full((pixels.shape[0],), scale, dtype=torch.float64))
    seen = torch.stack(valid, -1)
    return Observations(
        torch.stack(bearings, 1), torch.stack(scales, -1), weights.double() * seen.double()
    )


def refine_extrinsics(
    cameras: list[Camera],
    observations: Observations,
    *,
    prior_weight: float,
    loss_scale_px: float,
    max_evaluations: int = 60,
) -> list[Camera]:
    """The same cameras, moved and turned so that their rays meet in the observed points.

    Robust (soft L1 beyond `loss_scale_px`) and sparse: all cameras and all points at once. Points
    seen by fewer than two cameras, or without a fixed position, take no part.

    Raises:
        DataError: fewer points than cameras remain.
    """
    start = _triangulated(cameras, observations)
    keep = start.valid & ((observations.weights > 0).sum(-1) >= 2)
    if int(keep.sum()) < CAMERA_UNKNOWNS * len(cameras):
        raise DataError(
            f"camera refinement: {int(keep.sum())} points seen by two cameras, expected at least "
            f"{CAMERA_UNKNOWNS * len(cameras)}; give more frames or skip the refinement"
        )
    chosen = Observations(
        observations.bearings_camera[keep], observations.scale_px[keep], observations.weights[keep]
    )
    problem = _Bundle(cameras, chosen, prior_weight=prior_weight, points=start.points_world[keep])
    unknowns = problem.solve(loss_scale_px=loss_scale_px, max_evaluations=max_evaluations)
    increments = torch.from_numpy(unknowns[: CAMERA_UNKNOWNS * len(cameras)]).reshape(-1, 6)
    return [_moved(camera, step) for camera, step in zip(cameras, increments, strict=True)]


def resect(
    camera: Camera,
    observations: Observations,
    points_world: Float[Tensor, "point 3"],
    *,
    prior_weight: float,
    loss_scale_px: float,
    max_evaluations: int = 60,
) -> Camera:
    """One camera refined against points that stay as they are: what a held-out camera may get.

    Raises:
        DataError: fewer than six points are observed.
    """
    keep = observations.weights[:, 0] > 0
    if int(keep.sum()) < CAMERA_UNKNOWNS:
        raise DataError(
            f"camera refinement: {int(keep.sum())} observed points, expected at least "
            f"{CAMERA_UNKNOWNS}; give more frames or skip the refinement"
        )
    chosen = Observations(
        observations.bearings_camera[keep], observations.scale_px[keep], observations.weights[keep]
    )
    problem = _Bundle(
        [camera], chosen, prior_weight=prior_weight, points=points_world[keep], points_move=False
    )
    unknowns = problem.solve(loss_scale_px=loss_scale_px, max_evaluations=max_evaluations)
    return _moved(camera, torch.from_numpy(unknowns))


class _Bundle:
    """Residuals and their sparse Jacobian; unknowns are the increments, then the points."""

    def __init__(
        self,
        cameras: list[Camera],
        observations: Observations,
        *,
        prior_weight: float,
        points: Float[Tensor, "point 3"],
        points_move: bool = True,
    ) -> None:
        self.num_cameras = len(cameras)
        self.prior_weight = prior_weight
        self.points_move = points_move
        self.points = points.double()
        self.rotation = torch.stack([camera.rotation.double() for camera in cameras])
        self.center = camera_centers(cameras)
        self.point_index, self.camera_index = torch.nonzero(observations.weights, as_tuple=True)
        bearing = observations.bearings_camera[self.point_index, self.camera_index]
        strength = (observations.scale_px * observations.weights.sqrt())[
            self.point_index, self.camera_index
        ]
        self.across = strength[:, None, None] * _across(bearing)  # (observation, 2, 3) pixels

    def solve(self, *, loss_scale_px: float, max_evaluations: int) -> np.ndarray:
        """The unknowns at the robust minimum."""
        start = np.zeros(CAMERA_UNKNOWNS * self.num_cameras)
        if self.points_move:
            start = np.concatenate([start, self.points.reshape(-1).numpy()])
        solution = least_squares(
            lambda x: self._evaluate(x)[0],
            start,
            jac=lambda x: self._evaluate(x)[1],
            loss="soft_l1",
            f_scale=loss_scale_px,
            x_scale="jac",
            max_nfev=max_evaluations,
        )
        return solution.x

    def _evaluate(self, unknowns: np.ndarray) -> tuple[np.ndarray, csr_matrix]:
        values = torch.from_numpy(unknowns)
        split = CAMERA_UNKNOWNS * self.num_cameras
        increments = values[:split].reshape(-1, CAMERA_UNKNOWNS)
        points = values[split:].reshape(-1, 3) if self.points_move else self.points
        camera, point = self.camera_index, self.point_index
        turn = matrix_from_axis_angle(increments[:, :3])
        offset = points[point] - self.center[camera]
        before = (self.rotation[camera] @ offset[..., None]).squeeze(-1)
        turned = (turn[camera] @ before[..., None]).squeeze(-1)
        placed = turned + increments[camera, 3:]
        length = placed.norm(dim=-1)[:, None, None]
        unit = placed[..., None] / length
        residual = (self.across @ unit).squeeze(-1)
        # d(X/|X|)/dX = (I - u u^T) / |X|
        slope = self.across @ (torch.eye(3, dtype=torch.float64) - unit @ unit.mT) / length
        by_turn = -slope @ cross_matrix(turned) @ _left_jacobian(increments[camera, :3])
        by_camera = torch.cat([by_turn, slope], -1)
        prior = self.prior_weight * values[:split]
        jacobian = self._assemble(by_camera, slope @ turn[camera] @ self.rotation[camera])
        return torch.cat([residual.reshape(-1), prior]).numpy(), jacobian

    def _assemble(
        self,
        by_camera: Float[Tensor, "observation 2 6"],
        by_point: Float[Tensor, "observation 2 3"],
    ) -> csr_matrix:
        count, split = by_camera.shape[0], CAMERA_UNKNOWNS * self.num_cameras
        rows = torch.arange(2 * count).reshape(count, 2, 1)
        blocks = [(by_camera, (CAMERA_UNKNOWNS * self.camera_index)[:, None] + torch.arange(6))]
        width = split
        if self.points_move:
            blocks.append((by_point, split + 3 * self.point_index[:, None] + torch.arange(3)))
            width += self.points.numel()
        row = [rows.expand_as(block).reshape(-1) for block, _ in blocks]
        column = [index[:, None, :].expand_as(block).reshape(-1) for block, index in blocks]
        value = [block.reshape(-1) for block, _ in blocks]
        row.append(2 * count + torch.arange(split))
        column.append(torch.arange(split))
        value.append(torch.full((split,), self.prior_weight, dtype=torch.float64))
        entries = torch.cat(value).numpy(), (torch.cat(row).numpy(), torch.cat(column).numpy())
        return csr_matrix(entries, shape=(2 * count + split, width))


def _triangulated(cameras: list[Camera], observations: Observations) -> Triangulation:
    rotation = torch.stack([camera.rotation.double() for camera in cameras])
    directions = (observations.bearings_camera[..., None, :] @ rotation).squeeze(-2)
    return triangulate(camera_centers(cameras), directions, observations.weights)


def _moved(camera: Camera, step: Float[Tensor, " 6"]) -> Camera:
    turn = matrix_from_axis_angle(step[:3].double())
    rotation = turn @ camera.rotation.double()
    # turn (R (X - c)) + s = R' (X - c + R'^T s)
    return Camera(camera.lens, camera.center_world.double() - rotation.T @ step[3:], rotation)


def _across(bearing: Float[Tensor, "observation 3"]) -> Float[Tensor, "observation 2 3"]:
    """Two unit vectors across each bearing and across each other."""
    smallest = bearing.abs().argmin(-1)
    axis = torch.nn.functional.one_hot(smallest, 3).to(bearing.dtype)
    first = torch.nn.functional.normalize(torch.linalg.cross(axis, bearing), dim=-1)
    return torch.stack([first, torch.linalg.cross(bearing, first)], -2)


def _left_jacobian(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """D exp(r + dr) = exp(J dr) exp(r): J = I + (1 - cos a)/a^2 K + (a - sin a)/a^3 K^2."""
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < 1e-4
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - squared / 24, 2 * torch.sin(angle / 2) ** 2 / safe)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / (safe * angle))
    cross = cross_matrix(axis_angle)
    return torch.eye(3, dtype=axis_angle.dtype) + first * cross + second * (cross @ cross)
