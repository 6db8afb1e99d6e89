"""Write the tables of docs/benchmarks.md from benchmarks/results/{quadrature,skipping}.json."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/benchmarks.md"
RESULTS = ROOT / "benchmarks/results"
MARK = "<!-- tables -->"


def main() -> None:
    """Replace what follows the mark in the page."""
    quadrature = json.loads((RESULTS / "quadrature.json").read_text())
    skipping = json.loads((RESULTS / "skipping.json").read_text())
    lines = [*quadrature_lines(quadrature), *skipping_lines(skipping)]
    head = PAGE.read_text().split(MARK)[0]
    PAGE.write_text(head + MARK + "\n" + "\n".join(lines) + "\n")


def quadrature_lines(values: dict) -> list[str]:
    """Presets and single knobs: errors of the worst subject, cost relative to the default."""
    lines = [
        "",
        "## Quadrature",
        "",
        f"Subjects: {', '.join(values['subjects'])}; {values['rays']} rays. "
        f"{where(values)} Chosen: {setting_list(values['chosen'])}.",
        "",
        "| point | rms | p99.9 | evaluations per ray | time / default | meets the bars |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for point in values["points"]:
        name = point["knob"]
        if name in point["settings"]:
            name = f"`{name}` {point['settings'][name]:g}"
        lines.append(
            f"| {name} | {point['rms']:.2f} | {point['p999']:.2f} | "
            f"{point['evaluations_per_ray']:.0f} | {point['time_ratio']:.2f} | "
            f"{'yes' if point['meets'] else 'no'} |"
        )
    lines += [
        "",
        "Spatial error (rms against 8 x 8 rays in every pixel, 250 px images):",
        "",
        "| subject | 1 ray | 4 rays at edges | evaluations per pixel, 1 ray | 4 rays |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in values["spatial"]:
        lines.append(
            f"| {row['subject']} | {row['rms_1']:.2f} | {row['rms_4']:.2f} | "
            f"{row['evaluations_1']:.0f} | {row['evaluations_4']:.0f} |"
        )
    return lines


def skipping_lines(values: dict) -> list[str]:
    """One level off at a time."""
    lines = [
        "",
        "## Skipping",
        "",
        f"One level switched off at a time, nine views of a rig, {values['side_px']} px images. "
        + where(values),
        "",
        "| subject | rig | without | evaluations / all levels on | time / all levels on "
        "| largest change | bound |",
        "|---|---|---|---:|---:|---:|---:|",
    ]
    for row in values["rows"]:
        bound = "" if row["bound"] is None else f"{row['bound']:.1g}"
        lines.append(
            f"| {row['subject']} | {row['rig']} | {row['level']} | "
            f"{row['evaluations'] / row['evaluations_with_all']:.2f} | {row['time_ratio']:.2f} | "
            f"{row['largest_change']:.1g} | {bound} |"
        )
    lines += [
        "",
        "Of the paper's box x 128 samples, each of which computes a density, ours leave out:",
        "",
        "| subject | views | samples | least of a view | counting voxels looked up as well |",
        "|---|---:|---:|---:|---:|",
    ]
    for row in values["paper"]:
        lines.append(
            f"| {row['subject']} | {row['views']} | {row['mean']:.2%} | {row['min']:.2%} | "
            f"{row['mean_with_lookups']:.2%} |"
        )
    looks = max(row["evaluations"] for row in values["views"])
    return [*lines, "", f"A view with nobody in it costs {looks} evaluations."]


def where(values: dict) -> str:
    """The machine."""
    ran = values["environment"]
    return f"On {ran['cores']} cores of {ran['cpu']}, commit {ran['commit']}."


def setting_list(values: dict) -> str:
    """Settings in one line."""
    return ", ".join(f"`{name}` {value:g}" for name, value in values.items())


if __name__ == "__main__":
    main()
