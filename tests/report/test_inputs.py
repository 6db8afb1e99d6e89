import pytest

from ntop.conventions import DataError
from ntop.report.inputs import Dataset, actor_folders


def test_folders_are_paired_by_actor(world):
    captures = [actor.capture for actor in world.actors]
    avatars = [actor.avatar for actor in world.actors]
    found = actor_folders(captures, mattes=captures, bodies=captures, avatars=avatars)
    assert found == list(world.actors)
    with pytest.raises(DataError, match="one order"):
        actor_folders(captures, mattes=captures, bodies=captures, avatars=avatars[::-1])
    with pytest.raises(DataError, match="one order"):
        actor_folders(captures, mattes=captures[:1], bodies=captures, avatars=avatars)


def test_the_dataset_knows_its_sets(world):
    dataset = Dataset.read(world.dataset)
    assert dataset.name == "tiny"
    assert len(dataset.rows) == 36
    assert [len(views) for views in dataset.sets.values()] == [9, 9, 9, 9]
    assert len(dataset.of(world.studio)) == 18
    with pytest.raises(DataError, match="cannot read table"):
        Dataset.read(world.root)
