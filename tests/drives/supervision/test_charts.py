"""What the charts of motors rest for, and what a jump was: each rule on numbers that only it decides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from softneck.drives.supervision._calibrate import _Samples, _tilt_noise, fit
from softneck.drives.supervision._charts_runtime import (
    SUPERVISED_NOT,
    supervised_faults,
    supervised_levels,
    supervised_load,
    supervised_motors,
)
from softneck.drives.supervision._motor_charts import SCALES, MotorCharts, MotorRules
from softneck.drives.supervision._motor_models import Motion, features_of, level_rows
from softneck.drives.supervision._plausibility import Finding, Plausibility
from softneck.drives.supervision._tilt_charts import GyroLevel, TiltCharts, TiltModel, tilt_names

from ..plausible import baseline

N, FEATURES = 3, 16
TOP, REACH, SLACK = 10.0, 1.0, 0.5
GATES = (np.full(N, TOP), np.full(N, REACH), np.full(N, SLACK))


def levels(
    tensions: list[float],
    *,
    behind: float = 0.0,
    rest: int | None = None,
    seen: int = 50,
    share: float = 1.0,
    before: float = 0.0,
) -> np.ndarray:
    """Return scores (scales, motors) where each tension should be `share` of the others' mean, in `seen` cycles.

    Motors are at 0, so far `behind` their set-points, and were at `before`.
    """
    level = np.zeros((N, FEATURES + 2))
    level[:, FEATURES] = share
    positions = np.full((5, N), before)
    positions[0] = 0.0
    past = (np.full((12, N), behind), positions, np.tile(tensions, (4, 1)))
    resting = np.full(N, -1.0)
    if rest is not None:
        resting[rest] = 1.0
    scores = np.full(len(SCALES) * N, np.nan)
    model = (level, np.full(N, 0.01), np.zeros((N, N + 1)), *GATES)
    carried = (np.zeros(N), np.zeros(N), np.zeros(1))
    for _ in range(seen):
        supervised_levels(
            model, tuple(MotorRules()), past, np.zeros((4, N, FEATURES)), resting, np.array(SCALES), carried, scores
        )
    return scores.reshape(len(SCALES), N)


def test_a_tension_twice_those_of_the_others_is_rather_a_scale_of_two_than_any_other() -> None:
    found = levels([6.0, 3.0, 3.0])
    assert SCALES[0] == 2.0
    # Beyond sight a fault counts for `sight` standard deviations: 3^2 / 2.
    assert found[0, 0] == pytest.approx(4.5)
    # The others look small beside it, which is less likely: a third of its score, 4.5 (2 r/f - 1) at r/f = 2/3.
    assert np.max(found.ravel()[1:]) == pytest.approx(1.5)
    assert (levels([3.0, 3.0, 3.0]) < 0.0).all()
    assert levels([1.5, 3.0, 3.0])[1, 0] == pytest.approx(4.5)
    assert levels([4.0, 4.0, 4.0], share=0.5)[0] == pytest.approx(4.5)
    # Behind is a motor by where it is, not by where it was.
    assert levels([6.0, 3.0, 3.0], before=2.0 * REACH)[0, 0] == pytest.approx(4.5)


@pytest.mark.parametrize(
    "scores",
    [
        lambda: levels([6.0, 3.0, 3.0], behind=1.1 * REACH),
        lambda: levels([6.0, 3.0, 3.0], rest=0),
        lambda: levels([6.0, 3.0, 3.0], rest=2),
        lambda: levels([0.96 * TOP, 4.8, 4.8]),
        # The others say 1.4 N, which is not well above what may hang.
        lambda: levels([2.8, 1.4, 1.4]),
        # A tenth of 500 cycles is what a mean needs at least.
        lambda: levels([6.0, 3.0, 3.0], seen=49),
    ],
    ids=["far behind", "its tendon hung", "another one hung", "at the limit", "near hanging", "too soon"],
)
def test_levels_are_forgotten_where_they_say_nothing(scores: Callable[[], np.ndarray]) -> None:
    assert scores()[0, 0] == SUPERVISED_NOT


def test_what_is_carried_is_the_mean_of_all_cycles_and_then_of_the_last() -> None:
    rng = np.random.default_rng(0)
    off, load, counted = rng.standard_normal((200, N)), np.zeros(N), np.zeros(1)
    for k, row in enumerate(off):
        supervised_load(row, load, counted, 50.0)
        if k < 50:
            # Only rounding is left.
            np.testing.assert_allclose(load, off[: k + 1].mean(axis=0), atol=1e-14)
    expected = off[:50].mean(axis=0)
    for row in off[50:]:
        expected = expected + (row - expected) / 50.0
    np.testing.assert_allclose(load, expected, atol=1e-14)


def test_where_the_others_may_not_be_believed_nothing_is_learnt_of_the_load() -> None:
    """A payload is told by taut tendons alone: a mean that took hanging ones in would be of a heavier one."""
    charts = MotorCharts(baseline())
    tensions, places = np.array([2.0, 2.0, 2.0]), np.array([0.3, -0.2, 0.1])
    for _ in range(100):
        charts.step(places, places, tensions)
    before = charts._load[1].copy()
    # All of them gave the same: the mean is that.
    load = np.array(baseline().load)
    np.testing.assert_allclose(before, 2.0 - load[:, N] - load[:, :N] @ places, atol=1e-12)
    for bad in ([2.0, 2.0, 0.5], [2.0, 2.0, 99.0]):
        charts.step(places, places, np.array(bad))
    assert np.array_equal(charts._load[1], before)


@pytest.mark.parametrize(
    ("tensions", "known"), [((2.0, 2.0, 2.0), True), ((1.3, 1.3, 1.3), False), ((2.6, 1.3, 1.3), True)]
)
def test_a_load_is_unknown_where_all_tendons_say_so(tensions: tuple[float, ...], known: bool) -> None:
    """At rest all hold 2.8 N on the paper's neck, and about 1 N less with 0.5 kg, the most of its experiments."""
    charts = MotorCharts(baseline())
    for _ in range(100):
        charts.step(np.zeros(N), np.zeros(N), np.array(tensions))
    assert charts.known_load is known
    assert (charts.scores[2 * N :] == SUPERVISED_NOT).all() == (not known)


