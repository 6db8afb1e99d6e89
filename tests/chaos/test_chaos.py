"""A dozen disturbances of the tiny campaign; `make chaos` runs many more, at random."""

import pytest

from tests.chaos import catalogue
from tests.chaos.catalogue import IN_TESTS, QUICK, SLOW, deal, find, lacking
from tests.chaos.slurm import SLURM_KINDS
from tests.chaos.trial import run_trial

SEED = 20261123

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("campaign")]


@pytest.mark.parametrize(("name", "stage"), IN_TESTS, ids=["-".join(kind) for kind in IN_TESTS])
def test_a_disturbed_campaign_ends_with_the_same_dataset(campaign, tmp_path, name, stage):
    kind = find(name, stage)
    if said := lacking(kind):
        pytest.skip(said)
    outcome = run_trial(0, kind, SEED, finished=campaign, place=tmp_path)
    assert outcome.survived, outcome


def test_sixty_trials_hold_every_name_and_a_longer_deck_every_stage(monkeypatch):
    monkeypatch.setattr(catalogue, "lacking", lambda _: "")  # also those that need root
    nightly = [kind.name for kind, _ in deal(60 - len(SLURM_KINDS), 1)]
    assert set(nightly) == {kind.name for kind in [*QUICK, *SLOW]}
    longer = {(kind.name, kind.stage) for kind, _ in deal(len([*QUICK, *SLOW]), 1)}
    assert longer == {(kind.name, kind.stage) for kind in [*QUICK, *SLOW]}


def test_a_deck_depends_on_its_seed():
    deck = deal(80, 1)
    assert len(deck) == 80
    assert deck == deal(80, 1)
    assert deck != deal(80, 2)


def test_a_disturbance_is_known_by_its_name_and_stage():
    names = [(kind.name, kind.stage) for kind in [*QUICK, *SLOW]]
    assert len(set(names)) == len(names)
