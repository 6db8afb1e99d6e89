"""One throw-away cluster and one undisturbed campaign for all tests of the folder."""

import os

import pytest

from tests.slurm.cluster import Cluster, SlurmProject, slurm_is_installed
from tests.workflow.project import TEST_CONFIG


@pytest.fixture(scope="session")
def cluster():
    if os.environ.get("NTOP_SLURM") != "1":
        pytest.skip("starts a SLURM of its own; say NTOP_SLURM=1 to run it")
    if not slurm_is_installed():
        pytest.skip("no slurmctld here; on Debian: apt install slurm-wlm munge")
    cluster = Cluster()
    try:
        cluster.up()
        yield cluster
    finally:
        cluster.down()


@pytest.fixture
def project(cluster, tmp_path):
    project = SlurmProject(tmp_path, cluster)
    yield project
    project.end()


@pytest.fixture(scope="session")
def campaign(cluster, tmp_path_factory):
    """The whole tiny campaign, run through SLURM without any disturbance."""
    project = SlurmProject(tmp_path_factory.mktemp("slurm_campaign"), cluster)
    assert project.submit(*TEST_CONFIG) == 0, project.said()
    return project
