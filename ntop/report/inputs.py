"""What the evaluation reads: the dataset's rows, each actor's folders."""

import math
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ntop.config.sources import Given
from ntop.config.tables import Actor, Gender
from ntop.conventions import DataError
from ntop.storage.keys import SetKey
from ntop.storage.manifest import ManifestReader
from ntop.storage.renders import set_key
from ntop.storage.tables import Row

MAX_SETS = 500  # to look at; a picture takes about 10 ms


@dataclass(frozen=True)
class ActorFolders:
    """Where one actor's results lie."""

    source: str
    actor: str
    capture: Path
    mattes: Path
    bodies: Path
    avatar: Path
    gender: Gender = "n"

    @property
    def name(self) -> str:
        """Source and actor, as in all paths."""
        return f"{self.source}/{self.actor}"


@dataclass(frozen=True)
class Dataset:
    """An assembled dataset: its folder and rows of its manifest, in the manifest's order.

    `rows` are all rows of a small dataset; of a large one, those of evenly spread sets.
    """

    folder: Path
    rows: tuple[Row, ...]
    num_images: int
    num_sets: int

    @classmethod
    def read(cls, folder: Path, *, max_sets: int = MAX_SETS) -> "Dataset":
        """Read the manifest, or about `max_sets` sets of it: as many of each actor and rig.

        Raises:
            DataError: no readable manifest, or one without rows.
        """
        manifest = ManifestReader(folder)
        if not manifest.num_rows:
            raise DataError(f"{folder}/manifest.parquet: no rows; rerun the render stage")
        counts = Counter(_stratum(key) for key, _ in manifest.sets())
        numbers = [n for run in _spread(manifest, counts, max_sets=max_sets) for n in run]
        return cls(folder, tuple(manifest.rows(numbers)), manifest.num_rows, counts.total())

    @property
    def name(self) -> str:
        """The dataset's name is its folder's."""
        return self.folder.resolve().name

    def rows_with(self, sample_ids: Collection[str]) -> Iterator[Row]:
        """The rows of the whole manifest that have these ids."""
        manifest = ManifestReader(self.folder)
        return manifest.rows(manifest.numbers_of(sample_ids))

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


def _stratum(key: SetKey) -> tuple[str, str, str]:
    return key.source, key.actor, key.rig


def _spread(
    manifest: ManifestReader, counts: Counter[tuple[str, str, str]], *, max_sets: int
) -> Iterator[range]:
    """Row numbers of the sampled sets: all, or equally many of each stratum, evenly spaced."""
    share = math.ceil(max_sets / len(counts)) if counts.total() > max_sets else counts.total()
    seen: Counter[tuple[str, str, str]] = Counter()
    for key, rows in manifest.sets():
        stratum = _stratum(key)
        count, position = counts[stratum], seen[stratum]
        seen[stratum] += 1
        # exactly min(share, count) positions are steps of this stair
        if count <= share or (position + 1) * share // count > position * share // count:
            yield rows


@dataclass(frozen=True)
class ResultFolders:
    """The stages' result folders, each with `{source}/{actor}` below it."""

    captures: Path
    masks: Path
    fits: Path
    avatars: Path

    def of(self, actor: Actor, *, provides: Collection[Given]) -> ActorFolders:
        """The folders of one actor; what its source provides lies with the capture."""
        key = f"{actor.source}/{actor.actor}"
        return ActorFolders(
            source=actor.source,
            actor=actor.actor,
            capture=self.captures / key,
            mattes=(self.captures if "masks" in provides else self.masks) / key,
            bodies=(self.captures if "bodies" in provides else self.fits) / key,
            avatar=self.avatars / key,
            gender=actor.gender,
        )
