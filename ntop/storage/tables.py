"""Parquet tables: explicit schema, sorted rows, checked on reading."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.atomic import atomic_path
from ntop.storage.remedies import remedy

Row = dict[str, Any]


def write_table(rows: list[Row], *, schema: pa.Schema, path: Path) -> None:
    """Write rows, sorted by the schema's leading key columns, as one Parquet file.

    Raises:
        DataError: a row misses a column, has an unknown one, or a value of the wrong type.
    """
    names = set(schema.names)
    for index, row in enumerate(rows):
        if set(row) != names:
            missing, unknown = sorted(names - set(row)), sorted(set(row) - names)
            raise DataError(f"{path} row {index}: missing columns {missing}, unknown {unknown}")
    keys = [n for n in ("source", "actor", "action", "rig", "frame", "view") if n in names]
    ordered = sorted(rows, key=lambda row: tuple(row[key] for key in keys))
    try:
        table = pa.Table.from_pylist(ordered, schema=schema)
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise DataError(f"{path}: a value does not fit its column: {error}") from error
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what Arrow says of a damaged file into an error with its name and what to do.

    A table that is opened shows its columns only: damaged rows are met when they are read.

    Raises:
        DataError: the block could not read the table.
    """
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"cannot read table {path}: {error}; {remedy(path)}") from error


def read_table(path: Path, *, schema: pa.Schema) -> list[Row]:
    """Rows of a table, after a check of its schema.

    Raises:
        DataError: the file is missing, truncated, or has other columns than expected.
    """
    return load_table(path, schema=schema).to_pylist()


def load_table(path: Path, *, schema: pa.Schema) -> pa.Table:
    """A table as Arrow's columns, after a check of its schema.

    Raises:
        DataError: the file is missing, truncated, or has other columns than expected.
    """
    with reading(path):
        table = pq.read_table(path, page_checksum_verification=True)
    table = completed(table, schema)
    if table.schema.names != schema.names:
        raise DataError(
            f"{path}: columns {table.schema.names}, expected {schema.names}; "
            f"it was written by another version: {remedy(path)}"
        )
    return table.cast(schema)


def open_table(path: Path, *, schema: pa.Schema) -> pq.ParquetFile:
    """A table to be read piece by piece, after a check of its columns; see `completed`.

    Raises:
        DataError: the file is missing or truncated, or has other columns than expected.
    """
    with reading(path):
        file = pq.ParquetFile(path, page_checksum_verification=True)
    found = file.schema_arrow
    if completed(found.empty_table(), schema).schema.names != schema.names:
        raise DataError(
            f"{path}: columns {found.names}, expected {schema.names}; it was written by another "
            f"version: {remedy(path)}"
        )
    return file


def read_columns(path: Path, names: Sequence[str], *, schema: pa.Schema) -> Iterator[Row]:
    """Rows with a few of a table's columns, of which the file may lack those that came later.

    Memory does not grow with the table.

    Raises:
        DataError: the file is missing, damaged, or has other columns than expected.
    """
    with open_table(path, schema=schema) as file, reading(path):
        stored = [name for name in names if name in file.schema_arrow.names]
        for batch in file.iter_batches(columns=stored):
            yield from batch.to_pylist()


class RowWriter:
    """Takes rows in their final order and writes them in groups; see `row_writer`."""

    def __init__(self, writer: pq.ParquetWriter, *, rows_per_group: int) -> None:
        """Write through an open Parquet writer."""
        self._writer, self._rows_per_group = writer, rows_per_group
        self._rows: list[Row] = []

    def add(self, rows: Iterable[Row]) -> None:
        """Append rows."""
        self._rows.extend(rows)
        if len(self._rows) >= self._rows_per_group:
            self.flush()

    def flush(self) -> None:
        """Write what is buffered as one row group."""
        if self._rows:
            self._writer.write_table(pa.Table.from_pylist(self._rows, schema=self._writer.schema))
            self._rows = []


@contextmanager
def row_writer(path: Path, *, schema: pa.Schema, rows_per_group: int) -> Iterator[RowWriter]:
    """A writer of a table too large to be held in memory; the file is whole when the block ends.

    Not atomic: a dataset is built in a work folder and published as a whole.
    """
    with pq.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
        rows = RowWriter(writer, rows_per_group=rows_per_group)
        yield rows
        rows.flush()


def completed(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The table with the columns that its schema got later, as nulls."""
    later = [name for name, _ in schemas.LENS_COLUMNS]
    if [*table.schema.names, *later] != schema.names:
        return table
    for name in later:
        field = schema.field(name)
        table = table.append_column(field, pa.nulls(len(table), field.type))
    return table
