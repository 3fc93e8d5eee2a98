"""What of the inclinometer is believed, what a set-point may be, and the model beside both, on cases done by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softneck.drives.master import Tilt
from softneck.drives.master._events import Event
from softneck.drives.master._gate import Gate
from softneck.drives.master._limiter import Limiter
from softneck.drives.master._settings import LimitSettings, WatchSettings
from softneck.drives.master._watches import Watches

T, TS = 0.01, 0.02


def feed(gate: Gate, samples: list[Tilt | None], *, first: int = 0) -> list[tuple[bool, list[str]]]:
    """Give the gate one sample each 20 ms; return what it believed and told."""
    rows = []
    for k, sample in enumerate(samples, start=first):
        events: list[Event] = []
        rows.append((gate.step(k * TS, sample, events), [event.name for event in events]))
    return rows


def moving(count: int) -> list[Tilt | None]:
    return [Tilt(1e-4 * k, -1e-4 * k) for k in range(count)]


# -- the gate ---------------------------------------------------------------------------------------------------------


def test_a_lost_sensor_is_told_when_its_time_is_over() -> None:
    gate = Gate(1.2)
    assert feed(gate, moving(3)) == [(True, [])] * 3
    # The last good one was at 40 ms: at 120 ms the 80 ms are over, and then in each sample until one comes.
    assert feed(gate, [None] * 5, first=3) == [(False, [])] * 3 + [(False, ["sensor_lost"])] * 2
    assert feed(gate, [Tilt(0.0, 0.0)], first=8) == [(True, [])]
    # One that says itself that it is invalid is none.
    assert feed(gate, [Tilt(0.0, 0.0, valid=False)] * 4, first=9) == [(False, [])] * 3 + [(False, ["sensor_lost"])]


def test_a_sensor_that_never_came_is_lost_from_its_first_sample_on() -> None:
    assert feed(Gate(1.2), [None] * 5, first=100) == [(False, [])] * 4 + [(False, ["sensor_lost"])]


def test_identical_samples_are_frozen_when_there_are_as_many() -> None:
    gate = Gate(1.2)
    same = Tilt(0.1, 0.2)
    rows = feed(gate, [same] * 21)
    assert [told for _, told in rows] == [[]] * 19 + [["sensor_frozen"]] * 2
    assert [good for good, _ in rows] == [True] * 19 + [False] * 2
    # One axis that moves is enough, and counting begins anew.
    assert feed(gate, [Tilt(0.1, 0.2001), *[Tilt(0.1, 0.2)] * 19], first=21) == [(True, [])] * 20


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angles_beyond_the_neck_and_jumps_are_no_samples_and_three_in_a_row_stop(axis: int, sign: float) -> None:
    def tilt(angle: float, k: int = 0) -> Tilt:
        values = [1e-5 * k, 1e-5 * k]
        values[axis] = sign * angle + 1e-7 * k
        return Tilt(values[0], values[1])

    assert feed(Gate(1.0), [tilt(0.999)]) == [(True, [])]
    rows = feed(Gate(1.0), [tilt(1.001 + 0.01 * k) for k in range(3)])
    assert [told[:2] for _, told in rows] == [["sample_discarded"]] * 2 + [["sample_discarded", "sensor_bad"]]
    # 20 ms at 8 rad/s and the 3 deg make 0.2124 rad; after a sample that did not count it is 40 ms.
    for jump, good in ((0.212, True), (0.213, False)):
        gate = Gate(1.0)
        assert feed(gate, [tilt(0.0), tilt(jump)])[1][0] is good
        assert gate.last == (tilt(jump) if good else tilt(0.0))
    gate = Gate(1.0)
    assert [good for good, _ in feed(gate, [tilt(0.0), tilt(0.5), tilt(0.372, 1)])] == [True, False, True]
    # A good one between two bad ones begins the count anew.
    names = feed(gate, [tilt(0.95), tilt(0.95, 1), tilt(0.373, 2), tilt(0.95, 3), tilt(0.95, 4)], first=3)
    assert "sensor_bad" not in {name for _, told in names for name in told}


def test_what_is_no_number_is_no_sample() -> None:
    for wrong in (Tilt(math.nan, 0.0), Tilt(0.0, math.inf)):
        assert feed(Gate(1.2), [wrong])[0] == (False, ["sample_discarded"])


# -- the limiter ------------------------------------------------------------------------------------------------------


def test_a_long_way_has_the_trapezoid_of_speed_and_acceleration() -> None:
    """From rest: a up to v, then v, then down to rest at the goal; the way's time is s/v + v/a."""
    limits = LimitSettings(position=50.0, speed=2.0, acceleration=10.0)
    limiter = Limiter(limits, T)
    path = np.array([0.0] + [limiter.step(4.0, 1.0) for _ in range(400)])
    speed = np.diff(path) / T
    change = np.diff(speed) / T
    assert path[-1] == pytest.approx(4.0, abs=1e-6)
    assert speed.max() == pytest.approx(2.0, rel=1e-9)
    # Each step of speed is at most a T; rounding of positions of 4 over T^2.
    assert np.abs(change).max() <= 10.0 * (1.0 + 1e-6)
    np.testing.assert_allclose(speed[:20], 10.0 * T * np.arange(1, 21), rtol=1e-9)
    # 4/2 + 2/10 = 2.2 s, and the discrete stop creeps in over a few cycles of 10 ms.
    arrived = int(np.flatnonzero(path > 4.0 - 1e-3)[0]) * T
    assert arrived == pytest.approx(2.2, abs=0.05)
    # Half of the time is at full speed: not slower than needed.
    assert (speed > 1.999).sum() * T == pytest.approx(1.8, abs=0.05)


