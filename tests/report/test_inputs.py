import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from ntop.config.tables import Actor
from ntop.conventions import DataError
from ntop.report.inputs import Dataset, ResultFolders
from ntop.storage.manifest import ManifestReader


def test_what_a_source_provides_lies_with_its_capture():
    roots = ResultFolders(Path("c"), Path("m"), Path("f"), Path("a"))
    actor = Actor(source="lab", actor="ada", split="val")
    computed = roots.of(actor, provides=())
    assert (computed.capture, computed.mattes) == (Path("c/lab/ada"), Path("m/lab/ada"))
    assert (computed.bodies, computed.avatar) == (Path("f/lab/ada"), Path("a/lab/ada"))
    given = roots.of(actor, provides=("masks", "bodies"))
    assert (given.mattes, given.bodies) == (Path("c/lab/ada"), Path("c/lab/ada"))


def test_the_dataset_knows_its_sets(world):
    dataset = Dataset.read(world.dataset)
    assert dataset.name == "tiny"
    assert len(dataset.rows) == 36
    assert [len(views) for views in dataset.sets.values()] == [9, 9, 9, 9]
    assert (dataset.num_images, dataset.num_sets) == (36, 4)
    with pytest.raises(DataError, match="cannot read table"):
        Dataset.read(world.root)


@pytest.mark.parametrize("max_sets", [2, 3, 4])
def test_a_sample_has_whole_sets_of_every_actor(world, max_sets):
    whole = Dataset.read(world.dataset)
    sample = Dataset.read(world.dataset, max_sets=max_sets)
    assert (sample.num_images, sample.num_sets) == (36, 4)
    per_actor = {2: 1, 3: 2, 4: 2}[max_sets]  # two actors, one rig
    assert len(sample.sets) == 2 * per_actor
    for key, views in sample.sets.items():
        assert views == whole.sets[key]


def test_rows_are_found_by_their_ids_beyond_the_sample(world):
    whole = Dataset.read(world.dataset)
    sample = Dataset.read(world.dataset, max_sets=1)
    wanted = whole.rows[4::7]
    ids = [row["sample_id"] for row in wanted]
    assert list(sample.rows_with([*ids[::-1], "unknown"])) == list(wanted)


@pytest.mark.parametrize(
    ("column", "read"),
    [
        ("view", lambda manifest: list(manifest.rows([0, 7]))),
        ("actor", lambda manifest: list(manifest.sets())),
        ("sample_id", lambda manifest: manifest.numbers_of(["none"])),
    ],
)
def test_damaged_rows_of_a_manifest_are_named_with_what_to_do(world, tmp_path, column, read):
    """What Arrow sees only when it reads the rows: the file's end, with its columns, is whole."""
    for name in ("manifest.parquet", "files.parquet"):
        shutil.copy(world.dataset / name, tmp_path)
    path = tmp_path / "manifest.parquet"
    group = pq.ParquetFile(path).metadata.row_group(0)
    chunks = [group.column(index) for index in range(group.num_columns)]
    chunk = next(chunk for chunk in chunks if chunk.path_in_schema == column)
    content = bytearray(path.read_bytes())
    first = chunk.dictionary_page_offset or chunk.data_page_offset
    content[first + chunk.total_compressed_size - 1] ^= 0xA5  # the page's last byte
    path.write_bytes(content)
    manifest = ManifestReader(tmp_path)
    with pytest.raises(DataError, match=rf"{path}: .*--forcerun {tmp_path}` added"):
        read(manifest)
