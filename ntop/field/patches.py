"""Training patches: small squares of one photograph, mostly on the person, over a random colour."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from ntop.conventions import MASK_ALPHA, PIXEL_CENTRE, DataError
from ntop.field.views import TrainingViews

Perceptual = Callable[
    [Float[torch.Tensor, "image row column 3"], Float[torch.Tensor, "image row column 3"]],
    Float[torch.Tensor, " image"],
]


@dataclass(frozen=True)
class Patches:
    """Squares of one view. `targets` are composited on `background`, values in 0..1."""

    view: int
    directions: Float[torch.Tensor, "patch row column 3"]
    targets: Float[torch.Tensor, "patch row column 3"]
    mattes: Float[torch.Tensor, "patch row column"]
    background: Float[torch.Tensor, " 3"]


class PatchSource:
    """Draws patches from some of the views."""

    def __init__(
        self,
        views: TrainingViews,
        chosen: Int[np.ndarray, " any"],
        *,
        side_px: int,
        inside_share: float,
    ) -> None:
        """Keep the views that a patch fits into.

        Raises:
            DataError: none of them is large enough.
        """
        self._views, self._side, self._inside = views, side_px, inside_share
        self.chosen = [v for v in chosen if min(views.crops[v].shape[:2]) >= side_px]
        if not self.chosen:
            raise DataError(
                f"no picture shows the person in a box of at least {side_px} x {side_px} px; "
                "raise train.max_person_px, or lower train.humannerf.patch_px (field humannerf) or "
                "set train.lpips_weight to 0 (field grid)"
            )

    def draw(self, count: int, *, generator: np.random.Generator) -> Patches:
        """`count` patches of one random view."""
        view = self.chosen[int(generator.integers(len(self.chosen)))]
        crop = self._views.crops[view]
        person = crop[..., 3] >= MASK_ALPHA
        corners = [self._corner(person, generator) for _ in range(count)]
        background = generator.random(3, np.float32)
        return self.cut(view, corners, background)

    def cut(
        self, view: int, corners: list[tuple[int, int]], background: Float[np.ndarray, " 3"]
    ) -> Patches:
        """The patches of one view with these top left corners (row, column of the crop)."""
        crop, camera = self._views.crops[view], self._camera(view)
        left, top = self._views.boxes[view][:2]
        rows = np.arange(self._side)
        pixels = np.stack(
            [
                np.stack(np.meshgrid(column + rows + left, row + rows + top), -1)
                for row, column in corners
            ]
        )
        squares = np.stack(
            [crop[r : r + self._side, c : c + self._side] for r, c in corners]
        ).astype(np.float32)
        directions, _ = camera.rays(torch.from_numpy(pixels + PIXEL_CENTRE))
        matte = torch.from_numpy(squares[..., 3] / 255)
        colour = torch.from_numpy(squares[..., :3] / 255)
        behind = torch.from_numpy(background)
        targets = colour * matte[..., None] + behind * (1 - matte[..., None])
        return Patches(view, directions, targets, matte, behind)

    def _camera(self, view: int):
        return self._views.cameras[self._views.camera_of_view[view]]

    def _corner(self, person: np.ndarray, generator: np.random.Generator) -> tuple[int, int]:
        """Top left corner of a patch around a pixel of the person, or now and then of none."""
        wanted = person if generator.random() < self._inside else ~person
        candidates = np.flatnonzero(wanted if wanted.any() else ~wanted)
        row, column = np.unravel_index(
            candidates[int(generator.integers(len(candidates)))], person.shape
        )
        limits = np.array(person.shape) - self._side
        row, column = np.clip(np.array([row, column]) - self._side // 2, 0, limits)
        return int(row), int(column)
