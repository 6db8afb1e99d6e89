"""Points of the field's benchmark: what was measured, who wins where, and the plot."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt

from benchmarks.studio import Scores
from ntop.field.humannerf.avatar import CONVERGED_STEPS

HIGHER_IS_BETTER = {
    "psnr_box_db": True, "ssim_box": True, "lpips_vgg": False, "mask_iou": True,
    "depth_error_mm": False,
}  # fmt: skip
AXES = {
    "psnr_box_db": "PSNR, box (dB)", "ssim_box": "SSIM, box", "lpips_vgg": "LPIPS (VGG), box",
    "mask_iou": "mask IoU", "depth_error_mm": "depth error (mm)",
}  # fmt: skip

STYLES = {  # name and colour of each field
    "grid": ("grid + light", "#3b6ea5"), "grid_even": ("grid, even light", "#8a8f98"),
    "grid_head": ("grid + light + head", "#4a9a5b"), "humannerf": ("HumanNeRF twin", "#c2572b"),
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """One avatar: how long it was trained, and its scores."""

    field: str
    budget_s: float
    seconds: float
    iterations: int
    converged: bool
    loss: str
    render_s_per_view: float
    scores: Scores


def twin_wins(points: list[Point]) -> list[dict[str, Any]]:
    """Where the twin is better than a grid that was trained for no longer."""
    wins = []
    for twin in (point for point in points if point.field == "humannerf"):
        for grid in (p for p in points if p.field == "grid" and p.seconds <= twin.seconds):
            for metric, higher in HIGHER_IS_BETTER.items():
                ours, theirs = (getattr(p.scores, metric) for p in (grid, twin))
                if None not in (ours, theirs) and (theirs > ours) == higher and theirs != ours:
                    wins.append(
                        {"metric": metric, "grid_s": grid.seconds, "twin_s": twin.seconds,
                         "grid": ours, "twin": theirs}
                    )  # fmt: skip
    return wins


def plot(points: list[Point], path: Path) -> None:
    """Each score over training seconds; hollow marks are unconverged."""
    mpl.use("agg")
    figure, axes = plt.subplots(1, len(AXES), figsize=(15, 3.2), dpi=110)
    for axis, (metric, label) in zip(axes, AXES.items(), strict=True):
        for field, (name, colour) in STYLES.items():
            line = [p for p in points if p.field == field and getattr(p.scores, metric) is not None]
            x, y = [p.seconds for p in line], [getattr(p.scores, metric) for p in line]
            axis.plot(x, y, color=colour, label=name)
            for point, value in zip(line, y, strict=True):
                face = colour if point.converged else "white"
                axis.plot(point.seconds, value, "o", color=colour, markerfacecolor=face)
                if field == "humannerf":
                    note = "" if point.converged else ", unconverged"
                    place = (point.seconds, value)
                    axis.annotate(f"{point.iterations:,} steps{note}", place, fontsize=6)
        axis.set_xscale("log")
        axis.set_xlabel("training (s)")
        axis.set_title(label, fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize=8, frameon=False)
    figure.suptitle(
        f"Views from above in novel poses; hollow: fewer than {CONVERGED_STEPS:,} iterations",
        fontsize=9,
    )
    figure.tight_layout()
    figure.savefig(path)
