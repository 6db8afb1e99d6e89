"""What a training says of itself while it runs, whichever field it trains."""

from dataclasses import dataclass

import numpy as np

TINY_MSE = 1e-10


@dataclass(frozen=True)
class Progress:
    """One line of the curve. Watched PSNR is NaN where it was not measured."""

    step: int
    loss: float
    psnr_person_db: float
    watched_psnr_db: float


@dataclass(frozen=True)
class GridProgress(Progress):
    """The grid's line also tells how many bricks learned."""

    active_bricks: int


class TrainingStoppedError(Exception):
    """Training was asked to stop and has saved its state."""


def psnr_db(mean_squared_error: float) -> float:
    """PSNR of values in 0..1."""
    return float(-10 * np.log10(max(mean_squared_error, TINY_MSE)))