def changes(tension: float, *, moved: float = 0.0, fastest: float = 0.5, behind: float = 0.0) -> np.ndarray:
    """Return scores (kinds, motors) where the tension of motor 1 rose by 2 N and should have by 1 N."""
    place = np.zeros((4, N, FEATURES))
    place[0, 0, 0] = 1.0
    current = np.zeros((N, FEATURES))
    current[:, 0] = 1.0
    pulls = np.full((4, N), 3.0)
    pulls[:, 0] = [tension, tension - 2.0, tension - 2.0, tension - 2.0]
    positions = np.zeros((5, N))
    positions[0] = moved
    # Without regressors for its steps a motor is expected to stand.
    spread = np.tile([1e-4, 0.0], (N, 1))
    model = (np.zeros((N, 12)), spread, np.full(N, fastest), current, spread, *GATES)
    past = (np.full((12, N), behind) + positions[0], positions, pulls)
    white = (np.zeros((0, N)), np.zeros((0, 3, N)), np.zeros((3, N)))
    scores = np.full(4 * N, np.nan)
    supervised_motors(model, tuple(MotorRules()), past, place, white, np.full(N, -1.0), np.array(SCALES), 0.01, scores)
    return scores.reshape(4, N)


def test_a_change_twice_as_large_speaks_of_its_scale_but_not_at_the_limit_nor_where_tendons_hang() -> None:
    # f^2 / 2 at three standard deviations, less what passes for right: a tenth of 3^2.
    assert changes(5.0)[2, 0] == pytest.approx(4.5 - 0.9)
    assert changes(5.0)[3, 0] < 0.0
    assert (changes(5.0)[2:, 1:] == 0.0).all()
    for quiet in (changes(0.98 * TOP), changes(0.9 * SLACK), changes(5.0, behind=1.1 * REACH)):
        assert (quiet[2:] == 0.0).all()


def test_only_what_is_faster_than_ever_is_a_jump() -> None:
    assert changes(5.0, moved=0.6)[1, 0] == pytest.approx(60.0 - MotorRules().usual)
    assert changes(5.0, moved=0.4)[1, 0] == -MotorRules().usual


