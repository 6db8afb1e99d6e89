"""The acceptance suite for arithmetic: test_NN_* is case NN of docs/numerics.md.

Each case states its measured margins through `margin`; `make numerics` writes them into that page.
"""

import json
import math

import pytest


class Margins:
    """Compares with a limit, and keeps both for the page. NaN never passes."""

    def __init__(self, record) -> None:
        self._record = record

    def at_most(self, what: str, measured: float, limit: float, unit: str = "") -> None:
        """`measured` <= `limit`."""
        self._keep("at most", what, measured, limit, unit)
        assert measured <= limit, f"{what}: {measured:.3g} {unit}, expected at most {limit:.3g}"

    def at_least(self, what: str, measured: float, limit: float, unit: str = "") -> None:
        """`measured` >= `limit`."""
        self._keep("at least", what, measured, limit, unit)
        assert measured >= limit, f"{what}: {measured:.3g} {unit}, expected at least {limit:.3g}"

    def mutant_exceeds(self, what: str, measured: float, limit: float, unit: str = "") -> None:
        """A deliberately wrong formula that the case's `limit` must catch; NaN is caught."""
        self._keep("mutant above", what, measured, limit, unit)
        caught = math.isnan(measured) or measured > limit
        assert caught, f"{what}: the mutant's {measured:.3g} {unit} passes the limit {limit:.3g}"

    def _keep(self, relation: str, what: str, measured: float, limit: float, unit: str) -> None:
        values = {"measured": float(measured), "limit": float(limit)}
        kept = {"what": what, "relation": relation, **values}
        self._record("margin", json.dumps({**kept, "unit": unit}))


@pytest.fixture
def margin(record_property) -> Margins:
    """The case's margins."""
    return Margins(record_property)