@pytest.mark.parametrize(
    ("wanted", "tension", "limits", "why"),
    [
        (7.0, 1.0, LimitSettings(position=6.0, speed=100.0, acceleration=1e5), "position"),
        (-7.0, 1.0, LimitSettings(position=6.0, speed=100.0, acceleration=1e5), "position"),
        (1.0, 9.7, LimitSettings(tension=12.0), "tension"),
        (1.0, 1.0, LimitSettings(speed=2.0, acceleration=1e5), "speed"),
        # What comes first is told: the speed is limited by the position's limit already.
        (7.0, 1.0, LimitSettings(position=6.0, speed=2.0, acceleration=1e5), "position"),
        (-1.0, 1.0, LimitSettings(speed=2.0, acceleration=1e5), "speed"),
        (-0.1, 1.0, LimitSettings(acceleration=10.0), "acceleration"),
        (0.1, 1.0, LimitSettings(acceleration=10.0), "acceleration"),
        (-5.0, 0.1, LimitSettings(slack=0.2, slack_unwind=3.0, speed=100.0, acceleration=1e5), "slack"),
        (0.01, 1.0, LimitSettings(), ""),
        (0.0, 50.0, LimitSettings(), ""),
    ],
)
def test_what_limits_a_step_is_named(wanted: float, tension: float, limits: LimitSettings, why: str) -> None:
    limiter = Limiter(limits, T)
    limiter.step(wanted, tension)
    assert limiter.clamped == why


def test_pulling_is_refused_from_four_fifths_of_the_tension_on_and_letting_out_never() -> None:
    limits = LimitSettings(tension=10.0)
    for tension, moves in ((7.99, True), (8.01, False)):
        limiter = Limiter(limits, T)
        assert (limiter.step(0.05, tension) > 0.0) is moves
        limiter.reset(0.0)
        assert limiter.step(-0.05, tension) < 0.0


def test_a_hanging_tendon_is_let_out_by_so_much_from_where_it_hung() -> None:
    limits = LimitSettings(slack=0.2, slack_unwind=0.5, speed=100.0, acceleration=1e5)
    limiter = Limiter(limits, T)
    for _ in range(50):
        limiter.step(-2.0, 1.0)
    assert limiter.value == pytest.approx(-2.0, abs=1e-6)
    for _ in range(50):
        limiter.step(-4.0, 0.19)
    assert limiter.value == pytest.approx(-2.5, abs=1e-6)
    # At the border it does not hang: the floor is forgotten.
    for _ in range(50):
        limiter.step(-4.0, 0.2)
    assert limiter.value == pytest.approx(-4.0, abs=1e-6)
    for _ in range(50):
        limiter.step(-6.0, 0.0)
    assert limiter.value == pytest.approx(-4.5, abs=1e-6)


def test_a_hanging_tendon_goes_with_the_neck_and_is_never_pulled_for_it() -> None:
    """What the neck leant away is no slack: 0.5 rad beyond it, and none where it leans back."""
    limits = LimitSettings(slack=0.2, slack_unwind=0.5, speed=100.0, acceleration=1e5)
    limiter = Limiter(limits, T)
    # It began to hang with the neck leaning towards it by 0.3 rad of its motor; now it leans the other way.
    limiter.step(0.0, 0.1, 0.3)
    for _ in range(50):
        limiter.step(-4.0, 0.1, -0.7)
    assert limiter.value == pytest.approx(-1.0 - 0.5, abs=1e-6)
    for _ in range(50):
        limiter.step(-4.0, 0.1, 0.3)
    assert limiter.value == pytest.approx(-1.5, abs=1e-6)
    assert limiter.clamped == "slack"


