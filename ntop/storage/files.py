"""What a finished folder holds: every file with its size and SHA-256, recorded when it was made.

Disks fill up, copies end early, bits flip: nobody notices until somebody reads. A stage checks the
folders it reads against their records, `ntop check` those of a whole run or dataset. A folder
without a record (made by hand) is taken as it is.
"""

import hashlib
from collections.abc import Collection, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.provenance import file_sha256
from ntop.storage.remedies import FILES_NAME, remedy
from ntop.storage.tables import Row, RowWriter, read_table, row_writer, write_table

ROWS_PER_GROUP = 8192


@dataclass(frozen=True)
class Damage:
    """A file that is not what its record says, and how."""

    path: Path
    what: str


def record_files(folder: Path, *, known: Iterable[Row] = ()) -> None:
    """Write the record of all files below `folder`; `known` rows (schema FILE) are not hashed.

    Raises:
        DataError: a file cannot be read, or the record not be written.
    """
    rows = {row["path"]: row for row in known}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in rows and name != FILES_NAME:
            rows[name] = file_row(path, folder=folder)
    ordered = [rows[name] for name in sorted(rows)]
    write_table(ordered, schema=schemas.FILE, path=folder / FILES_NAME)


def file_row(path: Path, *, folder: Path) -> Row:
    """The record of one file below `folder`."""
    return {
        "path": path.relative_to(folder).as_posix(),
        "num_bytes": path.stat().st_size,
        "sha256": file_sha256(path),
    }


def content_row(name: str, content: bytes) -> Row:
    """The record of a file that was just written from `content`."""
    sha256 = hashlib.sha256(content).hexdigest()
    return {"path": name, "num_bytes": len(content), "sha256": sha256}


def read_records(folder: Path) -> dict[str, Row]:
    """A folder's record by path; empty if it has none."""
    path = folder / FILES_NAME
    if not path.exists():
        return {}
    return {row["path"]: row for row in read_table(path, schema=schemas.FILE)}


def find_damage(folder: Path, row: Row, *, content: bool = True) -> Damage | None:
    """What is wrong with a recorded file; without `content` only its size is looked at."""
    path = folder / row["path"]
    try:
        size = path.stat().st_size
        if size != row["num_bytes"]:
            return Damage(path, f"has {size} bytes, {row['num_bytes']} were written")
        if content:
            with path.open("rb") as stream:
                sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            if sha256 != row["sha256"]:
                return Damage(path, "holds other bytes than were written")
    except OSError as error:
        return Damage(path, f"cannot be read: {error.strerror or error}")
    return None


def check_files(*folders: Path, only: Collection[str] | None = None) -> None:
    """Compare folders that are about to be read with their records, each folder once.

    `only`: names of the files to look at; None means all.

    Raises:
        DataError: a file is damaged; the text names it and the way to make it again.
    """
    for folder in dict.fromkeys(folders):
        for row in read_records(folder).values():
            if only is None or row["path"] in only:
                raise_damage(find_damage(folder, row), folder)


def raise_damage(damage: Damage | None, folder: Path) -> None:
    """Stop at a damaged file, if there is one, with the way to make its `folder` again.

    Raises:
        DataError: there is.
    """
    if damage is not None:
        raise DataError(f"{damage.path} {damage.what}; {remedy(folder)}")


def files_writer(folder: Path) -> AbstractContextManager[RowWriter]:
    """A writer of the record of a folder that holds many files; see `row_writer`."""
    return row_writer(folder / FILES_NAME, schema=schemas.FILE, rows_per_group=ROWS_PER_GROUP)
