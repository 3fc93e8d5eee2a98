"""Every row of the fault table on its own, and that each guard is needed for it."""

from __future__ import annotations

import pytest

from softneck.drives.master import Phase
from softneck.drives.master._events import RULES, Reaction

from ..bench import Bench
from ..broken import ROWS
from ..fault_table import Scenario, short_dropout
from ..scenarios import SCENARIOS


def bench_for(scenario: Scenario, *, without: bool = False) -> Bench:
    off = scenario.others_off | (scenario.guards if without else frozenset())
    changes = scenario.drive_guard if without else ()
    return Bench(off=off, drive_changes=changes, change=scenario.change).start()


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_fault_table(name: str) -> None:
    bench = bench_for(SCENARIOS[name])
    assert bench.phase is Phase.RUNNING
    SCENARIOS[name].play(bench)


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_guards_are_needed(name: str) -> None:
    """With its guards off the same scenario must miss its requirement."""
    with pytest.raises(AssertionError):
        SCENARIOS[name].play(bench_for(SCENARIOS[name], without=True))


def test_every_guard_that_stops_has_a_scenario_that_needs_it() -> None:
    needed = {guard for scenario in SCENARIOS.values() for guard in scenario.guards}
    acting = {name for name, rule in RULES.items() if rule.reaction in (Reaction.STOP, Reaction.RETREAT)}
    # Those of the plausibility supervisor have rows of their own, in tests/drives/plausible.py.
    needed |= {name for row in ROWS.values() for name in row.names} | {"sensor_rate"}
    # Tests of their own: `pushed` in test_jog.py, for it acts before a run begins, `not_off` in test_switched_off.py,
    # for it acts after, `loop_failed` in test_closing.py, for it acts beside the master; the others in test_master.py.
    others = {"clock", "enable_timeout", "ramp_timeout", "operator", "pushed", "not_off", "loop_failed"}
    assert acting - needed == others


def test_a_short_dropout_is_bridged() -> None:
    short_dropout(Bench().start())
