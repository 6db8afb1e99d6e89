"""Write the tables of docs/benchmarks.md from benchmarks/results."""

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
    throughput = json.loads((RESULTS / "throughput.json").read_text())
    lines = [
        *quadrature_lines(quadrature),
        *skipping_lines(skipping),
        *throughput_lines(throughput),
    ]
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
        "| point | rms | p99.9 | depth median, p99 (mm) | mask IoU | visibility flips "
        "| evaluations per ray | time / default | MB | meets the bars |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    lines += [quadrature_row(point) for point in values["points"]]
    float32, joints = values["float32"], values["points"][0]["by_subject"]
    lines += [
        "",
        f"Visibility flips are of {sum(e['joints_in_view'] for e in joints.values())} joints in "
        "view. MB: the most that numpy held while a view's rays were marched. The reference's "
        f"settings in float32: rms {float32['rms']:.3f}, p99.9 {float32['p999']:.3f}, the floor of "
        f"single precision. Knee of the front: `{values['knee']['rms']}` (rms), "
        f"`{values['knee']['p999']}` (p99.9). What a view's time consists of: "
        "[views per second](#views-per-second). The design's other axes: a margin around the body "
        "has no counterpart here, `extent` asks of the field itself how far density may lie; "
        "there is no network whose precision could be lower; how fine the grid is, is the "
        "trained avatar's own error.",
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


def quadrature_row(point: dict) -> str:
    """A point's line; the worst subject counts."""
    every = point["by_subject"].values()
    depth, flips = "", ""
    if not point["samples"]:  # the paper's sampler has no depth
        median = max(e["depth_median_mm"] for e in every)
        depth = f"{median:.3f}, {max(e['depth_p99_mm'] for e in every):.2f}"
        flips = sum(e["visibility_flips"] for e in every)
    return (
        f"| {point['name']} | {point['rms']:.2f} | {point['p999']:.2f} | {depth} | "
        f"{min(e['mask_iou'] for e in every):.4f} | {flips} | "
        f"{point['evaluations_per_ray']:.0f} | {point['time_ratio']:.2f} | "
        f"{max(e['peak_mb'] for e in every):.1f} | {'yes' if point['meets'] else 'no'} |"
    )


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
        work, work_on = row["evaluations"], row["evaluations_with_all"]
        lines.append(
            f"| {row['subject']} | {row['rig']} | {row['level']} | "
            f"{f'{work / work_on:.2f}' if work_on else f'{work} / {work_on}'} | "
            f"{row['time_ratio']:.2f} | {row['largest_change']:.1g} | {row['bound']:.1g} |"
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
    return [
        *lines,
        "",
        "`pixels` saves no evaluation, because rays that miss every cell cost none either way: it "
        "saves making and starting them. `views`: a camera that looks at the sky.",
    ]


def throughput_lines(values: dict) -> list[str]:
    """Views per second by work and cores, what a view is made of, and the axes."""
    sizes = ", ".join(f"{name} {size:.0f}" for name, size in values["person_px"].items())
    lines = [
        "",
        "## Views per second",
        "",
        "The render stage's own code on sets of nine views of 1000 x 1000 pixels, "
        f"{values['cores'][0]['height_m']:g} m above the pelvis, ring of 1 m; `files`: RGBA, depth "
        "and parts written; `labels`: read again and annotated as well. The larger side of the "
        f"person's box, mean of the nine views: {sizes} pixels. {where(values)}",
        "",
        "![Views per second](../benchmarks/results/throughput.png)",
        "",
        "| subject | work | preset | one core | two threads | two jobs | gain of two jobs "
        "| MB per job |",
        "|---|---|---|---:|---:|---:|---:|---:|",
    ]
    for one, two, jobs in zip(*(values["cores"][k::3] for k in range(3)), strict=True):
        lines.append(
            f"| {one['subject']} | {one['work']} | {one['quality']} | {one['views_per_s']:.1f} | "
            f"{two['views_per_s']:.1f} | {jobs['views_per_s']:.1f} | "
            f"{jobs['views_per_s'] / one['views_per_s']:.2f} | {one['peak_mb']} |"
        )
    names = [name for name in values["parts"][0] if name != "subject"]
    lines += [
        "",
        "Milliseconds of one core per view:",
        "",
        f"| subject | {' | '.join(names)} |",
        f"|---|{'---:|' * len(names)}",
    ]
    lines += [
        f"| {row['subject']} | {' | '.join(f'{row[name]:.1f}' for name in names)} |"
        for row in values["parts"]
    ]
    lines += [
        "",
        f"Scaling ({values['subjects'][-1]}, one core; with labels, but fewer views of a pose are "
        "rendered only):",
        "",
        "| axis | value | ms per view | MB |",
        "|---|---:|---:|---:|",
    ]
    return lines + [
        f"| `{axis}` | {row[axis]:g} | {row['cpu_ms_per_view']} | {row['peak_mb']} |"
        for axis, rows in values["axes"].items()
        for row in rows
    ]


def where(values: dict) -> str:
    """The machine."""
    ran = values["environment"]
    return f"On {ran['cores']} cores of {ran['cpu']}, commit {ran['commit']}."


def setting_list(values: dict) -> str:
    """Settings in one line."""
    return ", ".join(f"`{name}` {value:g}" for name, value in values.items())


if __name__ == "__main__":
    main()
