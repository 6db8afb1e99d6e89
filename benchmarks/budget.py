"""What the error from above in novel poses consists of: truth put in place of one cause at a time.

Light, skinning, resolution and quadrature are substituted for the pinned studio actor `plain`; so
is learning, by a grid into which the true textures are written. The base's error is also split into
outline, slow and fine parts. The cases and what each substitutes: benchmarks/budget_cases.py.

Usage: python -m benchmarks.budget [--quick] [--steps N] [--cases NAME ...]
Finished cases, and what was trained of the next, stay in --work; the same command goes on where it
was stopped.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.budget_cases import (
    CASES,
    Case,
    case_avatar,
    case_model,
    case_truth,
    light_settings,
    seen,
)
from benchmarks.budget_plot import plot, strip
from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.error_parts import Diagnosis, Scores, diagnosis, scores
from benchmarks.fields import kept_field
from benchmarks.pictures import Studio, open_studio, true_views
from benchmarks.studio import chosen_rows
from ntop.field.avatar import Avatar
from ntop.field.posing import pose_avatar
from ntop.metrics.images import Cutout
from ntop.storage.atomic import write_bytes
from ntop.storage.bodies import body_pose_from_rows
from ntop.storage.images import read_rgba
from ntop.storage.renders import fisheye_camera

VIEWS = ("centre", "e")
STEPS = 400
SHOWN = ("base", "even light", "turned", "true surface", "fine", "all", "filled, all")


def main() -> None:
    """Score every case, then write budget.json, budget.png and budget_pictures.png."""
    options = parsed()
    torch.set_num_threads(1)  # the kernels have their own threads
    studio = open_studio(options.packages, options.work)
    name = "budget_quick" if options.quick else "budget"
    found: dict[str, dict[str, Any]] = {}
    chosen = [case for case in CASES if case.name in options.cases]
    for case in sorted(chosen, key=lambda case: case.fine and not case.filled):  # longest last
        found[case.name] = measured(studio, case, steps=options.steps, actions=options.actions)
        values = {
            "quick": options.quick, "steps": options.steps,
            "cases": [line(case, found) for case in CASES if case.name in found],
            "base_error": found["base"]["diagnosis"],
        }  # fmt: skip
        path = write_result(name, values)
        plot(values, RESULTS / f"{name}.png")
        print(case.name, found[case.name], flush=True)
    pictures = {
        case.name: next(pairs(studio, case, steps=options.steps, actions=options.actions))
        for case in CASES
        if case.name in found and case.name in SHOWN
    }
    strip(pictures, RESULTS / f"{name}_pictures.png")
    print(path)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few steps and cases, one action")
    parser.add_argument("--steps", type=int, help="of each training")
    parser.add_argument("--cases", nargs="+", help="besides the base")
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/studio")
    options = parser.parse_args()
    options.steps = options.steps or (12 if options.quick else STEPS)
    options.actions = ["walk", "turned"] if options.quick else []
    names = ["reference", "true surface"] if options.quick else [case.name for case in CASES]
    options.cases = {"base", *(options.cases or names)}
    unknown = options.cases - {case.name for case in CASES}
    if unknown:
        parser.error(f"no case {sorted(unknown)}, have {[case.name for case in CASES]}")
    return options


def measured(studio: Studio, case: Case, *, steps: int, actions: list[str]) -> dict[str, Any]:
    """Mean scores and diagnosis of a case: from disk, or made and kept."""
    views = "_".join(actions) or "all"
    path = studio.work / "cases" / f"{case.name.replace(', ', '_')}_{steps}_{views}.json"
    if not path.exists():
        found = [
            (scores(image, truth), diagnosis(image, truth))
            for image, truth in pairs(studio, case, steps=steps, actions=actions)
        ]
        values = {
            "views": len(found),
            "scores": mean(Scores, [pair[0] for pair in found]),
            "diagnosis": mean(Diagnosis, [pair[1] for pair in found]),
        }
        write_bytes(path, json.dumps(values, indent=1).encode())
    return json.loads(path.read_text())


def mean(kind: type, values: list[Any]) -> dict[str, float]:
    """Of each field, over the views."""
    return {
        field.name: float(np.mean([getattr(value, field.name) for value in values]))
        for field in fields(kind)
    }


def pairs(
    studio: Studio, case: Case, *, steps: int, actions: list[str]
) -> Iterator[tuple[Cutout, Cutout]]:
    """What the case's field shows, and the truth, of every scored view."""
    truth = true_views(
        studio, case_truth(studio, case), rigs=1, settings=light_settings(studio, case)
    )
    avatar, model = case_field(studio, case, steps=steps), case_model(studio, case)
    for view in VIEWS:
        for row in chosen_rows(truth, actions=actions, views=[view], rigs=1, sets=4):
            poses = body_pose_from_rows([row])
            posed = pose_avatar(avatar, model, poses.at(0))
            image = seen(posed, fisheye_camera(row), look=case.look)
            yield image, Cutout.from_rgba(read_rgba(truth / "truth" / row["image_path"]))


def case_field(studio: Studio, case: Case, *, steps: int) -> Avatar:
    """The case's field: from disk, or made and kept."""
    folder = studio.work / "fields" / (case.field_name + ("" if case.filled else f"_{steps}"))
    return kept_field(folder, lambda file: case_avatar(studio, case, steps=steps, checkpoint=file))


def line(case: Case, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A case as the page shows it: what was substituted, its scores, and what that gained."""
    own = found[case.name]["scores"]
    against = found.get(case.against, {}).get("scores")
    gains = against and {name: own[name] - against[name] for name in own if name != "mask_iou"}
    return {
        "name": case.name, "part": case.part, "substituted": case.words, "against": case.against,
        "views": found[case.name]["views"], "scores": own, "gain_db": gains,
    }  # fmt: skip


if __name__ == "__main__":
    main()
