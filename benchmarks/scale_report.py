"""The figures of the scale benchmark as JSON, as a plot and as the table in docs/scaling.md."""

import json
import math
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt

from benchmarks.environment import RESULTS, ROOT, write_result

PAGE = ROOT / "docs/scaling.md"
BEGIN, END = "<!-- measured: python -m benchmarks.scale record -->", "<!-- end -->"
PHASES = {
    "plan": "`ntop plan`",
    "parse": "parse",
    "dry_run": "dry-run",
    "execute": "render + annotate",
    "assemble": "assemble",
    "check": "`ntop check`",
    "evaluate": "evaluate",
    "no_op": "no-op rerun",
}
SERIES = ("1k", "10k", "100k", "570k")  # of which exponents are taken
OTHERS = {"short": " in short shards"}
Campaigns = list[dict]


def record(folder: Path) -> None:
    """Write benchmarks/results/scale.json and scale.png, and the table into the page."""
    campaigns = read(folder)
    print(write_result("scale", {"campaigns": campaigns, "exponents": exponents(campaigns)}))
    plot(campaigns, RESULTS / "scale.png")
    text = PAGE.read_text()
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{table(campaigns)}\n{END}{after}")


def read(folder: Path) -> Campaigns:
    """What was measured so far, smallest campaign first, files before tars."""
    found = []
    for path in folder.glob("*/phases.json"):
        size, storage = path.parent.name.split("_")
        found.append({"size": size, "storage": storage} | json.loads(path.read_text()))
    return sorted(found, key=lambda item: (item["images"], item["storage"]))


def exponents(campaigns: Campaigns) -> dict[str, dict[str, float]]:
    """Slope of log(figure) over log(images) per phase; 0 is independent, 1 is proportional."""
    found: dict[str, dict[str, float]] = {}
    for phase in PHASES:
        for key in ("cpu_s", "peak_mb"):
            points = [
                (c["images"], c[phase][key])
                for c in campaigns
                if in_series(c) and key in c.get(phase, {})
            ]
            if len(points) > 1:
                found.setdefault(phase, {})[key] = round(slope(points), 2)
    return found


def in_series(campaign: dict) -> bool:
    """Whether it differs from the others by its number of images only."""
    return campaign["storage"] == "tar" and campaign["size"] in SERIES


def slope(points: list[tuple[float, float]]) -> float:
    """Least squares in both logarithms."""
    xs, ys = ([math.log(max(value, 1e-3)) for value in axis] for axis in zip(*points, strict=True))
    x0, y0 = sum(xs) / len(xs), sum(ys) / len(ys)
    down = sum((x - x0) ** 2 for x in xs)
    return sum((x - x0) * (y - y0) for x, y in zip(xs, ys, strict=True)) / down


def table(campaigns: Campaigns) -> str:
    """One line per phase, one column per campaign; then the files."""
    names = [f"{c['images']:,} {c['storage']}{OTHERS.get(c['size'], '')}" for c in campaigns]
    lines = [
        "Processor seconds (wall seconds) · peak MB, all processes of the command together:",
        "",
        "| phase | " + " | ".join(names) + " | exponents of s, MB |",
        "|:--|" + "--:|" * len(names) + ":-:|",
    ]
    slopes = exponents(campaigns)
    for phase, title in PHASES.items():
        cells = [cell(c.get(phase)) for c in campaigns]
        found = slopes.get(phase, {})
        slope_cell = ", ".join(f"{found[key]:.2f}" for key in ("cpu_s", "peak_mb") if key in found)
        lines.append(f"| {title} | " + " | ".join(cells) + f" | {slope_cell or '–'} |")
    for store, title in (
        ("5_render", "renders"), ("6_annotate", "annotations"), ("7_assemble", "dataset"),
    ):  # fmt: skip
        cells = [
            f"{c['disk'][store]['inodes']:,} · {c['disk'][store]['bytes'] / 1e6:,.0f}"
            if "disk" in c
            else "–"
            for c in campaigns
        ]
        lines.append(f"| {title}: inodes · MB | " + " | ".join(cells) + " | |")
    return "\n".join(lines)


def cell(cost: dict | None) -> str:
    """One measurement."""
    if not cost:
        return "–"
    text = f"{cost['cpu_s']:,.1f} ({cost['wall_s']:,.0f})"
    return text + (f" · {cost['peak_mb']:,.0f}" if "peak_mb" in cost else "")


def plot(campaigns: Campaigns, path: Path) -> None:
    """Processor time and memory over images, tar storage, both axes logarithmic."""
    mpl.use("agg")
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), dpi=110, sharex=True)
    slopes = exponents(campaigns)
    for axis, key, unit in zip(axes, ("cpu_s", "peak_mb"), ("processor s", "peak MB"), strict=True):
        for index, (phase, title) in enumerate(PHASES.items()):
            points = [
                (c["images"], c[phase][key])
                for c in campaigns
                if in_series(c) and key in c.get(phase, {})
            ]
            if points:
                power = slopes.get(phase, {}).get(key)
                label = title.strip("`") + (f"  ∝ N^{power:.2f}" if power is not None else "")
                axis.loglog(*zip(*points, strict=True), marker="o", color=f"C{index}", label=label)
        axis.set_xlabel("images")
        axis.set_ylabel(unit)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
