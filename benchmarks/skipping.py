"""What each level of skipping saves, and what it changes: one level switched off at a time.

Usage: python -m benchmarks.skipping [RESULTS] (see benchmarks/quadrature.py). Writes
benchmarks/results/skipping.json. The last row compares with the paper's sampler: 128 samples on
every ray that meets the box of the joints, each of which computes a density, as ours do; looking up
voxels, which ours do besides, is counted in the column beside.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.environment import write_result
from benchmarks.subjects import RIGS, Subject, chosen_results, subjects
from ntop.conventions import PIXEL_CENTRE
from ntop.field.culling import body_pixels
from ntop.field.paper_sampler import SAMPLES, box_interval
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view, trace_rays
from ntop.geometry.cameras import Camera
from ntop.geometry.windows import resized

SIDE_PX = 160
ON = RenderSettings(edge_rays=1)
LEVELS = {  # level -> settings without it; `views` of a camera that looks away
    "pixels": replace(ON, crop=False),
    "intervals": replace(ON, intervals=False),
    "cells": replace(ON, cells=False),
    "behind surfaces": replace(ON, stop_transmittance=0.0),
    "colour of light weights": replace(ON, colour_floor=0.0),
    "all": replace(
        ON, crop=False, intervals=False, cells=False, stop_transmittance=0.0, colour_floor=0.0
    ),
}
EXACT = 1e-6
POLL = 5  # every how many rays' pieces are counted
STOP_BOUND = EXACT + ON.stop_transmittance


def main(results: Path | None) -> None:
    """Measure and write."""
    people = subjects(results)
    rows = [row for person in people for rig in RIGS for row in measured(person, rig)]
    rows += [away(person, rig) for person in people for rig in RIGS]
    values = {
        "side_px": SIDE_PX,
        "rows": rows,
        "paper": [paper(person) for person in people],
    }
    sys.stdout.write(f"{write_result('skipping', values)}\n")


def small_views(person: Subject, rig: str) -> list[Camera]:
    """The nine cameras of a rig with smaller images."""
    return [
        replace(camera, lens=resized(camera.lens, width=SIDE_PX, height=SIDE_PX))
        for camera in person.cameras(rig).values()
    ]


def measured(person: Subject, rig: str) -> list[dict]:
    """One row per level: work and time without it over those with all, largest pixel change."""
    cameras = small_views(person, rig)
    posed = {name: person.posed(settings) for name, settings in {"on": ON, **LEVELS}.items()}
    full = [render_view(posed["on"], camera, settings=ON) for camera in cameras]
    shared = shared_colour_bound(posed["on"], cameras)
    bounds = {  # largest change of a value in [0, 1] that the level may cause
        "pixels": EXACT,
        "intervals": EXACT,
        "cells": EXACT,
        "behind surfaces": STOP_BOUND,
        "colour of light weights": EXACT + shared,
        "all": STOP_BOUND + shared,
    }
    rows = []
    for level, settings in LEVELS.items():
        evaluations, change, ratios = 0, 0.0, []
        for camera, whole in zip(cameras, full, strict=True):
            before = _seconds(posed["on"], camera, ON)
            started = time.process_time()
            seen = render_view(posed[level], camera, settings=settings)
            between = time.process_time() - started
            ratios.append(2 * between / (before + _seconds(posed["on"], camera, ON)))
            evaluations += seen.evaluations
            for layer, other in ((seen.alpha, whole.alpha), (_over(seen), _over(whole))):
                change = max(change, float(np.abs(layer - other).max()))
        rows.append(
            {
                "subject": person.name,
                "rig": rig,
                "level": level,
                "evaluations": evaluations,
                "evaluations_with_all": sum(view.evaluations for view in full),
                "time_ratio": float(np.median(ratios)),
                "largest_change": change,
                "bound": bounds[level],
                "within_bound": change <= bounds[level],
            }
        )
    sys.stderr.write(f"{person.name} {rig}\n")
    return rows


def shared_colour_bound(posed: PosedAvatar, cameras: list[Camera]) -> float:
    """How much pieces that share the next one's colour may change a ray: floor times pieces.

    Each time a colour is looked up, at most `colour_floor` of light takes it that should have
    another; a ray looks up a colour at most once per piece, and a piece has two samples.
    """
    pieces = 0
    for camera in cameras:
        v, u = np.nonzero(body_pixels(posed.warp, camera))
        directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
        for ray in directions[valid][::POLL]:
            seen = trace_rays(posed, camera.center_world, ray[None], settings=ON)
            pieces = max(pieces, seen.samples // 2)
    return ON.colour_floor * pieces


def paper(person: Subject) -> dict:
    """Share of the paper's samples that are never computed, mean over both rigs' views."""
    joints = person.joints_world()
    posed = person.posed(ON)
    skipped = []
    for rig in RIGS:
        for camera in small_views(person, rig):
            grid = np.mgrid[:SIDE_PX, :SIDE_PX].reshape(2, -1).T[:, ::-1] + PIXEL_CENTRE
            directions, valid = camera.rays(torch.from_numpy(grid.copy()))
            near, far = box_interval(camera.center_world.numpy(), directions[valid].numpy(), joints)
            theirs = SAMPLES * int((far > near).sum())
            view = render_view(posed, camera, settings=ON)
            skipped.append((1 - view.samples / theirs, 1 - view.evaluations / theirs))
    samples, evaluations = np.array(skipped).T
    return {
        "subject": person.name,
        "views": len(skipped),
        "mean": float(samples.mean()),
        "min": float(samples.min()),
        "mean_with_lookups": float(evaluations.mean()),
    }


def away(person: Subject, rig: str) -> dict:
    """The level `views`: a camera that looks at the sky, with no cell in view and so no ray."""
    camera = small_views(person, rig)[0]
    flipped = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)) @ camera.rotation
    up = replace(camera, rotation=flipped)
    posed, without = person.posed(ON), LEVELS["pixels"]
    seen, whole = (render_view(posed, up, settings=one) for one in (without, ON))
    ratios = [_seconds(posed, up, without) / _seconds(posed, up, ON) for _ in range(5)]
    change = max(float(np.abs(seen.alpha - whole.alpha).max()), float(np.abs(seen.rgb).max()))
    return {
        "subject": person.name,
        "rig": rig,
        "level": "views",
        "evaluations": seen.evaluations,
        "evaluations_with_all": whole.evaluations,
        "time_ratio": float(np.median(ratios)),
        "largest_change": change,
        "bound": EXACT,
        "within_bound": change <= EXACT,
    }


def _over(view) -> np.ndarray:
    return view.rgb * view.alpha[..., None]


def _seconds(posed, camera: Camera, settings: RenderSettings) -> float:
    started = time.process_time()
    render_view(posed, camera, settings=settings)
    return time.process_time() - started


if __name__ == "__main__":
    main(chosen_results())
