"""Write the field's sections of docs/benchmarks.md from benchmarks/results.

A section whose benchmark was not run is left out, and so is a line whose point was not.
"""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/benchmarks.md"
RESULTS = ROOT / "benchmarks/results"
VARIANTS = {
    "grid": "grid + light", "grid_even": "grid, even light", "grid_head": "grid + light + head",
    "humannerf": "HumanNeRF twin",
}  # fmt: skip
POSE_METRICS = {
    "psnr_person_db": ("PSNR, person (dB)", ".2f"),
    "mask_iou": ("mask IoU", ".4f"),
    "depth_error_mm": ("depth error, median (mm)", ".2f"),
}
START, END = "<!-- field -->\n", "<!-- gpu -->"


def main() -> None:
    """Replace what lies between the marks in the page."""
    head, rest = PAGE.read_text().split(START)
    PAGE.write_text(head + START + sections(RESULTS) + END + rest.split(END)[1])


def sections(results: Path) -> str:
    """All sections whose figures lie in the folder."""
    lines = [""]
    written = {
        "field": field_lines, "robustness": robustness_lines, "budget": budget_lines,
        "poses": pose_lines, "heldout": heldout_lines,
    }  # fmt: skip
    for name, section in written.items():
        path = results / f"{name}.json"
        if path.exists():
            lines += [*section(json.loads(path.read_text())), ""]
    return "\n".join([*lines, ""])


