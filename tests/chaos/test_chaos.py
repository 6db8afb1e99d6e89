"""A dozen disturbances of the tiny campaign; `make chaos` runs many more, at random."""

import pytest

from tests.chaos.catalogue import IN_TESTS, QUICK, SLOW, deal, find, lacking
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


def test_a_deck_holds_every_kind_and_depends_on_its_seed():
    deck = deal(80, 1)
    assert len(deck) == 80
    assert deck == deal(80, 1)
    assert deck != deal(80, 2)


def test_a_disturbance_is_known_by_its_name_and_stage():
    names = [(kind.name, kind.stage) for kind in [*QUICK, *SLOW]]
    assert len(set(names)) == len(names)
