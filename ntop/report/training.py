"""Training curves of the avatars as charts, and how far trainings went that may be cut short."""

import json
import math
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.conventions import DataError
from ntop.field.humannerf.avatar import CONVERGED_STEPS
from ntop.report.charts import Chart, Line, line_chart
from ntop.report.inputs import ActorFolders
from ntop.storage.remedies import remedy


@dataclass(frozen=True)
class Curve:
    """A column of the training's record: title of its chart, its axis, and a short name."""

    title: str
    label: str
    short: str


CURVES = {
    "loss": Curve("Training loss", "loss", "loss"),
    "psnr_person_db": Curve("Training rays on the person", "PSNR (dB)", "training rays"),
    "watched_psnr_db": Curve(
        "Watched frames of the training cameras, never trained on", "PSNR (dB)", "watched frames"
    ),
}


def training_charts(actors: list[ActorFolders]) -> dict[str, Chart]:
    """One chart per measured column, one line per actor."""
    tables = {actor.name + _suffix(actor): _curve(actor) for actor in actors}
    charts = {}
    for column, curve in CURVES.items():
        lines = []
        for kind, (name, columns) in enumerate(tables.items()):
            points = [
                (step, value)
                for step, value in zip(columns["step"], columns.get(column, []), strict=False)
                if value is not None and math.isfinite(value)
            ]
            if points:
                x, y = ([float(v) for v in axis] for axis in zip(*points, strict=True))
                lines.append(Line(name, x, y, kind % 4))
        title = f"{curve.title}: {lines[0].name}" if len(actors) == 1 and lines else curve.title
        chart = line_chart(lines, title=title, x_label="step", y_label=curve.label)
        if chart is not None:
            charts[column] = chart
    return charts


def training_values(actor: ActorFolders) -> dict[str, float | None]:
    """Figures of a training that may be unconverged; none of one that ends by its own schedule."""
    record = avatar_header(actor).get("training")
    if record is None:
        return {}
    return {
        "avatar.iterations": record["iterations"],
        "avatar.iterations_planned": record["planned"],
        "avatar.converged": float(record["converged"]),
    }


def training_note(actor: ActorFolders) -> str:
    """The same in words, empty where there is nothing to say."""
    header = avatar_header(actor)
    record = header.get("training")
    if record is None:
        return ""
    note = f"{header['field']}, {record['iterations']:,} of {record['planned']:,} iterations"
    if not record["converged"]:
        note += f", unconverged (fewer than {CONVERGED_STEPS:,})"
    return f"{note}, loss {record['loss']}"


def avatar_header(actor: ActorFolders) -> dict[str, Any]:
    """What the avatar says of itself.

    Raises:
        DataError: its header cannot be read.
    """
    path = actor.avatar / "avatar.json"
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path}: {error!r}; {remedy(path)}") from error


def _suffix(actor: ActorFolders) -> str:
    record = avatar_header(actor).get("training")
    return "" if record is None or record["converged"] else " (unconverged)"


def _curve(actor: ActorFolders) -> dict[str, list[float | None]]:
    path = actor.avatar / "curve.parquet"
    try:
        return pq.read_table(path).to_pydict()
    except (OSError, pa.ArrowInvalid) as error:
        raise DataError(f"cannot read {path}: {error}; {remedy(path)}") from error
