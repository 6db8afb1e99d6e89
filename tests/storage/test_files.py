import pytest

from ntop.conventions import DataError
from ntop.storage.files import check_files, read_records, record_files
from ntop.storage.remedies import output_of


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "results/1_capture/lab/ada"
    (folder / "images").mkdir(parents=True)
    (folder / "images/a.png").write_bytes(bytes(range(256)))
    (folder / "table.parquet").write_bytes(b"rows")
    record_files(folder)
    return folder


def test_a_folder_is_recorded_whole_and_agrees_with_itself(folder):
    (folder / ".snakemake_timestamp").touch()  # what is put there afterwards is nobody's business
    check_files(folder)
    assert {name: row["num_bytes"] for name, row in read_records(folder).items()} == {
        "images/a.png": 256,
        "table.parquet": 4,
    }


def truncated(path):
    path.write_bytes(path.read_bytes()[:100])


def flipped(path):
    content = bytearray(path.read_bytes())
    content[17] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (truncated, "has 100 bytes, 256 were written"),
        (flipped, "holds other bytes than were written"),
        (lambda path: path.unlink(), "cannot be read: No such file"),
    ],
)
def test_damage_names_the_file_and_the_remedy(folder, damage, said):
    damage(folder / "images/a.png")
    with pytest.raises(DataError, match=rf"images/a.png {said}.*--forcerun {folder}` added"):
        check_files(folder)
    check_files(folder, only={"table.parquet"})


def test_a_folder_made_by_hand_is_taken_as_it_is(tmp_path):
    (tmp_path / "a.png").write_bytes(b"mine")
    check_files(tmp_path)


def test_a_file_belongs_to_the_outermost_recorded_folder(folder):
    record_files(folder / "images")
    assert output_of(folder / "images/a.png") == folder
    assert output_of(folder.parent / "other.parquet") == folder.parent / "other.parquet"
