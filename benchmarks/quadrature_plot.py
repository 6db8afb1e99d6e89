"""The picture of benchmarks/quadrature.py, its Pareto front and the knee of it."""

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

from benchmarks.quadrature_errors import MAX_P999, MAX_RMS

# what rounding to eight bits does, grey levels: its rms, and no error is larger than half a level
ROUNDING = {"rms": 1 / math.sqrt(12), "p999": 0.5}
BARS = {"rms": MAX_RMS, "p999": MAX_P999}
LABELS = {"rms": "rms error (of 255)", "p999": "p99.9 error (of 255)"}


def front(points: list[dict], error: str) -> list[int]:
    """Points that no other beats in both time and error, from cheap to dear."""
    cost = np.array([[point["time_ratio"], point[error]] for point in points])
    kept = [
        n for n, one in enumerate(cost) if not ((cost <= one).all(1) & (cost < one).any(1)).any()
    ]
    return sorted(kept, key=lambda n: cost[n, 0])


def knee(points: list[dict], error: str) -> int:
    """The front's point farthest from the chord between its ends, both logarithmic.

    Errors below what eight bits can show count as that, or the knee would chase the invisible.
    """
    chosen = front(points, error)
    floor = ROUNDING[error]
    place = np.log([[points[n]["time_ratio"], max(points[n][error], floor)] for n in chosen])
    along = place[-1] - place[0]
    away = place - place[0]
    distance = np.abs(along[0] * away[:, 1] - along[1] * away[:, 0])
    return chosen[int(distance.argmax())]


def plot(points: list[dict], *, fp32_floor: dict[str, float], path: Path) -> None:
    """Error against time, log-log: rms and p99.9; dominated points grey; bars and floors."""
    mpl.use("agg")
    figure, panels = plt.subplots(1, 2, figsize=(13, 4.8), dpi=110)
    for axes, error in zip(panels, LABELS, strict=True):
        best, bend = front(points, error), knee(points, error)
        axes.loglog(
            [points[n]["time_ratio"] for n in best], [points[n][error] for n in best],
            "-", color="#3b6ea5", lw=0.8,
        )  # fmt: skip
        for n, point in enumerate(points):
            t, e = point["time_ratio"], point[error]
            axes.plot(t, e, "o", ms=4, color="#3b6ea5" if n in best else "#bbbbbb")
            if n in best or point["knob"].startswith(("preset", "rule")):
                axes.annotate(
                    point["name"], (t, e), fontsize=5, xytext=(3, 2), textcoords="offset points"
                )
        axes.plot(
            points[bend]["time_ratio"], points[bend][error], "o", ms=10, mfc="none", color="#c2572b"
        )
        for height, text, colour in (
            (BARS[error], "bar", "#b03a2e"),
            (ROUNDING[error], "8-bit rounding", "#555555"),
            (fp32_floor[error], "float32", "#555555"),
        ):
            axes.axhline(height, color=colour, lw=0.8, ls="-" if text == "bar" else ":")
            axes.text(axes.get_xlim()[0], height, f" {text}", fontsize=6, va="bottom")
        axes.set_xlabel("processor time / default")
        axes.set_ylabel(LABELS[error])
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle("blue: not dominated; ring: knee of the front", fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
