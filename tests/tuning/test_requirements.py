"""What is asked of a tuning: the requirements of `verify` and its own, and what is refused before anything is tried."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest
import tomli_w
from scipy.signal import lfilter

from softneck.core import FileFormatError, SettingsError
from softneck.design import axis_test
from softneck.estimation import LinearNeck
from softneck.loop.default_limits import NECK_RISE_S
from softneck.report._tune import _toml_table
from softneck.robot import TIME_CONSTANT, Robot
from softneck.tuning import _requirements
from softneck.tuning._requirements import (
    _TRACK_NUMBERS,
    USUAL_RISE,
    _refuse_load,
    check_feasibility,
    default_rise,
    fastest_rise,
    make_tune_requirements,
    read_tune_requirements,
)
from softneck.tuning._task import _closer
from softneck.tuning._tune import task_of
from softneck.verification import Requirement, make_requirements, read_requirements
from softneck.verification._metrics import Scale

from ..design.test_robots import BELLOWS, LEARNED, plant

TS = 0.02
GAIN, POLE, DELAY = math.radians(5.23), 5.293, 4


def neck(delay: int = DELAY) -> LinearNeck:
    a = math.exp(-POLE * TS)
    tf = control.TransferFunction([GAIN * (1 - a)], [1.0, -a, *[0.0] * delay], TS)
    return LinearNeck(pitch=tf, roll=tf)


def test_the_defaults_are_those_of_verify_with_what_tuning_adds() -> None:
    asked = make_tune_requirements({})
    theirs = {(b.metric, b.bound): b.limit for b in make_requirements({}).bounds}
    mine = {(b.metric, b.bound): b.limit for b in asked.bounds}
    assert set(theirs) <= set(mine)
    changed = {key for key in theirs if theirs[key] != mine[key]}
    assert changed == {("sim.overshoot_pct", "max"), ("sim.steady_rms_deg", "max")}
    assert (asked.robot_limit("sim.rise_s"), asked.robot_limit("track.ahead_rms_deg")) == (NECK_RISE_S, 1.5)


def test_a_reserve_is_taken_off_what_plants_must_keep_and_said() -> None:
    table = {"require": {"sim.rise_s": {"max": 0.5}}, "reserve": {"sim.rise_s": 0.1, "track.ahead_rms_deg": 0.0}}
    asked = make_tune_requirements(table)
    assert (asked.limit("sim.rise_s"), asked.robot_limit("sim.rise_s")) == (0.4, 0.5)
    assert asked.limit("track.ahead_rms_deg") == asked.robot_limit("track.ahead_rms_deg") == 1.5
    assert {"sim.rise_s <= 0.4 (0.5 less a reserve of 0.1)", "track.ahead_rms_deg <= 1.5"} <= set(asked.lines())
    # What verify is asked is what the plants must keep.
    assert asked.certificate.bounds == tuple(b for b in asked.bounds if not b.metric.startswith("track."))


def test_where_draws_decide_the_search_alone_stays_below_the_default_limit() -> None:
    drawn, known = make_tune_requirements({}, drawn=True), make_tune_requirements({})
    assert not drawn.reserve
    assert drawn.kept == {**known.reserve, "axes.gain_margin": 0.2}
    assert drawn.limit("sim.overshoot_pct") == known.robot_limit("sim.overshoot_pct")
    task = task_of({"n": neck()}, {}, 0)
    seen = replace(task, asked=drawn)
    aims, limits = ({b.metric: b.limit for b in bounds} for bounds in (seen.aims, seen.bounds))
    assert aims["sim.overshoot_pct"] == pytest.approx(known.limit("sim.overshoot_pct"))
    assert aims["axes.gain_margin"] == limits["axes.gain_margin"] + 0.2
    assert {name for name, limit in aims.items() if limit != limits[name]} == set(drawn.kept)
    assert replace(task, asked=known).aims == replace(task, asked=known).bounds == replace(task, asked=known).final_aims
    # Final candidates have seen as many draws as a certificate has: half as much is kept.
    final = {b.metric: b.limit for b in seen.final_aims}
    assert final == pytest.approx({name: 0.5 * (limits[name] + aims[name]) for name in limits})
    # A reserve of one's own is taken off all limits, as without draws; a limit below it is aimed at itself.
    own = {"reserve": {"sim.overshoot_pct": 1.0}}
    assert make_tune_requirements(own, drawn=True).bounds == make_tune_requirements(own).bounds
    tight = make_tune_requirements({"require": {"sim.overshoot_pct": {"max": 1.0}}}, drawn=True)
    assert {b.limit for b in replace(task, asked=tight).aims if b.metric == "sim.overshoot_pct"} == {1.0}


@pytest.mark.parametrize(("most", "below"), [(0.5, 0.3), (0.3, 0.5)])
def test_of_two_upper_limits_the_lower_one_counts_and_a_lower_bound_is_none(most: float, below: float) -> None:
    asked = make_tune_requirements({"require": {"sim.rise_s": {"min": 0.1, "max": most, "below": below}}})
    assert asked.limit("sim.rise_s") == asked.robot_limit("sim.rise_s") == 0.3
    assert {f"sim.rise_s >= 0.1, <= {most:g}, < {below:g}"} == {
        "sim.rise_s " + ", ".join(line.partition(" ")[2] for line in asked.lines() if line.startswith("sim.rise_s "))
    }
    assert asked.limit("axes.gain_margin") is None


@pytest.mark.parametrize("limit", [1.6, 1.7, 1.5])
def test_what_a_search_keeps_of_a_limit_leaves_some_of_it(limit: float) -> None:
    most, least = (_closer(Requirement("m", bound, limit, True), 1.6).limit for bound in ("max", "min"))
    assert most == (pytest.approx(0.1) if limit > 1.6 else limit)
    assert least == limit + 1.6


def test_nothing_is_kept_back_of_what_is_not_asked() -> None:
    asked = make_tune_requirements({"require": {"sim.rise_s": False}, "reserve": {"sim.rise_s": 0.1}})
    assert "sim.rise_s" not in asked.reserve
    assert asked.limit("sim.rise_s") is None
    # Linear plants have no loops of which anything was found to be beyond.
    assert not make_tune_requirements({}, stepping=False).reserve


@pytest.mark.parametrize("stepping", [True, False])
def test_what_is_written_asks_tune_and_verify_for_the_same_again(tmp_path: Path, stepping: bool) -> None:
    table = {
        "require": {"sim.rise_s": {"max": 0.5}, "track.ahead_rms_deg": False, "axes.gain_margin": {"min": 2.1}},
        "reserve": {"sim.rise_s": 0.07}, "track": {"noise_deg": 0.1}, "step": {"duration_s": 5.0},
    }  # fmt: skip
    asked = make_tune_requirements(table, stepping=stepping)
    path = tmp_path / "requirements.toml"
    path.write_text(tomli_w.dumps(_toml_table(asked.table)))
    # Limits are as they were asked, the reserve is beside them.
    written = tomllib.loads(path.read_text())
    assert written["require"]["sim.rise_s"] == {"max": 0.5}
    assert written["reserve"]["sim.rise_s"] == 0.07
    again = read_tune_requirements(path, stepping=stepping)
    assert (again.bounds, again.track, again.reserve) == (asked.bounds, asked.track, asked.reserve)
    assert again.lines() == asked.lines()
    theirs = read_requirements(path)
    assert theirs.bounds == asked.certificate.bounds
    assert theirs.at(Scale.of(Robot.preset("antagonist"))).own == theirs.own
    for name in ("uncertainty", "sampling", "step", "sim"):
        assert getattr(theirs, name) == getattr(asked.certificate, name) == getattr(again.certificate, name)
    assert asked.limit("track.ahead_rms_deg") is None


def test_without_a_plant_that_steps_the_linear_ones_are_asked() -> None:
    asked = make_tune_requirements({}, stepping=False)
    assert asked.limit("step.rise_s") == NECK_RISE_S
    assert asked.certificate.sim["necks"] == 0  # a built-in plant would decide nothing
    assert asked.limit("sim.rise_s") is None


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ({"track": {"circle": 3.0}}, "unknown key `circle`"),
        ({"track": {"circle_deg": -1.0}}, "must be between 0.1 and 40"),
        ({"track": {"noise_deg": True}}, "must be a number"),
        ({"require": {"track.lap_s": {"max": 1.0}}}, r"unknown metric `track.lap_s`"),
        ({"require": {"track.ahead_rms_deg": {"min": 1.0}}}, "must be"),
        ({"require": {"track.ahead_rms_deg": {"max": 0.0}}}, "with a positive number"),
        ({"reserve": {"axes.gain_margin": 0.1}}, "takes metrics of loops over simulation models"),
        ({"reserve": {"sim.rise_s": -0.1}}, "must be a number from 0 on; got -0.1"),
        ({"reserve": {"sim.rise_s": 0.49}}, "<= 0.49 is not above its safety margin of 0.49"),
        ({"require": {"sim.overshoot_pct": {"max": 0.0}}}, "<= 0 is not above its safety margin of 1.6"),
        ({"reserve": {"sim.ris_s": 0.1}}, r"which \[require\] does not limit"),
        ({"reserve": 1.0}, "must be a table"),
        ({"require": 1.0}, "must be a table"),
        ({"track": 1.0}, r"must be a table: \[track\]"),
        ({"require": {"sim.rise_s": {"min": 1.0, "max": 0.4}}}, "cannot be at least 1 and at most"),
        ({"require": {"sim.rise_s": {"min": 3.0}, "sim.settling_s": {"max": 2.0}}}, "cannot"),
    ],
)
def test_bad_requirements_are_refused_in_a_line(table: dict, match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        make_tune_requirements(table)


@pytest.mark.parametrize("key", _TRACK_NUMBERS)
def test_settings_of_the_additional_loops_have_their_range(key: str) -> None:
    low, high, _ = _TRACK_NUMBERS[key]
    assert (low, high) == {
        "small_part": (0.05, 1.0), "noise_deg": (0.0, 10.0), "delay_ms": (0.0, 1e9), "circle_deg": (0.1, 40.0),
        "circle_rad_s": (0.01, 20.0),
    }[key]  # fmt: skip
    for value in (low - 0.01 * high, low - 1e-9, math.nextafter(high, math.inf), math.nan, math.inf, -math.inf):
        with pytest.raises(SettingsError, match=key):
            make_tune_requirements({"track": {key: value}})


def test_a_file_says_what_differs(tmp_path: Path) -> None:
    path = tmp_path / "wanted.toml"
    path.write_text('version = 1\n[track]\ncircle_deg = 10.0\n[require]\n"sim.rise_s" = { max = 0.6 }\n')
    asked = read_tune_requirements(path)
    assert (asked.robot_limit("sim.rise_s"), asked.track["circle_deg"], asked.track["circle_rad_s"]) == (0.6, 10.0, 1.2)
    path.write_text("version = 2\n")
    with pytest.raises(FileFormatError, match="`version` must be 1"):
        read_tune_requirements(path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_tune_requirements(tmp_path / "none.toml")


def test_the_defaults_can_be_had() -> None:
    # The defaults of a file are those of a table: loops over simulation models, and no draws.
    read, made = read_tune_requirements(), make_tune_requirements({})
    assert (read.bounds, read.kept, read.reserve, read.table) == (made.bounds, made.kept, made.reserve, made.table)
    check_feasibility(make_tune_requirements({}), neck())


@pytest.mark.parametrize(("metric", "size"), [("sim.rise_s", 15.0), ("step.rise_s", 10.0)])
def test_a_rise_is_refused_exactly_where_the_motors_cannot_give_it(metric: str, size: float) -> None:
    least = least_rise_by_hand(math.radians(size))
    for factor in (0.95, 1.05):
        table = {"require": {"sim.rise_s": False, metric: {"max": least * factor}, "track.circle_rms_deg": False}}
        asked = make_tune_requirements(table | {"step": {"size_deg": 10.0}})
        if factor > 1.0:
            check_feasibility(asked, neck())
        else:
            with pytest.raises(SettingsError, match="within the motors' slew and range pitch's step"):
                check_feasibility(asked, neck())
    with pytest.raises(SettingsError, match="range does not reach"):
        check_feasibility(
            make_tune_requirements({"sim": {"size_deg": 45.0}}), LinearNeck(neck().pitch / 2, neck().roll)
        )


def test_a_circle_beyond_a_bandwidth_of_one_over_the_dead_time_is_refused() -> None:
    fastest = 1.0 / ((DELAY + 1) * TS)
    for part, limit, refused in ((1.01, 1.9, True), (1.01, 2.0, False), (0.99, 0.1, False)):
        table = {"require": {"track.circle_rms_deg": {"max": limit}},
                 "track": {"circle_deg": 2.0, "circle_rad_s": part * fastest}}  # fmt: skip
        asked = make_tune_requirements(table)
        if refused:
            with pytest.raises(SettingsError, match="dead time of pitch, 100 ms, allows, 10 rad/s"):
                check_feasibility(asked, neck())
        else:
            check_feasibility(asked, neck())


@pytest.mark.parametrize("turn", [2.0, 6.0])
def test_a_circle_is_refused_exactly_where_slew_and_range_leave_too_little_of_it(turn: float) -> None:
    # The input with most of the first harmonic, through the plant's own difference equation: a square wave of all the
    # range where that ends first, else a triangle of all the slew; of roll, whose motors go 0.577 of phi_i (Eq. 10).
    turn = 2.0 * math.pi / TS / round(2.0 * math.pi / TS / turn)  # whole samples a turn
    rows, a = round(2.0 * math.pi / TS / turn), math.exp(-POLE * TS)
    t = turn * TS * np.arange(20 * rows)
    square, triangle = np.sign(np.sin(t)), np.arcsin(np.sin(t))
    u = min(6.0 * square, 12.5 / turn * triangle, key=lambda wave: abs(np.exp(-1j * t) @ wave)) * math.sqrt(3.0)
    y = np.asarray(lfilter([0.0, 0.5 * GAIN * (1 - a)], [1.0, -a], u))[-rows:]
    harmonic = math.degrees(2.0 / rows * abs(np.exp(-1j * t[:rows]) @ y))
    size = 40.0
    # A triangle in samples has 2 % less at most.
    for limit, refused in (((size - 0.97 * harmonic) / math.sqrt(2.0), False),
                           ((size - 1.03 * harmonic) / math.sqrt(2.0), True)):  # fmt: skip
        table = {"require": {"track.circle_rms_deg": {"max": limit}, "track.ahead_rms_deg": False},
                 "track": {"circle_deg": size, "circle_rad_s": turn}}  # fmt: skip
        plant, asked = LinearNeck(pitch=neck().pitch, roll=0.5 * neck().roll), make_tune_requirements(table)
        if refused:
            with pytest.raises(SettingsError, match="within the motors' slew and range roll swings by"):
                check_feasibility(asked, plant)
        else:
            check_feasibility(asked, plant)


@pytest.mark.parametrize("group", ["sim", "step"])
@pytest.mark.parametrize(("rise", "settling", "refused"), [(0.5, 0.3, True), (0.3, 0.3, False), (0.5, 0.6, False)])
def test_what_may_rise_later_than_it_settles_is_refused(
    group: str, rise: float, settling: float, refused: bool
) -> None:
    table = {"require": {f"{group}.rise_s": {"max": rise}, f"{group}.settling_s": {"max": settling}}}
    if refused:
        with pytest.raises(SettingsError, match=r"a settled step has risen; require a rise of at most 0\.3 s"):
            check_feasibility(make_tune_requirements(table), neck())
    else:
        check_feasibility(make_tune_requirements(table), neck())


def test_a_slow_rise_beside_a_settling_that_nobody_asked_is_no_contradiction() -> None:
    check_feasibility(make_tune_requirements({"require": {"sim.rise_s": {"max": 3.0}}}), neck())


@pytest.mark.parametrize(("limit", "noise", "refused"), [(0.05, 0.06, True), (0.05, 0.04, False), (0.0, 0.05, True)])
def test_a_steady_state_quieter_than_the_sensor_is_refused(limit: float, noise: float, refused: bool) -> None:
    table = {"require": {"sim.steady_rms_deg": {"max": limit}}, "track": {"noise_deg": noise}}
    if refused:
        with pytest.raises(SettingsError, match="the sensor noise alone"):
            check_feasibility(make_tune_requirements(table), neck())
    else:
        check_feasibility(make_tune_requirements(table), neck())


def test_what_settles_before_it_can_rise_and_an_Ms_of_one_are_refused() -> None:
    for metric, limit, match in (("sim.settling_s", 0.05, "slew and range"), ("axes.sensitivity", 1.0, "no feedback"),
                                 ("roll.sensitivity", 1.0, "no feedback")):  # fmt: skip
        asked = make_tune_requirements({"require": {metric: {"max": limit}}})
        with pytest.raises(SettingsError, match=match):
            check_feasibility(asked, neck())


def test_what_is_not_asked_refuses_nothing() -> None:
    """A plant that no default could be met on, of which each refusal alone is asked for by turns."""
    slow = LinearNeck(pitch=axis(POLE, 60, 0.1 * GAIN), roll=axis(POLE, 60, 0.1 * GAIN))
    # Something must be asked for; mu depends on no plant.
    none = {item.metric: False for item in make_tune_requirements({}).bounds if item.metric != "robust.mu"}
    check_feasibility(make_tune_requirements({"require": none}), slow)
    for metric, limit in (("sim.rise_s", 0.5), ("sim.settling_s", 2.0), ("track.circle_rms_deg", 1.0),
                          ("track.ahead_rms_deg", 1.0), ("axes.sensitivity", 1.0), ("step.load_rms_deg", 0.01),
                          ("sim.steady_rms_deg", 0.01)):  # fmt: skip
        asked = make_tune_requirements({"require": none | {metric: {"max": limit}}})
        with pytest.raises(SettingsError, match=f"`{metric}`"):
            check_feasibility(asked, slow)


def test_a_load_rejected_within_the_dead_time_is_refused() -> None:
    asked = make_tune_requirements({"require": {"step.load_rms_deg": {"max": 0.02}}})
    with pytest.raises(SettingsError, match="dead time before any feedback acts"):
        check_feasibility(asked, neck())


@pytest.mark.parametrize(
    ("payload", "judged"), [(None, [0.32, 1.0]), (0.0, [0.0]), (0.5, [0.32, 0.5]), (2.0, [0.32, 1.0])]
)
def test_default_payloads_go_to_the_heaviest_recorded_one_and_stated_ones_stay(
    payload: float | None, judged: list[float]
) -> None:
    asked = make_tune_requirements({}, payload=payload)
    assert asked.certificate.sim["payloads_kg"] == judged
    # The file that `tune` writes asks `verify` for the same.
    assert make_tune_requirements(asked.table, payload=0.0).certificate.sim["payloads_kg"] == judged
    stated = make_tune_requirements({"sim": {"payloads_kg": [0.7]}}, payload=payload)
    assert stated.certificate.sim["payloads_kg"] == [0.7]
    assert ("sim.payloads_kg" in stated.stated, "sim.payloads_kg" in asked.stated) == (True, False)


def test_what_is_stated_is_what_a_table_limits_and_not_what_it_drops() -> None:
    require = {"sim.rise_s": {"max": 0.5}, "sim.settling_s": False, "track.circle_rms_deg": {"max": 4.0}}
    asked = make_tune_requirements({"require": require, "track": {"delay_ms": 7.0}, "sim": {"size_deg": 9.0}})
    assert asked.stated == {"sim.rise_s", "track.circle_rms_deg", "track.delay_ms", "sim.size_deg"}
    assert make_tune_requirements({}).stated == frozenset()
    # A metric is known by its name alone too.
    assert make_tune_requirements({"circle_rms_deg": 4.0}).stated == {"track.circle_rms_deg"}


@pytest.mark.parametrize(("delay", "rows"), [(0, 1), (4, 5), (50, 51), (150, 49), (199, 0), (300, 0)])
def test_a_load_moves_a_plant_for_its_dead_time_within_the_rows_that_are_judged(delay: int, rows: int) -> None:
    """Of 200 rows, those from the dead time to another one later, each by the gain times the load."""
    gain, load = 0.1, 0.5
    plant: Any = SimpleNamespace(sample_time=TS, delay=delay, numerator=np.array([gain]), denominator=np.array([1.0]))
    least = math.degrees(gain * load) * math.sqrt(rows / 200)
    for limit in (1.001 * least, 0.999 * least):
        asked = replace(make_tune_requirements({}), certificate=make_requirements({"step": {"load_rad": load}}))
        asked = replace(asked, bounds=(Requirement("step.load_rms_deg", "max", limit, True),))
        with nullcontext() if limit >= least else pytest.raises(SettingsError, match="dead time before any feedback"):
            _refuse_load(asked, "pitch", plant)


def test_settling_is_judged_by_the_sensor_up_to_the_noise_that_fits_the_band() -> None:
    """Four standard deviations within 5 % of the step, the limit itself included; a NaN shows nothing."""
    for noise, size, part, shown in ((0.125, 10.0, 1.0, True), (0.1250001, 10.0, 1.0, False), (0.0625, 10.0, 0.5, True),
                                     (0.0625001, 10.0, 0.5, False), (math.nan, 10.0, 1.0, False)):  # fmt: skip
        found = make_tune_requirements({"sim": {"size_deg": size}})
        asked = replace(found, track={**found.track, "noise_deg": noise})
        assert asked.shows_settling(part) == shown
        assert part != 1.0 or asked.shows_settling() == shown


def axis(pole: float, delay: int = DELAY, gain: float = GAIN) -> control.TransferFunction:
    a = math.exp(-pole * TS)
    return control.TransferFunction([gain * (1 - a)], [1.0, -a, *[0.0] * delay], TS)


def least_rise_by_hand(size: float) -> float:
    """All the slew there is until the range ends, through the plant's own difference equation.

    0.25 rad a sample of a motor is 0.375 of theta_i (Eq. 9), 6 rad 9; what a sample takes is told apart.
    """
    a, y, u, rows = math.exp(-POLE * TS), 0.0, 0.0, []
    for _ in range(400):
        rows.append(y / size)
        u = min(u + 0.375, 9.0)
        y = a * y + GAIN * (1 - a) * u
    low, high = (np.interp(level, rows, np.arange(400) * TS) for level in (0.1, 0.9))
    return float(high - low)


def test_the_fastest_rise_is_that_of_the_slowest_axis_that_the_motors_move_far_enough() -> None:
    # The step of designs: 10 deg.
    assert fastest_rise(neck()) == pytest.approx(least_rise_by_hand(math.radians(10.0)), rel=1e-9)
    slow, quick, weak, none = axis(1.0), axis(POLE), axis(POLE, gain=0.4 * GAIN), axis(POLE, gain=0.1 * GAIN)
    both = fastest_rise(LinearNeck(pitch=slow, roll=slow))
    assert both > 1.5 * fastest_rise(neck())
    for one, other in ((slow, quick), (quick, slow), (none, slow), (slow, none)):
        assert fastest_rise(LinearNeck(pitch=one, roll=other)) == both
    assert fastest_rise(LinearNeck(pitch=weak, roll=quick)) > 1.5 * fastest_rise(neck())
    assert fastest_rise(LinearNeck(pitch=none, roll=none)) == 0.0


def test_the_motors_limits_are_those_of_the_inputs_that_they_move(monkeypatch: pytest.MonkeyPatch) -> None:
    """A share of each motor in an input, not of an input in each motor: on a robot whose shares differ."""
    own, seen = plant(BELLOWS, gain=5e-8), list[Any]()
    monkeypatch.setattr(_requirements, "axis_test", lambda *given: seen.append(given[2]) or axis_test(*given))
    asked = task_of({"model": own}, {}, 0).asked
    seen.clear()
    for of in (fastest_rise, lambda own: default_rise([own], asked), lambda own: check_feasibility(asked, own)):
        of(own)
        assert len(seen) >= len(BELLOWS.outputs.names)
        for inverse in seen:
            np.testing.assert_allclose(LEARNED @ inverse[:, :3], np.eye(3), atol=1e-12)
        seen.clear()


def test_the_default_rise_is_that_of_the_slowest_axis() -> None:
    """Worse axes and plants never ask for a shorter rise, a quick robot is asked for the usual one, settling bounds."""
    asked = make_tune_requirements(
        {"sim": {"size_deg": 15.0, "duration_s": 60.0}, "require": {"sim.settling_s": {"max": 50.0}}}
    )

    def rise(pitch: float, roll: float, *, delay: int = DELAY, more: Sequence[float] = ()) -> float:
        plants = [LinearNeck(pitch=axis(pitch), roll=axis(roll, delay))]
        plants += [LinearNeck(pitch=axis(pole), roll=axis(pole)) for pole in more]
        found = default_rise(plants, asked)
        assert found is not None
        return found

    slow, quick = rise(1.0, 1.0), rise(POLE, POLE)
    assert slow > 1.4 * quick
    assert rise(1.0, POLE) == rise(POLE, 1.0) == slow
    late = [LinearNeck(pitch=axis(POLE), roll=axis(POLE)), LinearNeck(pitch=axis(POLE), roll=axis(POLE, 60))]
    assert default_rise(late, asked) == rise(POLE, POLE, delay=60) > quick
    # ln 9 dead times, with one sample of the loop, beside the motors' own; to hundredths of the robot's second.
    least = least_rise_by_hand(math.radians(15.0))
    for time in (1.0, 2.5):
        stretched = replace(asked, certificate=replace(asked.certificate, scale=Scale(time=time)))
        expected = time * round(least / time + math.log(9.0) * 61 * TS / time, 2)
        assert default_rise(late, stretched) == pytest.approx(expected, abs=1e-9)
    assert rise(POLE, POLE, more=(POLE,)) == quick
    assert rise(40.0, 40.0) >= USUAL_RISE * TIME_CONSTANT
    assert default_rise([LinearNeck(pitch=axis(POLE), roll=axis(POLE, gain=0.1 * GAIN))], asked) is None
    short = make_tune_requirements({"sim": {"size_deg": 15.0}, "require": {"sim.settling_s": {"max": 0.3}}})
    assert default_rise([LinearNeck(pitch=axis(1.0), roll=axis(1.0))], short) == short.robot_limit("sim.settling_s")
