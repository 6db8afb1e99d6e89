"""The robustness benchmark's picture: a row per score, a column per axis."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt

SCORES = {
    "psnr_box_db": "PSNR, box (dB)", "mask_iou": "mask IoU", "depth_error_mm": "depth error (mm)",
}  # fmt: skip
COLOUR = "#3b6ea5"


def plot(values: dict[str, Any], path: Path) -> None:
    """Each score over each axis; hollow: the pinned capture."""
    mpl.use("agg")
    shape = (len(SCORES), len(values["axes"]))
    figure, rows = plt.subplots(*shape, figsize=(14, 6.5), dpi=110, sharey="row", squeeze=False)
    for column, (name, label) in enumerate(values["axes"].items()):
        points = [point for point in values["points"] if point["axis"] == name]
        points = sorted(points, key=lambda point: point["value"])
        for axis, (score, words) in zip(rows[:, column], SCORES.items(), strict=True):
            known = [p for p in points if p["scores"][score] is not None]
            places = [p["value"] for p in known]
            heights = [p["scores"][score] for p in known]
            axis.plot(places, heights, color=COLOUR)
            for point, height in zip(known, heights, strict=True):
                face = "white" if point["pinned"] else COLOUR
                axis.plot(point["value"], height, "o", color=COLOUR, markerfacecolor=face)
            if name in ("cameras", "frames"):
                axis.set_xscale("log", base=2 if name == "cameras" else 10)
                axis.set_xticks(places, [f"{place:g}" for place in places])
                axis.minorticks_off()
            if column == 0:
                axis.set_ylabel(words)
            axis.spines[["top", "right"]].set_visible(False)
            axis.grid(alpha=0.25)
        rows[-1, column].set_xlabel(label)
    figure.suptitle(
        f"From above in novel poses after {values['steps']} steps; hollow: the pinned capture",
        fontsize=9,
    )
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
