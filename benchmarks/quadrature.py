"""Time against error of the renderer's quadrature, and the choice of its default preset.

Usage: python -m benchmarks.quadrature [RESULTS] (a finished demo's results folder; default
`results`, where there is one). Writes benchmarks/results/quadrature.{json,png}.

One knob at a time around the default (`quadrature_errors` has the reference), then a greedy
descent: the cheapest value of each knob that keeps the bars. Costs are evaluations (exact, the
tie-breaker) and processor time as a ratio to the default, measured in turns: base, candidate, base.
"""

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from benchmarks.environment import RESULTS, write_result
from benchmarks.quadrature_errors import (
    BASE,
    REFERENCE,
    SEEN_ALPHA,
    Scene,
    Way,
    errors,
    prepared,
    scene,
    seconds,
)
from benchmarks.quadrature_plot import knee, plot
from benchmarks.subjects import RIGS, Subject, chosen_results, subjects
from ntop.conventions import VIEWS
from ntop.field.quality import PRESETS, RenderSettings
from ntop.field.rendering import render_view
from ntop.geometry.windows import resized

ROUNDS = 7
CHOICE_P999 = 0.9  # of the default: other people and poses are not these
SMALL_PX = 250  # images whose spatial error is measured
KNOBS = {
    "step_m": (0.016, 0.008, 0.006, 0.004, 0.003, 0.002, 0.0015, 0.001, 0.0005),
    "piece_depth": (64.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "stop_transmittance": (1e-2, 1e-3, 1e-4, 0.0),
    "colour_floor": (1e-2, 1e-3, 1e-4, 0.0),
    "extent": (0.0, 0.5, 1.0),
}
# the others are exact or wrong
CHOSEN_KNOBS = ("step_m", "piece_depth", "stop_transmittance", "colour_floor")
INTERVALS = {  # where rays look for density
    "box": replace(BASE, intervals=False, cells=False),
    "hull": replace(BASE, cells=False),
    "occupancy": BASE,
}
RULES = {"left": 0.0, "midpoint": 0.5}  # of the paper's samples in its box; ours is Gauss-2
PAPER_SAMPLES = (128, 512, 2048)


def ways() -> list[tuple[str, str, Way]]:
    """Knob, name and way of every point."""
    found = [
        (knob, f"{knob} {value:g}", Way(replace(BASE, **{knob: value})))
        for knob, values in KNOBS.items()
        for value in values
    ]
    found += [("interval", f"interval {name}", Way(one)) for name, one in INTERVALS.items()]
    found += [
        ("rule", f"rule {name}, {samples} in the paper's box", Way(samples=samples, shift=shift))
        for name, shift in RULES.items()
        for samples in PAPER_SAMPLES
    ]
    found += [
        ("precision", f"precision {name}", Way(precision=name))
        for name in ("fp64", "fp32", "fp16 values")
    ]
    return found + [
        (f"preset {name}", f"preset {name}", Way(replace(preset, edge_rays=1)))
        for name, preset in PRESETS.items()
    ]


def main(results: Path | None) -> None:
    """Measure, choose, write."""
    people = subjects(results)
    scenes = [scene(person, rig, view) for person in people for rig in RIGS for view in VIEWS]
    chosen = choose(scenes)
    all_ways = [*ways(), ("chosen", "chosen", Way(chosen))]
    points = [{"knob": knob, "name": name, **measured(scenes, way)} for knob, name, way in all_ways]
    add_times(scenes, [way for _, _, way in all_ways], points)
    float32 = measured(scenes, Way(REFERENCE))
    values = {
        "subjects": [person.name for person in people],
        "rays": sum(len(s.directions) for s in scenes),
        "chosen": {knob: getattr(chosen, knob) for knob in CHOSEN_KNOBS},
        "presets": {name: asdict(preset) for name, preset in PRESETS.items()},
        "points": points,
        "float32": float32,
        "knee": {error: points[knee(points, error)]["name"] for error in ("rms", "p999")},
        "spatial": [spatial(person) for person in people],
    }
    sys.stdout.write(f"{write_result('quadrature', values)}\n")
    plot(points, fp32_floor=float32, path=RESULTS / "quadrature.png")


def measured(scenes: list[Scene], way: Way) -> dict:
    """One point: its errors per subject, and the worst of them."""
    names = dict.fromkeys(s.subject.name for s in scenes)
    by_subject = {
        name: errors([s for s in scenes if s.subject.name == name], way) for name in names
    }
    every = by_subject.values()
    return {
        "settings": asdict(way.settings),
        "precision": way.precision,
        "samples": way.samples,
        "meets": all(e.meets for e in every),
        "rms": max(e.rms for e in every),
        "p999": max(e.p999 for e in every),
        "evaluations_per_ray": float(np.mean([e.evaluations_per_ray for e in every])),
        "by_subject": {name: asdict(e) for name, e in by_subject.items()},
    }


def choose(scenes: list[Scene]) -> RenderSettings:
    """Greedy: from exact values, the cheapest value of each knob in turn that keeps the bars."""
    chosen = replace(BASE, **{knob: KNOBS[knob][-1] for knob in CHOSEN_KNOBS})
    for knob in CHOSEN_KNOBS:
        for value in KNOBS[knob]:  # from cheap to dear
            candidate = replace(chosen, **{knob: value})
            found = measured(scenes, Way(candidate))
            if found["meets"] and found["p999"] <= CHOICE_P999:
                chosen = candidate
                break
    return chosen


def add_times(scenes: list[Scene], ways: list[Way], points: list[dict]) -> None:
    """Processor time of every point over that of BASE: median ratio of rounds in rotated order."""
    few = [s for n, s in enumerate(scenes) if n % (len(VIEWS) * len(RIGS)) == 0]
    posed = [[prepared(s, way) for s in few] for way in ways]
    base, base_posed = Way(), [s.posed for s in few]
    ratios = [[] for _ in points]
    for turn in range(-1, ROUNDS):
        for n in np.roll(np.arange(len(points)), turn):
            before = seconds(few, base, base_posed)
            between = seconds(few, ways[n], posed[n])
            after = seconds(few, base, base_posed)
            if turn >= 0:  # the first is the warm-up
                ratios[n].append(2 * between / (before + after))
    for point, found in zip(points, ratios, strict=True):
        point["time_ratio"] = float(np.median(found))
        point["time_ratio_least"] = float(min(found))
        point["time_ratio_spread"] = float(np.ptp(found))


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


if __name__ == "__main__":
    main(chosen_results())
