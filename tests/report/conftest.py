import pytest

from tests.report.small_world import World, build_world


@pytest.fixture(scope="session")
def world(tmp_path_factory) -> World:
    """The small world, built once; tests that damage something copy it first."""
    return build_world(tmp_path_factory.mktemp("world"))
