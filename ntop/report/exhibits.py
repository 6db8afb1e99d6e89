"""Pictures, curves and tables of the report as files of their own, for `snakemake --report`.

A file is named `{topic}-{words}.{kind}`, its words joined by `-`, which no name of ours contains.
The rule evaluate marks them all with one pattern and makes categories and labels of the words;
names are unique, because Snakemake's zip keeps all files of one output in one folder.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ntop.conventions import DataError
from ntop.report.charts import Chart
from ntop.report.contents import contents_charts, read_contents
from ntop.report.gallery import INSIDE_GREY, cut_views, representative_sets
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Table, table_document
from ntop.report.pictures import drawn_skeleton, on_colour
from ntop.report.scores import ImageScores, score_curves
from ntop.report.training import CURVES, training_charts
from ntop.storage.atomic import write_bytes
from ntop.storage.keys import SetKey

SHEET_SIDE_PX = 1500  # Snakemake's report crops pictures above 1600
GAP_PX, CAPTION_PX = 6, 34
JPEG_QUALITY = 90
INK, PAPER = (29, 31, 35), (250, 249, 246)


@dataclass(frozen=True)
class Exhibit:
    """A file of the report: topic, words for its labels, kind and content."""

    topic: str
    words: tuple[str, ...]
    kind: str  # jpg, svg or html
    content: bytes

    @property
    def file(self) -> str:
        """Its file name."""
        words = (word.replace(" ", "_") for word in (self.topic, *self.words))
        return f"{'-'.join(words)}.{self.kind}"


def write_exhibits(exhibits: list[Exhibit], folder: Path) -> None:
    """Write them all into one folder.

    Raises:
        DataError: two have one name, or the folder cannot be written.
    """
    names = [exhibit.file for exhibit in exhibits]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DataError(f"{folder}: several exhibits are named {twice}; rename actors or rigs")
    for exhibit in exhibits:
        write_bytes(folder / exhibit.file, exhibit.content)


def chart_exhibit(topic: str, *words: str, chart: Chart) -> Exhibit:
    """A chart as an SVG file."""
    return Exhibit(topic, words, "svg", chart.document.encode())


def table_exhibit(topic: str, *words: str, table: Table) -> Exhibit:
    """A table as an HTML file."""
    return Exhibit(topic, words, "html", table_document(table).encode())


def dataset_exhibits(
    dataset: Dataset, *, statistics: Table, left_out: Table, costs: Table | None
) -> list[Exhibit]:
    """What the dataset holds, what was left out, and what it took."""
    charts = contents_charts(read_contents(dataset.folder / "manifest.parquet"))
    found = [chart_exhibit("contents", name, chart=chart) for name, chart in charts.items()]
    found.append(table_exhibit("contents", "statistics", table=statistics))
    found.append(table_exhibit("run", "left out", table=left_out))
    if costs is not None:
        found.append(table_exhibit("run", "costs", table=costs))
    return found


def score_exhibits(
    actor: ActorFolders, scores: list[ImageScores], *, against: str
) -> list[Exhibit]:
    """One actor's curves against the held-out camera or the truth."""
    curves = score_curves(scores, what=f"{actor.name} against {against}")
    return [
        chart_exhibit("scores", actor.source, actor.actor, f"{name} against {against}", chart=chart)
        for name, chart in curves.items()
    ]


def actor_exhibits(dataset: Dataset, actor: ActorFolders) -> list[Exhibit]:
    """One actor's contact sheet per rig, and training curves."""
    found = []
    for rig, key in representative_sets(dataset, actor).items():
        sheet = contact_image(dataset, key)
        ordered = cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)
        done, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise DataError(f"cannot encode an image of {sheet.shape} as JPEG; check OpenCV")
        words = (actor.source, actor.actor, rig)
        found.append(Exhibit("views", words, "jpg", data.tobytes()))
    for column, chart in training_charts([actor]).items():
        words = (actor.source, actor.actor, CURVES[column].short)
        found.append(chart_exhibit("training", *words, chart=chart))
    return found


def contact_image(dataset: Dataset, key: SetKey) -> UInt8[np.ndarray, "side side 3"]:
    """The nine views of a set as one picture in compass order, north up, keypoints drawn in."""
    tile = (SHEET_SIDE_PX - 4 * GAP_PX) // 3
    views = cut_views(dataset, key)
    lines = -(-len(views) // 3)
    height = GAP_PX + lines * (tile + CAPTION_PX)
    sheet = np.full((height, SHEET_SIDE_PX, 3), PAPER, np.uint8)
    for index, view in enumerate(views):
        flat = on_colour(view.image, INSIDE_GREY)
        drawn = cv2.resize(flat, (tile, tile), interpolation=cv2.INTER_AREA)
        drawn = drawn_skeleton(drawn, view.skeletons[0].scaled(tile / flat.shape[0]))
        top = GAP_PX + index // 3 * (tile + CAPTION_PX)
        left = GAP_PX + index % 3 * (tile + GAP_PX)
        sheet[top : top + tile, left : left + tile] = drawn
        width, tall = view.size_px
        words = f"{view.direction}: {width:.0f} x {tall:.0f} px, {view.num_seen} of 17 visible"
        place = (left + 2, top + tile + 22)
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(sheet, words, place, font, 0.55, INK, 1, cv2.LINE_AA)
    return sheet
