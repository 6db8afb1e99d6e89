"""The manifest: one row per image, written in row groups so that memory stays bounded."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.storage import schemas
from ntop.storage.tables import Row

ROWS_PER_GROUP = 4096  # a row takes about 10 kB in memory

MANIFEST_NAME = "manifest.parquet"


class ManifestWriter:
    """Takes manifest rows in their final order; see `manifest_writer`."""

    def __init__(self, writer: pq.ParquetWriter) -> None:
        """Write through an open Parquet writer."""
        self._writer = writer
        self._rows: list[Row] = []

    def add(self, row: Row) -> None:
        """Append one row."""
        self._rows.append(row)
        if len(self._rows) == ROWS_PER_GROUP:
            self.flush()

    def flush(self) -> None:
        """Write what is buffered as one row group."""
        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, schema=schemas.MANIFEST))
            self._rows = []


@contextmanager
def manifest_writer(folder: Path) -> Iterator[ManifestWriter]:
    """A writer of `manifest.parquet` in a dataset's folder; the file is whole when the block ends.

    Not atomic: a dataset is built in a work folder and published as a whole.
    """
    with pq.ParquetWriter(
        folder / MANIFEST_NAME, schemas.MANIFEST, compression="zstd", write_page_checksum=True
    ) as writer:
        rows = ManifestWriter(writer)
        yield rows
        rows.flush()
