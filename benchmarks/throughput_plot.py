"""The picture of benchmarks/throughput.py."""

import matplotlib as mpl
from matplotlib import pyplot as plt

from benchmarks.environment import RESULTS

LABELS = {
    "size_px": "image side (px)",
    "height_m": "camera above the pelvis (m)",
    "views": "views per pose",
    "sets": "poses per job",
}
BLUE = "#3b6ea5"


def plot(values: dict) -> None:
    """Processor time per view over each axis, and views per second over cores."""
    mpl.use("agg")
    figure, axes = plt.subplots(1, len(LABELS) + 1, figsize=(15, 3.2), dpi=110)
    for axis, (name, label) in zip(axes, LABELS.items(), strict=False):
        rows = values["axes"][name]
        axis.plot(
            [row[name] for row in rows], [row["cpu_ms_per_view"] for row in rows], "o-", color=BLUE
        )
        axis.set_xscale("log", base=2)
        axis.set_xticks([row[name] for row in rows], [f"{row[name]:g}" for row in rows])
        axis.set_xlabel(label)
        axis.set_ylim(0, 1.1 * max(row["cpu_ms_per_view"] for row in rows))
    axes[0].set_ylabel("ms of a core per view")
    for quality, mark in (("default", "o-"), ("draft", "o--")):
        rows = [
            row
            for row in values["cores"]
            if (row["work"], row["quality"], row["threads"]) == ("labels", quality, 1)
        ]
        cores = [row["processes"] for row in rows]
        axes[-1].plot(cores, [row["views_per_s"] for row in rows], mark, color=BLUE, label=quality)
    axes[-1].legend(fontsize=7, frameon=False)
    axes[-1].set_xlabel("cores, a job on each")
    axes[-1].set_ylabel("views/s, with files and labels")
    axes[-1].set_xticks([1, 2])
    axes[-1].set_ylim(bottom=0)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(RESULTS / "throughput.png")
