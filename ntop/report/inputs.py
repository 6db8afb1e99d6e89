"""What the evaluation reads: the dataset's rows, each actor's folders."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.keys import SetKey
from ntop.storage.renders import set_key
from ntop.storage.tables import Row, read_table


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
