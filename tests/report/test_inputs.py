from pathlib import Path

import pytest

from ntop.config.tables import Actor
from ntop.conventions import DataError
from ntop.report.inputs import Dataset, ResultFolders


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