def test_a_jam_is_judged_by_the_way_that_was_left_before_the_cycle() -> None:
    """Motor 1 had 0.1 rad to go, of which it goes the tenth: it stands instead."""
    positions = np.zeros((5, N))
    positions[2:] = 5.0
    drive = np.zeros((N, 12))
    drive[:, 0] = 0.1
    spread = np.tile([1.6e-5, 0.0], (N, 1))
    model = (drive, spread, np.full(N, 0.5), np.zeros((N, FEATURES)), spread, *GATES)
    past = (np.full((12, N), 0.1), positions, np.full((4, N), 3.0))
    white = (np.zeros((0, N)), np.zeros((0, 3, N)), np.zeros((3, N)))
    scores = np.full(4 * N, np.nan)
    place = np.zeros((4, N, FEATURES))
    supervised_motors(model, tuple(MotorRules()), past, place, white, np.full(N, -1.0), np.array(SCALES), 0.01, scores)
    # 0.01 rad is 2.5 standard deviations: f^2 / 2.
    assert scores[:N] == pytest.approx([3.125] * N)


def test_a_motor_that_turns_is_not_jammed() -> None:
    assert changes(5.0, moved=0.001)[0, 0] == SUPERVISED_NOT
    assert changes(5.0)[0, 0] == 0.0


@pytest.mark.parametrize(
    ("follows", "name"), [(1.0, "encoder_slip"), (0.6, "encoder_slip"), (0.4, "position_bad"), (0.0, "position_bad")]
)
def test_a_jump_is_a_slip_where_the_drive_leads_its_winch_back(follows: float, name: str) -> None:
    """A motor that stands jumps by 1 rad, and goes the part `follows` of the way that its model expects."""
    charts = MotorCharts(baseline())
    back = -float(np.array(baseline().drive)[0].sum())
    P, T = np.zeros(3), np.full(3, 2.0)
    for _ in range(30):
        assert charts.step(np.zeros(3), P, T) is None
    P = P + np.array([1.0, 0.0, 0.0])
    assert charts.step(np.zeros(3), P, T) is None
    assert charts.judging
    found = None
    while found is None:
        P = P + np.array([follows * back * P[0], 0.0, 0.0])
        found = charts.step(np.zeros(3), P, T)
    assert found[:2] == (name, 0)


def test_a_number_that_came_back_was_no_slip() -> None:
    charts = MotorCharts(baseline())
    P, T = np.zeros(3), np.full(3, 2.0)
    for _ in range(30):
        charts.step(np.zeros(3), P, T)
    charts.step(np.zeros(3), P + np.array([1.0, 0.0, 0.0]), T)
    found = charts.step(np.zeros(3), P, T)
    assert found is not None
    assert found[:2] == ("position_bad", 0)


def test_a_drift_does_not_become_the_gyros_bias() -> None:
    """A bias from the start is averaged away; the same rate from 10 s on stands in the level for the next 4 s."""
    step, rate = 0.02, np.radians(0.5)
    for begin, expected in ((0.0, 0.0), (10.0, 1.0)):
        level, known = GyroLevel(1, step), False
        for k in range(round(12.0 / step)):
            known = level.take(np.array([rate * max(0.0, k * step - begin)]), np.zeros(1))
        assert known
        # 2 s of drift, of which a sixth of the time's part leaks away: 6 (1 - e^(-2/6)) = 1.70 s are left.
        assert np.degrees(level.level[0]) == pytest.approx(expected * 0.5 * 1.70, abs=0.02)


