"""Training curves of the avatars as charts."""

import math

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.conventions import DataError
from ntop.report.charts import Line, line_chart
from ntop.report.inputs import ActorFolders

CURVES = {
    "loss": ("Training loss", "loss"),
    "psnr_person_db": ("Training rays on the person", "PSNR (dB)"),
    "watched_psnr_db": ("Watched frames of the training cameras, never trained on", "PSNR (dB)"),
}


def training_charts(actors: list[ActorFolders]) -> tuple[str, ...]:
    """One chart per measured quantity, one line per actor."""
    tables = {actor.name: _curve(actor) for actor in actors}
    charts = []
    for column, (title, label) in CURVES.items():
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
        if lines:
            charts.append(line_chart(lines, title=title, x_label="step", y_label=label))
    return tuple(charts)


def _curve(actor: ActorFolders) -> dict[str, list[float | None]]:
    path = actor.avatar / "curve.parquet"
    try:
        return pq.read_table(path).to_pydict()
    except (OSError, pa.ArrowInvalid) as error:
        raise DataError(f"cannot read {path}: {error}; rerun the training") from error
