"""The error budget's pictures: what each substitution gained, and what the eye sees of it."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

from ntop.metrics.images import Cutout, tight_window

COLOURS = {"psnr_box_db": "#3b6ea5", "psnr_core_db": "#c2572b"}
LABELS = {"psnr_box_db": "box", "psnr_core_db": "core (3 px within the outline)"}
ERROR_GAIN = 4.0  # of the maps


def plot(values: dict[str, Any], path: Path) -> None:
    """PSNR of every case, in the box and in the core."""
    mpl.use("agg")
    cases = values["cases"]
    figure, axis = plt.subplots(figsize=(8, 0.5 + 0.42 * len(cases)), dpi=110)
    places = np.arange(len(cases))
    for shift, (score, colour) in zip((-0.2, 0.2), COLOURS.items(), strict=True):
        heights = [case["scores"][score] for case in cases]
        axis.barh(places + shift, heights, 0.38, color=colour, label=LABELS[score])
        for place, case, height in zip(places, cases, heights, strict=True):
            gain = "" if not case["gain_db"] else f" ({case['gain_db'][score]:+.1f})"
            axis.text(height + 0.1, place + shift, f"{height:.1f}{gain}", va="center", fontsize=7)
    axis.set_yticks(
        places,
        [case["name"] + (f" [{case['part']}]" if case["part"] else "") for case in cases],
        fontsize=8,
    )
    axis.invert_yaxis()
    axis.set_xlim(18, max(case["scores"]["psnr_core_db"] for case in cases) + 6)
    axis.set_xlabel("PSNR from above in novel poses (dB); in brackets: gained")
    axis.legend(fontsize=8, frameon=False, loc="lower right")
    axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def strip(pictures: dict[str, tuple[Cutout, Cutout]], path: Path) -> None:
    """The first view of some cases: truth, picture and error."""
    mpl.use("agg")
    figure, rows = plt.subplots(3, len(pictures), figsize=(2.2 * len(pictures), 7), dpi=110)
    for column, (name, (image, truth)) in enumerate(pictures.items()):
        window = tight_window(truth.mask)
        pair = [window.of(cutout.on_grey()) for cutout in (truth, image)]
        shown = [*pair, np.clip(0.5 + ERROR_GAIN * (pair[1] - pair[0]), 0, 1)]
        for axis, picture in zip(rows[:, column], shown, strict=True):
            axis.imshow(np.clip(picture, 0, 1), interpolation="nearest")
            axis.axis("off")
        rows[0, column].set_title(name, fontsize=9)
    figure.suptitle(f"Truth, picture, {ERROR_GAIN:g} x error about grey", fontsize=9)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