def test_the_gyros_bias_is_the_mean_of_what_is_old_enough() -> None:
    """Of the older half of what came, or of all but its last 4 s, as long as that is less than 15 s."""
    changes = 1e-3 * np.random.default_rng(0).standard_normal(900)
    level = GyroLevel(1, 0.02)
    for count, value in enumerate(np.cumsum(changes)):
        level.take(np.array([value]), np.zeros(1))
        old = count - min(count // 2, 200)
        if count > 1:
            np.testing.assert_allclose(level._bias, changes[1 : 1 + old].mean(), atol=1e-15)


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_each_fault_is_what_it_makes_of_the_tilt(outputs: int) -> None:
    """What an inclinometer would say with the fault less what it should, for each name of the list."""
    rng, gears = np.random.default_rng(outputs), np.array([2.0, 0.5])
    parts, began = rng.standard_normal((2, N, outputs))
    residual, late, stuck = rng.standard_normal((3, outputs))
    angle, moved = parts.sum(axis=0), (parts - began).sum(axis=0)
    names = tilt_names(N, outputs, gyro=False)[: -2 * outputs]
    raw = np.full((1 + len(names), outputs), np.nan)
    offset = next(size for name, _, size in names if name == "tilt_unexplained")
    supervised_faults(gears, offset, (residual, parts, began, late, stuck), raw)
    for row, (name, k, size) in zip(raw[1:], names, strict=True):
        said = angle.copy()
        if name == "gear_wrong":
            said += (size - 1.0) * (moved if k < 0 else parts[k] - began[k])
        elif name == "sensor_stuck":
            said[k] = stuck[k]
        elif name == "sensor_reversed":
            said[k] -= 2.0 * moved[k]
        elif name == "sensor_swapped":
            said[[k, k + 1]] += moved[[k + 1, k]] - moved[[k, k + 1]]
        elif name == "sensor_late":
            said = late
        else:
            said[k] += size
        np.testing.assert_allclose(row, said - angle, atol=1e-14, err_msg=name)
    assert np.array_equal(raw[0], residual)


def test_the_tilts_model_is_linear_from_nothing() -> None:
    model = TiltModel(np.array(baseline().tilt), baseline().lags, N)
    assert not model.step(np.zeros(N)).any()


def test_a_late_sensor_says_what_was_a_fifth_of_a_second_before() -> None:
    charts = TiltCharts(baseline())
    assert not charts.valid
    model, angles = TiltModel(np.array(baseline().tilt), baseline().lags, N), []
    for k in range(40):
        places = np.full(N, 0.01 * k)
        places[0] = 0.0
        angles.append(model.step(places).sum(axis=0))
        charts.step(places, np.full(N, 3.0), np.zeros(2), np.zeros(2))
    np.testing.assert_allclose(charts._angles[0], angles[-1 - round(0.2 / 0.02)], atol=1e-12)


def test_without_a_gyro_that_knows_its_bias_a_push_is_not_called_a_drift() -> None:
    charts = TiltCharts(baseline())
    names = [name for name, _, _ in charts.names]
    push = names.index("tilt_unexplained")
    charts.charts.sums[push] = 1.1 * charts.charts.thresholds[push]
    charts._explained[push] = charts._information[push] = 100.0
    assert not charts.gyro.known
    assert charts.likeliest() == (push, pytest.approx(50.0))


@pytest.mark.parametrize(
    ("name", "number", "size", "said"),
    [
        ("gear_wrong", 1, 2.0, "motor 2: the tilt moves as if the winch turned 2 times as far"),
        ("gear_wrong", -1, 0.5, "all motors: the tilt moves as if the winch turned 0.5 times as far"),
        ("sensor_late", -1, 0.2, "the tilt follows about 0.2 s later than it did"),
        ("sensor_noise", 0, 0.04, "output 1: its noise is a fifth of what it was, or beyond"),
        ("sensor_noise", 1, 25.0, "output 2: its noise is five times what it was, or beyond"),
        ("sensor_drift", 1, 0.026, "output 2: tilt less model 1.0, -2.0 deg"),
    ],
)
def test_what_is_found_is_said_in_words(name: str, number: int, size: float, said: str) -> None:
    charts = Plausibility(baseline())
    charts.tilt.residual = np.radians([1.0, -2.0])
    assert charts._describe(name, number, size) == said


@pytest.mark.parametrize(("chart", "said"), [(0, "motor 1 at 0.25 rad, set-point 0.50 rad"),
                                             (2 * N + 1, "motor 2: its current is about 2 times what its motion takes"),
                                             (3 * N, "motor 1: its current is about 0.5 times")])  # fmt: skip
def test_what_a_motor_shows_is_said_in_words(chart: int, said: str) -> None:
    charts = MotorCharts(baseline())
    setpoints, places, pulls = np.full(N, 0.5), np.full(N, 0.25), np.full(N, 2.0)
    for _ in range(30):
        charts.charts.sums[:] = 0.0
        charts.step(setpoints, places, pulls)
    charts.charts.sums[:] = 0.0
    charts.charts.sums[chart] = 1e9
    found = charts.step(setpoints, places, pulls)
    assert found is not None
    assert found[2].startswith(said)


def test_the_likeliest_fault_leads_the_next_of_another_name() -> None:
    """One gear or the other is the same news: both must not keep the supervisor waiting."""
    charts = TiltCharts(baseline())
    names = [name for name, _, _ in charts.names]
    stuck = names.index("sensor_stuck")
    assert names[0] == names[1] == "gear_wrong"
    charts.charts.sums[[0, 1, stuck]] = 1.1 * charts.charts.thresholds[[0, 1, stuck]]
    # Each of its own size: a gain of half of what it explains.
    charts._explained[[0, 1, stuck]] = charts._information[[0, 1, stuck]] = 100.0, 90.0, 40.0
    assert charts.likeliest() == (0, pytest.approx(30.0))


def test_the_variance_of_the_tilt_is_that_of_what_the_whitening_leaves() -> None:
    rng, rows, lags = np.random.default_rng(0), 4000, (0, 1, 2)
    noise = 0.01 * rng.standard_normal((rows, 2))
    correlated = noise.copy()
    for k in range(1, rows):
        correlated[k] += 0.5 * correlated[k - 1]
    all_good = np.ones(rows, dtype=bool)
    samples = [_Samples(np.zeros((rows, N)), correlated, np.zeros((rows, 2)), all_good, all_good)]
    _, spread = _tilt_noise(samples, [correlated], [all_good], np.zeros((2, len(lags) * N)), lags, N)
    # Of 4,000 rows a variance is known to 2.2 %; four times that.
    np.testing.assert_allclose([row[0] for row in spread], 1e-4, rtol=0.09)


def carrying(payload: float, rng: np.random.Generator, rows: int = 4000) -> Motion:
    """Return motion of tendons that share a payload [N], with friction that changes about every 20 cycles."""
    time = 0.01 * np.arange(rows)
    places = np.column_stack([np.sin(pace * time) for pace in rng.uniform(0.5, 3.0, N)])
    friction = 0.3 * np.repeat(rng.standard_normal((rows // 20, N)), 20, axis=0)
    tensions = 4.0 + places @ (0.2 + 0.5 * np.eye(N)) - payload + friction
    none = np.zeros((rows, 2))
    return Motion(
        setpoints=places, positions=places, tensions=tensions, values=none, rates=none, due=np.ones(rows, bool)
    )


def test_a_payload_counts_in_full_for_each_tension_whatever_friction_does() -> None:
    """By what the others hold at the moment, friction with it, it counted for 0.6 on the paper's neck."""
    rng = np.random.default_rng(0)
    motions = [carrying(payload, rng) for payload in (0.0, 1.5)]
    known = [(motion, features_of(motion, 0.01)) for motion in motions]
    load, seen, level, spread = level_rows(known, np.full(N, 0.5), np.full(N, 20.0), np.full(N, 9.0))
    # A mean of 25 blocks of friction, and at first of fewer, is good to 0.1 N of 0.75.
    np.testing.assert_allclose([row[-2] for row in level], 1.0, atol=0.1)
    np.testing.assert_allclose([row[:-1] for row in load], 0.2 + 0.25 * (1.0 - np.eye(N)), atol=0.1)
    np.testing.assert_allclose(seen, (-0.75, 0.75), atol=0.35)
    # That of the friction, 0.09 N^2, and a little of the mean's.
    assert all(0.07 < one < 0.12 for one in spread)


def test_the_load_of_the_experiments_is_what_no_tension_alone_says() -> None:
    """A tension that is 1 N off, by a wrong scale or its own friction, is in the loads of the others only."""
    rng = np.random.default_rng(0)
    motions = [carrying(0.0, rng), carrying(0.0, rng)]
    motions[1].tensions[:, 0] -= 2.0
    known = [(motion, features_of(motion, 0.01)) for motion in motions]
    _, seen, _, _ = level_rows(known, np.full(N, 0.5), np.full(N, 20.0), np.full(N, 9.0))
    # Half of 2 N each, half of it to either side; motor 1 says that nothing changed. The mean's own error as above.
    np.testing.assert_allclose(seen, (0.0, 0.5), atol=0.2)


def test_the_load_is_that_of_the_last_seconds() -> None:
    motion = carrying(0.0, np.random.default_rng(0))
    motion.tensions[2000:] -= 1.5
    known = [(motion, features_of(motion, 0.01))]
    _, seen, _, _ = level_rows(known, np.full(N, 0.5), np.full(N, 20.0), np.full(N, 9.0))
    # A mean over all would end where it began to fall, at nothing.
    np.testing.assert_allclose(seen, (-0.75, 0.75), atol=0.25)


def test_tendons_that_hang_all_the_time_have_no_level() -> None:
    known, limits = carrying(0.0, np.random.default_rng(4), rows=400), (np.full(N, 9.0), np.full(N, 99.0))
    load, _, rows, spread = level_rows([(known, features_of(known, 0.01))], *limits, np.full(N, 9.0))
    assert not np.any(load)
    assert not np.any(rows)
    assert spread == (1.0,) * N


def test_known_ground_ends_a_fifth_beyond_the_loads_of_the_experiments() -> None:
    rng = np.random.default_rng(0)
    motions = [carrying(payload, rng) for payload in (0.0, 1.5)]
    for motion in motions:
        motion.values[:] = 0.01 * rng.standard_normal(motion.values.shape)
    known = [(motion, features_of(motion, 0.01)) for motion in motions]
    # 0.75 N to either side, the mean's own error, and a fifth of 1.5 N.
    assert fit(known, cycle=0.01, sample_cycles=1, slack=0.5).load_low == pytest.approx(-1.05, abs=0.3)


def test_a_single_tension_is_compared_with_nothing() -> None:
    motion = carrying(0.0, np.random.default_rng(0), 200)
    one = {name: getattr(motion, name)[:, :1] for name in ("setpoints", "positions", "tensions")}
    alone = Motion(**one, values=motion.values, rates=motion.rates, due=motion.due)
    known = [(alone, features_of(alone, 0.01))]
    _, seen, level, _ = level_rows(known, np.full(1, 0.5), np.full(1, 20.0), np.full(1, 9.0))
    assert seen == (0.0, 0.0)
    assert not np.any(level)


def test_beyond_the_load_of_the_experiments_the_tilt_is_not_on_known_ground() -> None:
    charts = TiltCharts(baseline())
    for known, off in (
        (True, ""),
        (False, "more is carried than in the experiments: tilt, tracking and currents rest"),
    ):
        for _ in range(100):
            charts.step(np.zeros(N), np.full(N, 3.0), np.zeros(2), np.zeros(2), known_load=known)
        assert (charts.valid, charts.off) == (known, off)


def test_a_rest_is_said_once_it_lasts_and_again_only_after_as_long_a_watch() -> None:
    charts, samples = Plausibility(baseline()), round(5.0 / 0.02)

    def said(valid: bool, count: int) -> int:
        charts.tilt.valid, charts.tilt.off = valid, "" if valid else "a tendon may hang"
        told = 0
        for _ in range(count):
            charts._count_rest()
            told += charts.rests == "a tendon may hang"
        return told

    assert said(False, samples - 1) == 0
    assert said(False, 1) == 1
    assert said(False, 3 * samples) == 0
    # A short watch between is none.
    assert said(True, samples - 1) == said(False, 3 * samples) == 0
    assert said(True, samples) == 0
    assert said(False, samples) == 1


@pytest.mark.parametrize(("name", "after"), [("astray", 0.1), ("current_scale", 0.3)])
def test_what_speaks_alone_is_named_when_it_is_ripe(name: str, after: float) -> None:
    """Whatever goes wrong takes another current: its scale waits for others to speak, a loop astray does not."""
    charts = Plausibility(baseline())
    charts._current, charts._since = Finding(name, -1, ""), 0
    while charts._ripe() is None:
        charts._now += 1
    assert charts._now * 0.01 == pytest.approx(after)


def test_the_tilt_rests_where_all_tendons_carry_more() -> None:
    charts = Plausibility(baseline())
    for _ in range(100):
        charts.cycle((0.0,) * N, (0.0,) * N, (1.3,) * N)
        charts.sample((0.0,) * N, (0.0, 0.0), (0.0, 0.0))
    assert charts.tilt.off.startswith("more is carried than in the experiments")
