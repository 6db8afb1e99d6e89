import os

import pyarrow as pa
import pytest

from ntop.conventions import DataError
from ntop.storage.atomic import atomic_folder, atomic_path, publish_folder, write_bytes
from ntop.storage.tables import read_table, write_table

SCHEMA = pa.schema(
    [("source", pa.string()), ("frame", pa.int32()), ("values", pa.list_(pa.float64(), 2))]
)
ROWS = [
    {"source": "b", "frame": 2, "values": [0.1, 1e-17]},
    {"source": "a", "frame": 9, "values": [3.0, 4.0]},
]


def test_rows_come_back_sorted_and_exact(tmp_path):
    write_table(ROWS, schema=SCHEMA, path=tmp_path / "t.parquet")
    assert read_table(tmp_path / "t.parquet", schema=SCHEMA) == ROWS[::-1]


def test_same_rows_in_another_order_give_the_same_bytes(tmp_path):
    write_table(ROWS, schema=SCHEMA, path=tmp_path / "a.parquet")
    write_table(ROWS[::-1], schema=SCHEMA, path=tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


@pytest.mark.parametrize(
    "row", [{"source": "a", "frame": 1}, {**ROWS[0], "extra": 1}, {**ROWS[0], "values": [1.0]}]
)
def test_a_row_that_does_not_fit_is_refused_and_nothing_is_written(tmp_path, row):
    with pytest.raises(DataError):
        write_table([row], schema=SCHEMA, path=tmp_path / "t.parquet")
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_table_is_an_error_with_its_name(tmp_path):
    path = tmp_path / "t.parquet"
    write_table(ROWS, schema=SCHEMA, path=path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"t\.parquet.*--forcerun"):
        read_table(path, schema=SCHEMA)


def test_another_schema_is_an_error(tmp_path):
    write_table(ROWS, schema=SCHEMA, path=tmp_path / "t.parquet")
    with pytest.raises(DataError, match="another version"):
        read_table(tmp_path / "t.parquet", schema=pa.schema([("x", pa.int32())]))


def test_an_error_while_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "f"
    write_bytes(path, b"old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_published_whole_or_not_at_all(tmp_path):
    target = tmp_path / "out"
    with pytest.raises(RuntimeError), atomic_folder(target) as work:
        (work / "x").write_text("half")
        raise RuntimeError
    assert not target.exists()
    with atomic_folder(target) as work:  # what the failed run left is removed
        assert list(work.iterdir()) == []
        (work / "x").write_text("whole")
    assert (target / "x").read_text() == "whole"
    newer = tmp_path / "newer"
    newer.mkdir()
    publish_folder(newer, target)
    assert list(target.iterdir()) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


def test_an_unwritable_place_is_a_clear_error(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    with pytest.raises(DataError, match="permissions"):
        write_bytes(blocked / "below" / "x", b"")
    if os.geteuid() != 0:  # root may write anywhere
        tmp_path.chmod(0o500)
        with pytest.raises(DataError, match="permissions"):
            write_bytes(tmp_path / "new", b"")
        tmp_path.chmod(0o700)