def field_lines(values: dict[str, Any]) -> list[str]:
    """The variants in words, then one line per point in the order of the results."""
    lines = [
        "## Quality over training time",
        "",
        f"`python -m benchmarks.field`: the studio's actor `plain`, {values['pictures']} pictures, "
        f"{values['scored_views']} true views from above in novel poses. Seconds are those of "
        "training alone, after compilation and decoding. "
        f"{where(values)}",
        "",
        "* **grid + light**: the default; light that depends on the surface's direction in the "
        "world is learned with the colours.",
        "* **grid, even light**: the same without it, as long.",
        "* **grid + light + head**: a shorter training of the default, then a deferred head in the "
        "rest of the budget: a tiny network that corrects every pixel of a finished picture "
        "([decision 0022](decisions/0022-no-deferred-head.md)).",
        f"* **HumanNeRF twin**: the paper's method, on: {values['device']}; hollow marks in the "
        "plot are unconverged.",
        "",
        "![Quality over training time](../benchmarks/results/field.png)",
        "",
        "| variant | training (s) | steps | PSNR, box (dB) | SSIM | LPIPS | mask IoU "
        "| median depth error (mm) | s per view |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for point in values["points"]:
        scores = point["scores"]
        lpips, depth_mm = scores["lpips_vgg"], scores["depth_error_mm"]
        lines.append(
            f"| {VARIANTS[point['field']]}{'' if point['converged'] else ', unconverged'} | "
            f"{point['seconds']:.1f} | {point['iterations']} | {scores['psnr_box_db']:.2f} | "
            f"{scores['ssim_box']:.3f} | {'' if lpips is None else f'{lpips:.3f}'} | "
            f"{scores['mask_iou']:.4f} | {'' if depth_mm is None else f'{depth_mm:.1f}'} | "
            f"{point['render_s_per_view']:.2f} |"
        )
    if not any(point["field"] == "humannerf" for point in values["points"]):
        return [*lines, "", "The twin was not trained in this run."]
    wins = values["twin_wins"]
    won = ", ".join(sorted({win["metric"] for win in wins})) or "none"
    return [
        *lines,
        "",
        f"Metrics in which some state of the twin is better than a default grid that was trained "
        f"for no longer: {won}.",
    ]


def robustness_lines(values: dict[str, Any]) -> list[str]:
    """One line per point; the pinned capture is bold."""
    lines = [
        "## Robustness",
        "",
        f"`python -m benchmarks.robustness`: the studio's actor `plain`, {values['steps']} steps "
        f"per point, {values['scored_views']} true views from above in novel poses. One thing at "
        f"a time differs from the pinned capture (bold). {where(values)}",
        "",
        "![Robustness](../benchmarks/results/robustness.png)",
        "",
        "| axis | value | PSNR, box (dB) | mask IoU | median depth error (mm) |",
        "|---|---:|---:|---:|---:|",
    ]
    for point in values["points"]:
        value = f"{point['value']:g}"
        scores = point["scores"]
        depth_mm = scores["depth_error_mm"]
        lines.append(
            f"| {values['axes'][point['axis']]} | {f'**{value}**' if point['pinned'] else value} | "
            f"{scores['psnr_box_db']:.2f} | {scores['mask_iou']:.4f} | "
            f"{'' if depth_mm is None else f'{depth_mm:.1f}'} |"
        )
    return lines


def budget_lines(values: dict[str, Any]) -> list[str]:
    """One line per case, then where the base's error lies."""
    lines = [
        "## Error budget",
        "",
        "`python -m benchmarks.budget`: truth in place of one cause of the error at a time, "
        f"{values['steps']} steps per training, views from above in novel poses. Core: the mask "
        f"without its outermost 3 pixels. {where(values)}",
        "",
        "![Error budget](../benchmarks/results/budget.png)",
        "",
        "![Pictures of some cases](../benchmarks/results/budget_pictures.png)",
        "",
        "| case | part | substituted | box | person | core (dB) | IoU | against "
        "| gained: box | person | core (dB) |",
        "|---|---|---|---:|---:|---:|---:|---|---:|---:|---:|",
    ]
    names = ("psnr_box_db", "psnr_person_db", "psnr_core_db")
    for case in values["cases"]:
        own, gains = case["scores"], case["gain_db"]
        gained = [f"{gains[name]:+.2f}" if gains else "" for name in names]
        lines.append(
            f"| {case['name']} | {case['part']} | {case['substituted']} | "
            f"{' | '.join(f'{own[name]:.2f}' for name in names)} | {own['mask_iou']:.4f} | "
            f"{case['against']} | {' | '.join(gained)} |"
        )
    error = values["base_error"]
    return [
        *lines,
        "",
        f"The base's error: {error['outline_share']:.0%} of its squared error in the box lies "
        "outside the core. In the core, the slow part alone (shading, sigma 8 px) would leave "
        f"{error['slow_db']:.1f} dB, the fine part alone {error['fine_db']:.1f} dB. Against the "
        f"truth blurred by {error['blur_px']:.1f} px it is {error['blur_gain_db']:.1f} dB better; "
        f"aligned with the truth by optical flow (median {error['flow_px']:.2f} px) "
        f"{error['flow_gain_db']:.1f} dB.",
    ]


def pose_lines(values: dict[str, Any]) -> list[str]:
    """How scores go with the distance from the training poses."""
    found = values["summary"]
    low, high = found["distance_mm"]
    lines = [
        "## Novel poses",
        "",
        "`python -m benchmarks.poses` (in `make bench-field`): the pinned studio actor from above,",
        f"{found['novel_poses']} poses that were not trained on, {low:.0f} to {high:.0f} mm from "
        "the nearest of the",
        f"{values['training_poses']} that were (mean over the joints, pelvises laid upon each "
        "other), and some",
        f"of those, from above as well; {values['views']} views. {where(values)}",
        "",
        "| score | training poses | novel poses | change per 100 mm | rank correlation |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, (label, digits) in POSE_METRICS.items():
        row = found[name]
        lines.append(
            f"| {label} | {row['trained']:{digits}} | {row['novel']:{digits}} | "
            f"{row['per_100_mm']:+{digits}} | {row['rank_correlation']:+.2f} |"
        )
    return [*lines, "", "![Error over distance](../benchmarks/results/poses.png)"]


def heldout_lines(values: dict[str, Any]) -> list[str]:
    """One line per real camera, and their mean."""
    lines = [
        "## Real cameras held out in turn",
        "",
        "`python -m benchmarks.heldout` (in `make bench-field`): of the recording `balancing`, the "
        "stages",
        f"fit and train run without one camera, and its {len(values['frames'])} pictures of the "
        "reference frames judge the",
        "avatar, each cut out with the mask stage's matte. Only cam04 has masks checked by hand. "
        "The",
        f"painted body is the same body in one colour per part. {where(values)}",
        "",
        "| camera | PSNR, person (dB) | PSNR, box (dB) | mask IoU | painted body, person (dB) |",
        "|---|---:|---:|---:|---:|",
    ]
    rows = [(row["camera"], row["reference"], row["scores"]) for row in values["cameras"]]
    for camera, reference, scores in [*rows, ("mean", "", values["mean"])]:
        name = f"{camera}, {reference}" if "hand" in reference else camera
        lines.append(
            f"| {name} | {scores['psnr_person_db']:.2f} | {scores['psnr_box_db']:.2f} | "
            f"{scores['mask_iou']:.3f} | {scores['baseline_psnr_person_db']:.2f} |"
        )
    return lines


def where(values: dict[str, Any]) -> str:
    """The machine."""
    ran = values["environment"]
    return f"On {ran['cores']} cores of {ran['cpu']}, commit {ran['commit']}."


if __name__ == "__main__":
    main()