def test_what_the_angles_lead_the_motors_to_gives_these_angles() -> None:
    """The inverse of the static model: two angles from three motors, of which the sum is nobody's."""
    watches = Watches(WatchSettings(), LimitSettings())
    watches.tilt(0.0, 0.02, (0.0, 0.0, 0.0), (0.1, -0.05), [])
    assert sum(watches.led) == pytest.approx(0.0, abs=1e-12)
    assert watches._static(watches.led) == pytest.approx([0.1, -0.05], abs=1e-12)
    # A sample that did not come leaves the last; unknown directions lead nobody.
    watches.tilt(0.02, 0.02, (0.0, 0.0, 0.0), None, [])
    assert watches._static(watches.led) == pytest.approx([0.1, -0.05], abs=1e-12)
    unknown = Watches(WatchSettings(), LimitSettings(), weights=())
    unknown.tilt(0.0, 0.02, (0.0, 0.0, 0.0), (0.1, -0.05), [])
    assert unknown.led == (0.0, 0.0, 0.0)


def test_a_reset_stands_still_at_its_value_and_forgets() -> None:
    limiter = Limiter(LimitSettings(), T)
    for _ in range(5):
        limiter.step(3.0, 0.0)
    limiter.reset(1.25)
    assert (limiter.value, limiter.speed, limiter.clamped) == (1.25, 0.0, "")
    assert limiter.step(1.25, 1.0) == 1.25


# -- the model beside -------------------------------------------------------------------------------------------------


def test_the_watched_tilt_is_the_papers_first_order_answer_to_the_motors() -> None:
    """Eq. 9, 10, 31: pitch' = p (gain sum P_i cos gamma_i - pitch), sampled exactly; the same with sines for roll."""
    settings = WatchSettings(gain=0.1, pole=4.0, tilt=0.05)
    watches = Watches(settings, LimitSettings())
    watches.align((0.3, -0.2), (0.0, 0.0, 0.0))
    P = (1.0, -0.5, 0.25)
    angles = np.array(settings.tendon_angles)
    end = 0.1 * np.array([np.dot(P, np.cos(angles)), np.dot(P, np.sin(angles))])
    for k in range(1, 40):
        expected = end * (1.0 - math.exp(-4.0 * k * TS))
        events: list[Event] = []
        # What was there at the start, 0.3 and -0.2 rad, is a bias of the sensor.
        watches.tilt(k * TS, TS, P, (0.3 + expected[0], -0.2 + expected[1]), events)
        assert watches.angles == pytest.approx(list(expected), rel=1e-12)
        assert events == []


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_tilt_that_is_off_is_told_after_150_ms(axis: int, sign: float) -> None:
    def told(size: float, *, aligned: bool = True, missing: bool = False) -> list[tuple[int, str]]:
        watches = Watches(WatchSettings(tilt=0.2), LimitSettings())
        if aligned:
            watches.align((0.0, 0.0), (0.0, 0.0, 0.0))
        seen = []
        for k in range(10):
            events: list[Event] = []
            measured = [0.0, 0.0]
            measured[axis] = sign * size
            watches.tilt(k * TS, TS, (0.0, 0.0, 0.0), None if missing else (measured[0], measured[1]), events)
            seen += [(k, event.name) for event in events]
        return seen

    # At 20 ms a sample the eighth, 160 ms after the first, is the first beyond 150 ms.
    assert told(0.201) == [(8, "diverged"), (9, "diverged")]
    assert told(0.199) == []
    assert told(0.5, aligned=False) == []
    assert told(0.5, missing=True) == []


def test_aligned_where_the_motors_stand_the_rest_is_a_bias() -> None:
    watches = Watches(WatchSettings(gain=0.1, tilt=0.05), LimitSettings())
    watches.align((0.5, 0.5), (2.0, -1.0, -1.0))
    assert watches.angles == pytest.approx([0.3, 0.0], abs=1e-12)
    events: list[Event] = []
    for k in range(20):
        watches.tilt(k * TS, TS, (2.0, -1.0, -1.0), (0.5, 0.5), events)
    assert events == []
