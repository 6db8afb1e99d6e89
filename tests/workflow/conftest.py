"""A project folder of its own for every workflow test, and one undisturbed tiny campaign."""

import pytest

from tests.workflow.project import Project


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)


@pytest.fixture(scope="session")
def campaign(tmp_path_factory):
    """The tiny campaign, run once without any disturbance."""
    project = Project(tmp_path_factory.mktemp("campaign"))
    done = project.run()
    assert done.returncode == 0, done.stdout + done.stderr
    return project
