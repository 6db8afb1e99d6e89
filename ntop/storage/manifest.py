"""The manifest: one row per image, written and read in row groups so that memory stays bounded."""

from collections import deque
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from ntop.storage import schemas
from ntop.storage.keys import SetKey
from ntop.storage.renders import set_key
from ntop.storage.tables import Row, RowWriter, completed, open_table, reading, row_writer

ROWS_PER_GROUP = 4096  # a row takes about 10 kB in memory

MANIFEST_NAME = "manifest.parquet"
SET_COLUMNS = ["source", "actor", "action", "rig", "frame"]


def manifest_writer(folder: Path) -> AbstractContextManager[RowWriter]:
    """A writer of `manifest.parquet` in a dataset's folder; see `row_writer`."""
    path = folder / MANIFEST_NAME
    return row_writer(path, schema=schemas.MANIFEST, rows_per_group=ROWS_PER_GROUP)


class ManifestReader:
    """The manifest of a dataset, read piece by piece: nothing grows with the number of images.

    Rows are checked as they are read: each method raises a DataError that names the file and what
    to do where it meets damage.
    """

    def __init__(self, folder: Path) -> None:
        """Open `manifest.parquet` in a dataset's folder.

        Raises:
            DataError: the file is missing, damaged, or has other columns than expected.
        """
        self._path = folder / MANIFEST_NAME
        self._file = open_table(self._path, schema=schemas.MANIFEST)

    @property
    def num_rows(self) -> int:
        """Images of the dataset."""
        return self._file.metadata.num_rows

    def sets(self) -> Iterator[tuple[SetKey, range]]:
        """Each set with the numbers of its rows, in the manifest's order."""
        known, first, number = None, 0, 0
        for batch in self._batches(SET_COLUMNS):
            for row in batch.to_pylist():
                key = set_key(row)
                if key != known:
                    if known is not None:
                        yield known, range(first, number)
                    known, first = key, number
                number += 1
        if known is not None:
            yield known, range(first, number)

    def numbers_of(self, sample_ids: Collection[str]) -> list[int]:
        """The numbers of the rows with these sample ids, ascending."""
        wanted, found, first = pa.array(list(sample_ids), pa.string()), [], 0
        for batch in self._batches(["sample_id"]):
            inside = pc.is_in(batch.column(0), wanted)
            found += (first + position for position in pc.indices_nonzero(inside).to_pylist())
            first += batch.num_rows
        return found

    def rows(self, numbers: list[int]) -> Iterator[Row]:
        """The rows with these ascending numbers."""
        first, left = 0, deque(numbers)
        for group in range(self._file.num_row_groups):
            end = first + self._file.metadata.row_group(group).num_rows
            inside = []
            while left and left[0] < end:
                inside.append(left.popleft() - first)
            if inside:
                with reading(self._path):
                    table = self._file.read_row_group(group).take(inside)
                yield from completed(table, schemas.MANIFEST).to_pylist()
            first = end

    def _batches(self, columns: list[str]) -> Iterator[pa.RecordBatch]:
        with reading(self._path):
            yield from self._file.iter_batches(ROWS_PER_GROUP, columns=columns)
