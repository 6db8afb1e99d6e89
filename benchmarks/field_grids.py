"""The grid's curves: with its light, without (even light), and with a deferred head behind it.

A training of the grid is as long as its schedule, so every budget is a training of its own, as long
as the one before says that it fits. The head's share of a budget is spent on rendering what it
learns from and on learning.
"""

import functools
import json
import time
from dataclasses import replace

from benchmarks.deferred_head import Describer, PoseCode, corrected, photographed, train_head
from benchmarks.field_bench import Bench, Correction, Trained
from benchmarks.field_points import Point
from ntop.config.sections import TrainConfig
from ntop.field.avatar import Avatar
from ntop.field.training import train
from ntop.stages.s4_train import training_settings
from ntop.storage.atomic import write_bytes

PROBES = (10, 60)  # steps of the grid, to learn what a step and the poses' warps cost
HEAD_SHARE = 0.15  # of a budget; half of it for pictures to learn from
HEAD_GROUPS = ("normal",)  # the best from above; view, pose and place lose: decision 0022
LOSS = "colour, mask, priors"


def grid_points(bench: Bench, budgets: tuple[float, ...], *, light: bool = True) -> list[Point]:
    """One whole training per budget."""
    field = "grid" if light else "grid_even"
    pace_s, before_s = grid_pace(bench)
    points = []
    for budget_s in budgets:
        steps = _fitting(budget_s, pace_s, before_s)

        def train_it(budget_s: float = budget_s, steps: int = steps) -> Trained:
            run_grid(bench, 1, light=light)  # loads the compiled kernels
            avatar, seconds = run_grid(bench, steps, light=light)
            facts = {
                "field": field, "budget_s": budget_s, "seconds": round(seconds, 2),
                "iterations": avatar.step, "converged": True, "loss": LOSS,
            }  # fmt: skip
            return Trained(avatar, facts)

        point = bench.point(f"{field}_{budget_s:g}", train_it)
        pace_s = _step_s(point, before_s)
        points.append(point)
    return points


def head_points(bench: Bench, grids: list[Point]) -> list[Point]:
    """For each point of the grid a shorter training, and a head in the rest of its budget."""
    before_s = grid_pace(bench)[1]
    points = []
    for grid in grids:
        steps = _fitting((1 - HEAD_SHARE) * grid.budget_s, _step_s(grid, before_s), before_s)

        def train_it(budget_s: float = grid.budget_s, steps: int = steps) -> Trained:
            run_grid(bench, 1)
            avatar, grid_s = run_grid(bench, steps)
            run_head(bench, avatar, 0.0)  # compiles
            correction, head_step, head_s = run_head(bench, avatar, HEAD_SHARE * budget_s)
            facts = {
                "field": "grid_head", "budget_s": budget_s, "seconds": round(grid_s + head_s, 2),
                "iterations": avatar.step, "converged": True,
                "loss": f"{LOSS}; head: colour, {head_step} steps",
            }  # fmt: skip
            return Trained(avatar, facts, correction)

        points.append(bench.point(f"grid_head_{grid.budget_s:g}", train_it))
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


def _step_s(point: Point, before_s: float) -> float:
    return max(point.seconds - before_s, 1e-3) / point.iterations


def _fitting(seconds: float, pace_s: float, before_s: float) -> int:
    return max(int((seconds - before_s) / pace_s), PROBES[0])


def run_grid(bench: Bench, steps: int, *, light: bool = True) -> tuple[Avatar, float]:
    """A training of the grid with its defaults; also its seconds."""
    settings = replace(training_settings(TrainConfig(steps=steps)), light=light)
    started = time.monotonic()
    avatar, _ = train(bench.views, bench.model, bench.betas, settings=settings)
    return avatar, time.monotonic() - started


def run_head(bench: Bench, avatar: Avatar, budget_s: float) -> tuple[Correction, int, float]:
    """A head for a trained grid; also the step at which it was best, and its seconds."""
    started = time.monotonic()

    def spent(share: float) -> float:
        return (time.monotonic() - started) / max(share * budget_s, 1e-3)

    describer = Describer(PoseCode.of(bench.views.poses), HEAD_GROUPS)
    pixels = functools.partial(photographed, avatar, bench.model, bench.views, describer)
    watched = pixels(watched=True, spent=lambda: spent(0.15))
    seen = pixels(watched=False, spent=lambda: spent(0.5))
    head, step = train_head(seen, watched, spent=lambda: spent(1.0))

    def correction(posed, pose, camera, rendering):
        return corrected(head, describer, posed, pose=pose, camera=camera, rendering=rendering)

    return correction, step, time.monotonic() - started
