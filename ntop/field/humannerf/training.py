"""Train the twin to its last step, in as many pieces as it takes.

A stopped training goes on with the same bytes: a step depends on the seed and its number only.
"""

import time
from collections.abc import Callable
from pathlib import Path

from ntop.body.model import BodyModel
from ntop.field.humannerf.avatar import HumanNerfAvatar
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.trainer import HumanNerfTrainer
from ntop.field.patches import Perceptual
from ntop.field.progress import Progress, TrainingStoppedError
from ntop.field.views import TrainingViews

CHECKPOINT_EVERY_S = 60.0


def train_humannerf(
    views: TrainingViews,
    model: BodyModel,
    betas: tuple[float, ...],
    *,
    settings: HumanNerfSettings,
    perceptual: Perceptual | None = None,
    checkpoint_path: Path | None = None,
    on_step: Callable[[Progress], None] | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> tuple[HumanNerfAvatar, list[Progress]]:
    """Train to the last step; continues from `checkpoint_path` if it exists.

    `perceptual` compares images (0..1) and gives a distance each; without it the loss is the
    squared error alone, and the avatar says so.

    Raises:
        TrainingStoppedError: `stop_requested` became true; the state is saved.
        DataError: no view is large enough for a patch, or the checkpoint is damaged.
    """
    trainer = HumanNerfTrainer(views, model, betas, settings=settings, perceptual=perceptual)
    if checkpoint_path is not None:
        trainer.restore(checkpoint_path)
    saved_s = time.monotonic()
    with trainer:
        while trainer.step < settings.steps:
            progress = trainer.advance()
            if on_step is not None:
                on_step(progress)
            due = time.monotonic() - saved_s > CHECKPOINT_EVERY_S
            if checkpoint_path is not None and (due or stop_requested()):
                trainer.save(checkpoint_path)
                saved_s = time.monotonic()
            if stop_requested():
                raise TrainingStoppedError(f"stopped after step {trainer.step} of {settings.steps}")
        return trainer.avatar(), trainer.curve
