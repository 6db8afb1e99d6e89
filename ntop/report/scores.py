"""Scores of cut-outs against references: one record per picture, means, and which to show."""

from dataclasses import astuple, dataclass, fields

import numpy as np

from ntop.metrics.images import (
    Cutout,
    mask_iou,
    psnr_box_db,
    psnr_person_db,
    ssim_box,
    tight_window,
)
from ntop.report.charts import Chart, Line, line_chart
from ntop.report.page import Table


@dataclass(frozen=True)
class ImageScores:
    """One rendered picture against its reference."""

    psnr_person_db: float
    psnr_box_db: float
    ssim_box: float
    mask_iou: float
    baseline_psnr_person_db: float
    baseline_psnr_box_db: float


def score_image(image: Cutout, reference: Cutout, *, baseline: Cutout) -> ImageScores:
    """All image scores, the painted body's included.

    Only the box around both people is looked at, which changes no score: a person is a few percent
    of a fisheye image.
    """
    window = tight_window(image.mask | reference.mask)
    image, reference, baseline = (c.within(window) for c in (image, reference, baseline))
    return ImageScores(
        psnr_person_db=psnr_person_db(image, reference),
        psnr_box_db=psnr_box_db(image, reference),
        ssim_box=ssim_box(image, reference),
        mask_iou=mask_iou(image.mask, reference.mask),
        baseline_psnr_person_db=psnr_person_db(baseline, reference),
        baseline_psnr_box_db=psnr_box_db(baseline, reference),
    )


def mean_scores(scores: list[ImageScores]) -> ImageScores:
    """The mean of every score over the pictures (decibels are averaged, not errors)."""
    return ImageScores(*np.mean([astuple(s) for s in scores], axis=0).tolist())


def best_median_worst(scores: list[ImageScores]) -> dict[str, int]:
    """Which pictures to show, by `psnr_box_db`; fewer than three pictures give fewer names."""
    order = sorted(range(len(scores)), key=lambda index: -scores[index].psnr_box_db)
    shown = {order[len(order) // 2]: "median", order[-1]: "worst", order[0]: "best"}
    return {shown[index]: index for index in order if index in shown}


def score_curves(scores: list[ImageScores], *, what: str) -> dict[str, Chart]:
    """PSNR and mask IoU of all pictures, each sorted from best to worst, by a short name."""
    share = [100 * (index + 0.5) / len(scores) for index in range(len(scores))]

    def falling(name: str, column: str, kind: int) -> Line:
        return Line(name, share, sorted((getattr(s, column) for s in scores), reverse=True), kind)

    psnr = [
        falling("avatar, person's pixels", "psnr_person_db", 0),
        falling("avatar, person's box", "psnr_box_db", 1),
        falling("painted body, person's box", "baseline_psnr_box_db", 2),
    ]
    charts = {
        "PSNR": (psnr, f"{what}: PSNR", "PSNR (dB)"),
        "mask IoU": ([falling("avatar", "mask_iou", 0)], f"{what}: mask overlap", "mask IoU"),
    }
    x_label = "% of pictures, best first"
    drawn = {
        name: line_chart(lines, title=title, x_label=x_label, y_label=y_label)
        for name, (lines, title, y_label) in charts.items()
    }
    return {name: chart for name, chart in drawn.items() if chart is not None}


def score_table(groups: dict[str, list[ImageScores]], *, first: str) -> Table:
    """Mean scores per group and over all pictures."""
    head = (
        first, "pictures", "PSNR person (dB)", "PSNR box (dB)", "SSIM box", "mask IoU",
        "painted body: person (dB)", "painted body: box (dB)",
    )  # fmt: skip
    everything = [score for scores in groups.values() for score in scores]
    rows = [_row(name, scores) for name, scores in groups.items()]
    if len(groups) > 1:
        rows.append(_row("all", everything))
    return Table(head, tuple(rows), total=len(groups) > 1)


def _row(name: str, scores: list[ImageScores]) -> tuple[str, ...]:
    mean = mean_scores(scores)
    digits = {"ssim_box": 3, "mask_iou": 3}
    return (
        name,
        str(len(scores)),
        *(f"{getattr(mean, f.name):.{digits.get(f.name, 2)}f}" for f in fields(mean)),
    )
