"""Time against error of the renderer's quadrature, and the choice of its default preset.

Usage: python -m benchmarks.quadrature [RESULTS] (a finished demo's results folder; default
`results`, where there is one). Writes benchmarks/results/quadrature.{json,png}.

The reference is the same avatar in float64, pieces of at most 0.1 mm, nothing skipped, no early
stop. One knob at a time around the default, then a greedy descent: the cheapest value of each knob
that keeps the bars. Costs are evaluations (exact, the tie-breaker) and processor time as a ratio to
the default, measured in turns: base, candidate, base.
"""

import math
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt

from benchmarks.environment import RESULTS, write_result
from benchmarks.subjects import RIGS, Subject, subjects
from ntop.conventions import PIXEL_CENTRE, VIEWS
from ntop.field.culling import body_pixels
from ntop.field.rendering import (
    PRESETS,
    PosedAvatar,
    RenderSettings,
    render_view,
    trace_rays,
)
from ntop.geometry.cameras import Camera
from ntop.geometry.windows import resized
from ntop.metrics.stripes import MAX_AMPLITUDE, MAX_Z, lock_in

RAYS_PER_VIEW = 1000
ROUNDS = 7
REPEATS = 16  # of few milliseconds each, which alone would be noise
MAX_RMS, MAX_P999 = 0.5, 1.0  # grey levels
CHOICE_P999 = 0.9  # of the default: other people and poses are not these
SEEN_ALPHA = 0.02
SMALL_PX = 250  # images whose spatial error is measured
EIGHT_BIT_FLOOR = 1 / np.sqrt(12)  # rms of rounding, grey levels
BASE = RenderSettings(edge_rays=1)
REFERENCE = RenderSettings(
    step_m=1e-4,
    piece_depth=math.inf,
    stop_transmittance=0.0,
    colour_floor=0.0,
    cells=False,
    edge_rays=1,
)
KNOBS = {
    "step_m": (0.016, 0.008, 0.006, 0.004, 0.003, 0.002, 0.0015, 0.001, 0.0005),
    "piece_depth": (64.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "stop_transmittance": (1e-2, 1e-3, 1e-4, 0.0),
    "colour_floor": (1e-2, 1e-3, 1e-4, 0.0),
    "extent": (0.0, 0.5, 1.0),
    "intervals": (True, False),
    "cells": (True, False),
}
# the others are exact or wrong
CHOSEN_KNOBS = ("step_m", "piece_depth", "stop_transmittance", "colour_floor")


@dataclass(frozen=True)
class Scene:
    """Rays of one view, what the reference sees along them, and the avatar in both precisions."""

    subject: Subject
    posed: PosedAvatar
    camera: Camera
    directions: torch.Tensor
    truth: np.ndarray  # (rays, 4) premultiplied colour and alpha
    depth_m: np.ndarray

    def seen(self, settings: RenderSettings, *, posed: PosedAvatar | None = None):
        """Colour and alpha (rays, 4), and the evaluations they took."""
        rays = trace_rays(
            posed or self.posed, self.camera.center_world, self.directions, settings=settings
        )
        return np.concatenate([rays.rgb, rays.alpha[:, None]], 1), rays.evaluations


@dataclass(frozen=True)
class Errors:
    """Over all rays that meet the body, in grey levels of 255."""

    rms: float
    p99: float
    p999: float
    max: float
    stripe_z: float
    stripe_amplitude: float
    evaluations_per_ray: float

    @property
    def meets(self) -> bool:
        """The bars of issue 4: rms, p99.9 and no stripes."""
        striped = self.stripe_z >= MAX_Z or self.stripe_amplitude >= MAX_AMPLITUDE
        return self.rms <= MAX_RMS and self.p999 <= MAX_P999 and not striped


def main(results: Path | None) -> None:
    """Measure, choose, write."""
    people = subjects(results)
    scenes = [scene(person, rig, view) for person in people for rig in RIGS for view in VIEWS]
    names = [person.name for person in people]
    points = []
    for knob, values in KNOBS.items():
        for value in values:
            points.append(measured(scenes, names, replace(BASE, **{knob: value}), knob))
    points.append(measured(scenes, names, BASE, "precision", double=True))
    for name, preset in PRESETS.items():
        points.append(measured(scenes, names, replace(preset, edge_rays=1), f"preset {name}"))
    chosen = choose(scenes, names)
    points.append(measured(scenes, names, chosen, "chosen"))
    add_times(scenes, points)
    values = {
        "subjects": names,
        "rays": sum(len(s.directions) for s in scenes),
        "chosen": {knob: getattr(chosen, knob) for knob in CHOSEN_KNOBS},
        "presets": {name: asdict(preset) for name, preset in PRESETS.items()},
        "points": points,
        "spatial": [spatial(person) for person in people],
    }
    sys.stdout.write(f"{write_result('quadrature', values)}\n")
    plot(points, RESULTS / "quadrature.png")


def scene(person: Subject, rig: str, view: str) -> Scene:
    """Random pixels of one view, and their reference."""
    camera = person.cameras(rig)[view]
    posed = person.posed(BASE)
    v, u = np.nonzero(body_pixels(posed.warp, camera))
    chosen = np.random.default_rng(0).permutation(len(v))[:RAYS_PER_VIEW]
    chosen.sort()
    pixels = np.stack([u, v], 1)[chosen] + PIXEL_CENTRE
    directions, valid = camera.rays(torch.from_numpy(pixels))
    directions = directions[valid]
    exact = doubled(person.posed(REFERENCE))
    rays = trace_rays(exact, camera.center_world, directions, settings=REFERENCE)
    truth = np.concatenate([rays.rgb, rays.alpha[:, None]], 1)
    sys.stderr.write(f"{person.name} {rig} {view}: reference of {len(directions)} rays\n")
    return Scene(person, posed, camera, directions, truth, rays.depth_m)


def doubled(posed: PosedAvatar) -> PosedAvatar:
    """The same weights in float64, and all that is packed of them."""
    grid = replace(posed.grid, values=posed.grid.values.astype(np.float64))
    return replace(posed, grid=grid, light=posed.light.astype(np.float64), density=None)


def measured(scenes: list[Scene], names: list[str], settings, knob: str, *, double=False) -> dict:
    """One point: its errors per subject, and the worst of them."""
    by_subject = {
        name: errors([s for s in scenes if s.subject.name == name], settings, double=double)
        for name in names
    }
    worst = max(by_subject.values(), key=lambda e: e.p999)
    return {
        "knob": knob,
        "settings": asdict(settings),
        "double": double,
        "meets": all(e.meets for e in by_subject.values()),
        "rms": max(e.rms for e in by_subject.values()),
        "p999": worst.p999,
        "evaluations_per_ray": float(np.mean([e.evaluations_per_ray for e in by_subject.values()])),
        "by_subject": {name: asdict(e) for name, e in by_subject.items()},
    }


def errors(scenes: list[Scene], settings: RenderSettings, *, double: bool = False) -> Errors:
    """Errors over the rays of some scenes, those that meet the body."""
    differences, evaluations, stripes = [], 0, []
    for s in scenes:
        seen, count = s.seen(settings, posed=prepared(s, settings, double=double))
        difference = 255 * (seen - s.truth)
        met = s.truth[:, 3] > SEEN_ALPHA
        differences.append(difference[met])
        evaluations += count
        solid = s.truth[:, 3] > 0.99
        phase = s.depth_m[None] / settings.step_m
        found = lock_in((seen - s.truth)[None, :, :3], phase, solid[None])
        if not found.judged:
            raise RuntimeError(f"{found.pixels} rays cannot tell stripes: raise RAYS_PER_VIEW")
        stripes.append(found)
    every = np.concatenate(differences)
    largest = np.abs(every).max(-1)
    return Errors(
        rms=float(np.sqrt((every**2).mean())),
        p99=float(np.percentile(largest, 99)),
        p999=float(np.percentile(largest, 99.9)),
        max=float(largest.max()),
        stripe_z=max(found.z for found in stripes),
        stripe_amplitude=max(found.amplitude for found in stripes),
        evaluations_per_ray=evaluations / len(every),
    )


def prepared(s: Scene, settings: RenderSettings, *, double: bool) -> PosedAvatar:
    """The avatar as some settings want it posed."""
    posed = s.posed
    if (settings.cells, settings.extent) != (BASE.cells, BASE.extent):
        posed = s.subject.posed(settings)
    return doubled(posed) if double else posed


def choose(scenes: list[Scene], names: list[str]) -> RenderSettings:
    """Greedy: from exact values, the cheapest value of each knob in turn that keeps the bars."""
    chosen = replace(BASE, **{knob: KNOBS[knob][-1] for knob in CHOSEN_KNOBS})
    for knob in CHOSEN_KNOBS:
        for value in KNOBS[knob]:  # from cheap to dear
            candidate = replace(chosen, **{knob: value})
            found = measured(scenes, names, candidate, knob)
            if found["meets"] and found["p999"] <= CHOICE_P999:
                chosen = candidate
                break
    return chosen


def add_times(scenes: list[Scene], points: list[dict]) -> None:
    """Processor time of every point over that of BASE: median ratio of rounds in rotated order."""
    few = [s for n, s in enumerate(scenes) if n % (len(VIEWS) * len(RIGS)) == 0]
    settings = [RenderSettings(**p["settings"]) for p in points]
    posed = [
        [prepared(s, one, double=p["double"]) for s in few]
        for p, one in zip(points, settings, strict=True)
    ]
    ratios = [[] for _ in points]
    for turn in range(-1, ROUNDS):
        for n in np.roll(np.arange(len(points)), turn):
            before = seconds(few, BASE, [s.posed for s in few])
            between = seconds(few, settings[n], posed[n])
            after = seconds(few, BASE, [s.posed for s in few])
            if turn >= 0:  # the first is the warm-up
                ratios[n].append(2 * between / (before + after))
    for point, found in zip(points, ratios, strict=True):
        point["time_ratio"] = float(np.median(found))
        point["time_ratio_spread"] = float(np.ptp(found))


def seconds(scenes: list[Scene], settings: RenderSettings, posed: list[PosedAvatar]) -> float:
    """Processor time to trace all rays of some scenes."""
    started = time.process_time()
    for _ in range(REPEATS):
        for s, one in zip(scenes, posed, strict=True):
            s.seen(settings, posed=one)
    return time.process_time() - started


def spatial(person: Subject) -> dict:
    """Errors of one and of four rays at edges against 8 x 8 rays in every pixel (grey levels)."""
    camera = person.cameras("h1.0_r0.5")["centre"]
    small, fine = (
        replace(camera, lens=resized(camera.lens, width=side, height=side))
        for side in (SMALL_PX, 8 * SMALL_PX)
    )
    posed = person.posed(BASE)
    fine = render_view(posed, fine, settings=BASE)
    shape = (small.lens.height, 8, small.lens.width, 8)
    truth = np.concatenate(
        [
            (fine.rgb * fine.alpha[..., None]).reshape(*shape, 3).mean((1, 3)),
            fine.alpha.reshape(shape).mean((1, 3))[..., None],
        ],
        -1,
    )
    found = {"subject": person.name}
    for rays in (1, 4):
        view = render_view(posed, small, settings=replace(BASE, edge_rays=rays))
        seen = np.concatenate([view.rgb * view.alpha[..., None], view.alpha[..., None]], -1)
        met = truth[..., 3] > SEEN_ALPHA
        found[f"rms_{rays}"] = float(255 * np.sqrt(((seen - truth)[met] ** 2).mean()))
        found[f"evaluations_{rays}"] = view.evaluations / int(met.sum())
    return found


def plot(points: list[dict], path: Path) -> None:
    """Error against time, log-log; dominated points grey; bar and 8-bit floor."""
    mpl.use("agg")
    figure, axes = plt.subplots(figsize=(7, 4.5), dpi=110)
    [default] = [p["p999"] for p in points if p["knob"] == "preset default"]
    time_error = np.array([[p["time_ratio"], p["p999"]] for p in points])
    for n, (point, (t, e)) in enumerate(zip(points, time_error, strict=True)):
        others = np.delete(time_error, n, 0)
        dominated = bool(((others <= (t, e)).all(1) & (others < (t, e)).any(1)).any())
        axes.loglog(t, e, "o", ms=4, color="#bbbbbb" if dominated else "#3b6ea5")
        label = point["knob"]
        if not label.startswith(("preset", "chosen", "precision")):
            label = f"{label} {point['settings'][label]:g}"
        at_default = point["knob"] != "preset default" and abs(e / default - 1) < 0.05
        if not dominated or not at_default:  # the others lie on one another
            axes.annotate(label, (t, e), fontsize=5, xytext=(3, 2), textcoords="offset points")
    axes.axhline(MAX_P999, color="#b03a2e", lw=0.8)
    axes.axhline(EIGHT_BIT_FLOOR, color="#555555", lw=0.8, ls=":")
    axes.text(axes.get_xlim()[0], MAX_P999, " bar: p99.9 of one level", fontsize=6, va="bottom")
    axes.text(axes.get_xlim()[0], EIGHT_BIT_FLOOR, " 8-bit rounding", fontsize=6, va="bottom")
    axes.set_xlabel("processor time / default")
    axes.set_ylabel("p99.9 error (of 255)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    given = Path(sys.argv[1]) if sys.argv[1:] else Path("results")
    main(given if (given / "4_train").is_dir() else None)
