"""What errors and scarcity of a capture cost: the pinned studio actor from above in novel poses.

One axis at a time around the pinned capture: errors of poses, cameras and mattes as the studio
makes them (ntop/captures/studio/recording.py), fewer and more cameras, fewer and more frames of the
same motion. Every point is a training of the same length, scored on the same true views.

Usage: python -m benchmarks.robustness [--quick] [--steps N] [--axes NAME ...]
Finished points, and what was trained of the next, stay in --work; the same command goes on where it
was stopped.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.fields import kept_field
from benchmarks.pictures import (
    Studio,
    motion_poses,
    novel_poses,
    open_studio,
    recorded_views,
    true_views,
)
from benchmarks.robustness_plot import plot
from benchmarks.studio import Scores, chosen_rows, score
from ntop.captures.studio.recording import disturbed, grown, misplaced
from ntop.config.sections import TrainConfig
from ntop.field.avatar import Avatar
from ntop.field.posing import pose_avatar
from ntop.field.rendering import render_view
from ntop.field.training import train
from ntop.field.views import TrainingViews
from ntop.stages.s4_train import training_settings
from ntop.storage.atomic import write_bytes

VIEWS = ("centre", "e")
STEPS = 400
FRAMES = 20  # of the pinned capture; its 8 cameras are in config/studio.yaml


@dataclass(frozen=True)
class Axis:
    """What is varied: the values, the pinned one among them."""

    name: str
    label: str
    values: tuple[int | float, ...]
    pinned: int | float


AXES = (
    Axis("pose_noise_mm", "pose error (mm)", (0, 5, 10, 20, 40), 0),
    Axis("calibration_noise_px", "calibration error (px)", (0, 0.5, 1, 2, 4), 0),
    Axis("mask_growth_px", "mask growth (px)", (-2, -1, 0, 1, 2), 0),
    Axis("cameras", "cameras", (2, 4, 8, 16), 8),
    # the warps of a pose take 18 MB and a third of a processor second, and twice that while
    # they are joined: 400 would need 14 GB
    Axis("frames", "frames", (10, 20, 100, 200), FRAMES),
)


@dataclass(frozen=True)
class Bench:
    """What all points share."""

    studio: Studio
    truth: Path
    rows: list[dict[str, Any]]
    steps: int

    def point(self, name: str, views: Callable[[], TrainingViews]) -> dict[str, Any]:
        """The scores of a finished point from disk, or train, score and keep it."""
        folder = self.studio.work / "fields" / f"{name}_{self.steps}"
        path = folder / f"scores_{len(self.rows)}.json"
        if not path.exists():
            scores = asdict(
                self._scores(kept_field(folder, lambda file: self._trained(views(), file)))
            )
            write_bytes(path, json.dumps(scores, indent=1).encode())
        scores = json.loads(path.read_text())
        print(name, scores, flush=True)
        return scores

    def _trained(self, views: TrainingViews, checkpoint: Path) -> Avatar:
        model, betas = self.studio.actor.model, self.studio.betas
        settings = training_settings(TrainConfig(steps=self.steps))
        return train(views, model, betas, settings=settings, checkpoint_path=checkpoint)[0]

    def _scores(self, avatar: Avatar) -> Scores:
        def show(pose, cameras):
            posed = pose_avatar(avatar, self.studio.actor.model, pose)
            return [render_view(posed, camera) for camera in cameras]

        return score(self.truth, self.rows, show, lpips=None)


def main() -> None:
    """Train and score every point, then write robustness.json and robustness.png."""
    options = parsed()
    torch.set_num_threads(1)  # the kernels have their own threads
    studio = open_studio(options.packages, options.work)
    truth = true_views(studio, novel_poses(studio, sets=1), rigs=1, settings=studio.settings)
    rows = chosen_rows(truth, actions=options.actions, views=list(VIEWS), rigs=1, sets=1)
    bench = Bench(studio, truth, rows, options.steps)
    name = "robustness_quick" if options.quick else "robustness"
    axes = [axis for axis in AXES if axis.name in options.axes]
    points: list[dict[str, Any]] = []
    for axis in axes:
        for value in options.values(axis):
            same = value == axis.pinned
            label = "base" if same else f"{axis.name}_{value:g}"
            scores = bench.point(label, lambda a=axis, v=value: varied(studio, a, v))
            points.append({"axis": axis.name, "value": value, "pinned": same, "scores": scores})
            values = {
                "quick": options.quick, "steps": options.steps, "scored_views": len(rows),
                "axes": {axis.name: axis.label for axis in axes}, "points": points,
            }  # fmt: skip
            path = write_result(name, values)
            plot(values, RESULTS / f"{name}.png")
    print(path)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few steps, one value of each axis")
    parser.add_argument("--steps", type=int, help="of each training")
    parser.add_argument("--axes", nargs="+", default=[axis.name for axis in AXES])
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/studio")
    options = parser.parse_args()
    unknown = set(options.axes) - {axis.name for axis in AXES}
    if unknown:
        parser.error(f"no axis {sorted(unknown)}, have {[axis.name for axis in AXES]}")
    options.steps = options.steps or (12 if options.quick else STEPS)
    options.actions = ["walk"] if options.quick else []
    options.values = quick_values if options.quick else (lambda axis: axis.values)
    return options


def quick_values(axis: Axis) -> tuple[int | float, ...]:
    """The pinned value and one other."""
    return axis.pinned, next(value for value in axis.values if value != axis.pinned)


def varied(studio: Studio, axis: Axis, value: int | float) -> TrainingViews:
    """The pinned capture with one thing changed."""
    settings, frames = studio.settings, FRAMES
    if axis.name == "cameras":
        settings = settings.model_copy(update={"num_cameras": value})
    if axis.name == "frames":
        frames = value
    views = recorded_views(studio, motion_poses(studio, frames), settings)
    generator = np.random.default_rng(settings.seed)
    match axis.name:
        case "pose_noise_mm":
            poses = disturbed(views.poses, error_mm=value, generator=generator)
            return replace(views, poses=poses)
        case "calibration_noise_px":
            named = {f"{k:02d}": camera for k, camera in enumerate(views.cameras)}
            moved = misplaced(named, error_px=value, generator=generator)
            return replace(views, cameras=tuple(moved.values()))
        case "mask_growth_px":
            return replace(views, crops=tuple(_with_matte(crop, value) for crop in views.crops))
        case _:
            return views


def _with_matte(crop: np.ndarray, growth_px: int) -> np.ndarray:
    return np.concatenate([crop[..., :3], grown(crop[..., 3], growth_px)[..., None]], -1)


if __name__ == "__main__":
    main()
