"""Record a finished demo: its scores, and seconds and memory per stage, as JSON and a plot.

Usage: python benchmarks/record_demo.py [METRICS_JSON], in the folder where `make demo` ran.
"""

import json
import sys
from pathlib import Path

import matplotlib as mpl
from environment import RESULTS, write_result
from matplotlib import pyplot as plt

from ntop.stages import STAGES


def main(metrics: Path) -> None:
    """Write benchmarks/results/demo.json and demo.png."""
    values = json.loads(metrics.read_text())
    values.pop("by_actor", None)
    print(write_result("demo", values))
    plot(values, RESULTS / "demo.png")


def plot(values: dict, path: Path) -> None:
    """Stage seconds (sum over jobs) and peak memory, stage by stage."""
    mpl.use("agg")
    names = [name for _, name, _ in STAGES]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3), dpi=110)
    for axis, key, unit in zip(axes, ("seconds", "peak_memory_gb"), ("s", "GB"), strict=True):
        bars = axis.barh(names, [values[key][name] for name in names], color="#3b6ea5")
        axis.bar_label(bars, fmt="%.2g" if unit == "GB" else "%.0f", padding=2, fontsize=8)
        axis.invert_yaxis()
        axis.set_xlabel(f"{key.replace('_', ' ').removesuffix(' gb')} ({unit})")
        axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    given = sys.argv[1:] or ["results/8_evaluate/demo/metrics.json"]
    main(Path(given[0]))
