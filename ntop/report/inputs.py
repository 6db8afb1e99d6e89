"""What the evaluation reads: the dataset's rows, each actor's folders, the jobs' costs."""

import csv
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ntop.config.sections import STAGE_SECTIONS
from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.keys import SetKey
from ntop.storage.renders import set_key
from ntop.storage.tables import Row, read_table

MB_PER_GB = 1024.0  # Snakemake reports mebibytes


@dataclass(frozen=True)
class ActorFolders:
    """Where one actor's results lie."""

    source: str
    actor: str
    capture: Path
    mattes: Path
    bodies: Path
    avatar: Path

    @property
    def name(self) -> str:
        """Source and actor, as in all paths."""
        return f"{self.source}/{self.actor}"


@dataclass(frozen=True)
class Dataset:
    """An assembled dataset: its folder and the manifest's rows, in the manifest's order."""

    folder: Path
    rows: tuple[Row, ...]

    @classmethod
    def read(cls, folder: Path) -> "Dataset":
        """Read the manifest.

        Raises:
            DataError: no readable manifest, or one without rows.
        """
        rows = read_table(folder / "manifest.parquet", schema=schemas.MANIFEST)
        if not rows:
            raise DataError(f"{folder}/manifest.parquet: no rows; rerun the render stage")
        return cls(folder, tuple(rows))

    @property
    def name(self) -> str:
        """The dataset's name is its folder's."""
        return self.folder.resolve().name

    def of(self, actor: ActorFolders) -> list[Row]:
        """The rows of one actor."""
        return [r for r in self.rows if (r["source"], r["actor"]) == (actor.source, actor.actor)]

    @cached_property
    def sets(self) -> dict[SetKey, dict[str, Row]]:
        """Rows by set and view."""
        sets: dict[SetKey, dict[str, Row]] = {}
        for row in self.rows:
            sets.setdefault(set_key(row), {})[row["view"]] = row
        return sets

    def image_path(self, row: Row, column: str = "image_path") -> Path:
        """A file of a row."""
        return self.folder / row[column]


def actor_folders(
    captures: list[Path], *, mattes: list[Path], bodies: list[Path], avatars: list[Path]
) -> list[ActorFolders]:
    """The folders of every actor; all lists name the actors in the same order.

    A folder ends in `{source}/{actor}`.

    Raises:
        DataError: the lists differ in length or name different actors.
    """
    given = {"mattes": mattes, "bodies": bodies, "avatars": avatars}
    for name, folders in given.items():
        keys = [folder.parts[-2:] for folder in folders]
        expected = [folder.parts[-2:] for folder in captures]
        if keys != expected:
            raise DataError(
                f"evaluate: {name} belong to {['/'.join(k) for k in keys]}, captures to "
                f"{['/'.join(k) for k in expected]}; give one folder per actor, in one order"
            )
    return [
        ActorFolders(*paths[0].parts[-2:], *paths)
        for paths in zip(captures, mattes, bodies, avatars, strict=True)
    ]


def stage_costs(benchmarks: Path) -> dict[str, float | None]:
    """`seconds.{stage}` (sum over jobs) and `peak_memory_gb.{stage}` (largest job).

    Reads Snakemake's benchmark tables below `{number}_{stage}/`. A stage without one has no figure;
    a job too short to be sampled has no memory, but counts with its time.
    """
    costs: dict[str, float | None] = {}
    for number, name in enumerate(STAGE_SECTIONS, start=1):
        seconds, memory_mb = [], []
        for path in sorted((benchmarks / f"{number}_{name}").rglob("*.tsv")):
            with path.open(newline="") as stream:
                for row in csv.DictReader(stream, delimiter="\t"):
                    seconds.append(_number(row.get("s")))
                    memory_mb.append(_number(row.get("max_rss")))
        times = [s for s in seconds if math.isfinite(s)]
        peaks = [m for m in memory_mb if math.isfinite(m)]
        costs[f"seconds.{name}"] = round(sum(times), 3) if times else None
        costs[f"peak_memory_gb.{name}"] = round(max(peaks) / MB_PER_GB, 4) if peaks else None
    return costs


def _number(text: str | None) -> float:
    """A benchmark's cell; `-` and `NA` mean that the job was too short to be sampled."""
    try:
        return float(text) if text is not None else math.nan
    except ValueError:
        return math.nan
