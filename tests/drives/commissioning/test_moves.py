"""The moves of a commissioning on a toy: what they measure is what it is made of, and each guard stops them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.drives.commissioning._features import features, hinge, line, staircase
from softneck.drives.commissioning._moves import (
    BLIND,
    HANGS,
    PULLED,
    WIGGLE,
    Guards,
    Moves,
    counts_per_turn,
)

from .toy import COUNTS, TURN, Toy, mover_of


@pytest.mark.parametrize(
    "toy",
    [
        Toy(),
        Toy(pull=(-1, 1, 1)),
        Toy(slack=(0.0, 1.0, 1.0)),
        Toy(counts=(2.0 * COUNTS, COUNTS, COUNTS), turn=(2.0 * TURN, TURN, TURN)),
        Toy(late=13),
    ],
    ids=["as believed", "reversed", "no slack", "twice the lines", "late"],
)
def test_what_is_measured_is_what_the_toy_is_made_of(toy: Toy) -> None:
    moves = toy.run(mover_of(motors=(1,)))
    one = features(moves.motors[0])
    assert one is not None
    assert (moves.stopped, moves.motors[0].outcome, moves.motors[0].way) == ("", PULLED, toy.pull[0])
    assert (one.pull, one.turn) == (toy.pull[0], toy.turn[0])
    # The hinge bends at one of 60 places of a way of 0.6 rad, and the tilt of a late sensor is that of 0.3 s before:
    # at 0.15 rad/s 0.04 rad.
    assert one.slack / toy.counts[0] == pytest.approx(toy.slack[0], abs=0.06)
    assert one.gain * toy.counts[0] == pytest.approx(toy.gain, rel=0.01)
    assert one.force * toy.counts[0] == pytest.approx(toy.force, rel=0.2)
    assert one.friction == pytest.approx(toy.friction, abs=0.3)
    assert one.lag == pytest.approx(0.02 * toy.late, abs=0.005)
    # Drives that do as they are told and a sensor that is in time: no more than the target and what 0.3 s add.
    assert math.degrees(toy.largest) < 2.0


def test_motors_that_are_moved_in_another_order_measure_the_same() -> None:
    """Three tendons that do not know of each other: the numbers of each stay, whoever goes first."""
    toy = {"slack": (0.3, 0.7, 0.2), "pull": (1, -1, 1)}
    first, second = (Toy(**toy).run(mover_of(motors=order)) for order in ((1, 2, 3), (3, 1, 2)))  # type: ignore[arg-type]
    for motor in (1, 2, 3):
        a, b = (features(moves.of(motor)) for moves in (first, second))  # type: ignore[arg-type]
        assert a is not None
        assert b is not None
        # When it began shifts only the rounding of the times.
        assert (a.pull, a.turn, a.slack) == (b.pull, b.turn, b.slack)
        assert a.gain == pytest.approx(b.gain, rel=1e-6)


def test_a_tendon_that_hangs_ends_the_search_at_the_travel() -> None:
    toy = Toy(slack=(50.0, 1.0, 1.0))
    moves = toy.run(mover_of(Guards(travel=2.0), motors=(1,)))
    assert (moves.stopped, moves.motors[0].outcome) == ("", HANGS)
    far = np.abs(moves.motors[0].counts).max() / COUNTS
    assert far == pytest.approx(2.0, abs=0.01)


def test_a_reversed_motor_is_let_out_by_less_than_the_travel() -> None:
    """What hangs further out is wound up the wrong way round: the other way comes before the whole travel."""
    moved = Toy(pull=(-1, 1, 1)).run(mover_of(Guards(travel=2.0), motors=(1,))).motors[0]
    assert moved.outcome == PULLED
    assert np.max(moved.counts) / COUNTS == pytest.approx(0.6 * 2.0, abs=0.01)


def test_a_sensor_that_sees_nothing_is_named_and_the_current_ends_the_pull() -> None:
    toy = Toy(sees=0.0)
    moves = toy.run(mover_of(motors=(1,)))
    assert (moves.stopped, moves.motors[0].outcome) == ("", BLIND)
    # 1.6 times the friction's 5 units at 20 units for a radian: 0.4 rad, 2.1 deg.
    assert math.degrees(toy.largest) < 3.0


def test_somebody_who_pushes_is_stopped_by_the_guard_of_the_tilt() -> None:
    toy = Toy(push=math.radians(3.2))
    moves = toy.run(mover_of(motors=(1,)), push_at=5.0)
    assert moves.stopped.startswith("tilt: ")
    # Told at the second sample of the push, and a sensor that is 60 ms late.
    assert toy.rows * 0.02 < 5.0 + 0.16


def test_a_guard_of_travel_and_one_of_time_stop_what_does_not_end() -> None:
    class Runs(Toy):
        """A drive whose counts run away from what it is asked for."""

        def _move(self, j: int, view: object, wanted: float, before: float, mover: object) -> None:
            super()._move(j, view, 3.0 * wanted, 3.0 * before, mover)  # type: ignore[arg-type]

    away = Runs(slack=(50.0, 1.0, 1.0)).run(mover_of(Guards(travel=2.0), motors=(1,)))
    assert away.stopped == "travel: motor 1 is 2.3 rad from where it stood"
    slow = Toy(slack=(50.0, 1.0, 1.0)).run(mover_of(Guards(time=10.0), motors=(1,)))
    assert slow.stopped == "time: motor 1 took longer than 10 s"


@pytest.mark.parametrize(
    ("change", "message"),
    [({"tilt": math.radians(4.0)}, "`tilt` must be between 0.5 and 3"), ({"target": math.radians(2.0)}, "target"),
     ({"travel": 100.0}, "--travel"), ({"speed": 2.0}, "speed"), ({"slow": 0.5}, "slow"), ({"time": 1.0}, "time"),
     ({"contact": 1.0}, "contact")],
)  # fmt: skip
def test_guards_have_limits_of_their_own(change: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Guards(**change)


def test_a_neck_that_tilts_more_is_moved_slower() -> None:
    slow, slower = Guards.of(0.09), Guards.of(0.18)
    assert slower.speed < slow.speed
    assert slower.slow < slow.slow
    # Twice as fast as believed and told 0.35 s late it is still within the guard: 1.3 deg/s x 2 x 0.35 s + 0.6 deg.
    assert slower.speed * 0.18 * 2.0 * 0.35 + slower.contact < slower.tilt


def test_a_hinge_is_found_and_steps_say_more_than_a_line() -> None:
    x = np.linspace(0.0, 1.0, 400)
    y = 5.2 + 4.0 * np.maximum(0.0, x - 0.5)
    knee = hinge(x, y)
    assert knee == pytest.approx(0.5, abs=0.02)  # one of 60 places
    assert line(x, y, 0.5)[:2] == pytest.approx((5.2, 4.0), rel=1e-9)
    level, slope = staircase(x, np.round(y), 0.5)
    assert abs(slope - 4.0) < abs(line(x, np.round(y), 0.5)[1] - 4.0)
    assert np.round(level + slope * np.maximum(0.0, x - 0.5)) == pytest.approx(np.round(y), abs=1.0)


@pytest.mark.parametrize(
    ("captures", "turn"),
    [((), 0), ((5,), 0), ((0, 2048), 2048), ((0, 2048, 0, -2048), 2048), ((4096, 2048, 2051, 4099), 2048), ((7, 9), 0)],
)
def test_a_turn_is_the_way_between_two_pulses_whatever_edges_do(captures: tuple[int, ...], turn: int) -> None:
    assert counts_per_turn(captures) == turn


def test_moves_without_a_wiggle_say_nothing() -> None:
    moved = Toy().run(mover_of(motors=(1,))).motors[0]
    keep = ~moved.rows(WIGGLE)
    cut = replace(
        moved, **{name: getattr(moved, name)[keep] for name in ("phase", "time", "counts", "current", "outputs")}
    )
    assert features(cut) is None
    assert Moves((cut,)).of(1) is cut
