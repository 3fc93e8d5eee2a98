"""What moves say is a pure function: scales, signs and mountings that explain them, and files that would be right."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import default_drives, load_drives
from softneck.drives.bus._read import drives_table, make_drives
from softneck.drives.bus._sensor_source import Axes, axes_of, inverse, said_of, to_robot_axes
from softneck.drives.commissioning._features import Features
from softneck.drives.commissioning._findings import (
    Finding,
    fatal,
    known_before,
    peak_of,
    require_answers,
    with_type_currents,
)
from softneck.drives.commissioning._identify import Identified, Scale, apply_findings, factors, identify
from softneck.drives.commissioning._mounting import Mounting, exchanges, explain, to_sensor_axes
from softneck.drives.commissioning._moves import WIGGLE
from softneck.drives.master import Tilt
from softneck.robot import Robot

from ...data import ROOT
from .planted import plant
from .toy import Toy, mover_of

TENDONS = np.array([[1.0, -0.5, -0.5], [0.0, math.sqrt(0.75), -math.sqrt(0.75)]])
STRAIGHT: Axes = ((0, 1.0), (1, 1.0))
AXES = [tuple(zip(order, signs, strict=True)) for order in itertools.permutations(range(2))
        for signs in itertools.product((1.0, -1.0), repeat=2)]  # fmt: skip
axes_strategy = st.permutations(range(3)).flatmap(
    lambda order: st.tuples(*[st.sampled_from([(number, 1.0), (number, -1.0)]) for number in order])
)


# -- mounting -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_what_explains_the_directions_gives_them_and_has_no_more_mistakes(order: tuple[int, ...], axes: Axes) -> None:
    """The truth itself may need more: a triangle turned over is three motors exchanged, or a sign."""
    truth = Mounting(order, axes, 0.0)
    measured = np.array([to_sensor_axes(TENDONS[:, order[j]], axes) for j in range(3)])
    found = explain(measured, TENDONS)
    assert found[0].mistakes <= truth.mistakes
    for one in found:
        again = np.array([to_sensor_axes(TENDONS[:, one.order[j]], one.axes) for j in range(3)])
        np.testing.assert_allclose(again, measured, atol=1e-12)


def test_only_a_reversed_roll_and_the_exchange_of_two_tendons_cannot_be_told_apart() -> None:
    for axes, order in [(((0, 1.0), (1, -1.0)), (0, 1, 2)), (STRAIGHT, (0, 2, 1))]:
        found = explain(np.array([to_sensor_axes(TENDONS[:, order[j]], axes) for j in range(3)]), TENDONS)
        assert {(one.order, one.axes) for one in found} == {((0, 2, 1), STRAIGHT), ((0, 1, 2), ((0, 1.0), (1, -1.0)))}
    for axes, order in [(((1, 1.0), (0, 1.0)), (0, 1, 2)), (((0, -1.0), (1, 1.0)), (0, 1, 2)), (STRAIGHT, (1, 0, 2)),
                        (STRAIGHT, (0, 1, 2))]:  # fmt: skip
        found = explain(np.array([to_sensor_axes(TENDONS[:, order[j]], axes) for j in range(3)]), TENDONS)
        assert [(one.order, one.axes) for one in found] == [(order, axes)]


@pytest.mark.parametrize("off", [-6.0, 6.0])
def test_directions_some_degrees_off_and_a_motor_that_was_not_seen_change_nothing(off: float) -> None:
    angle = math.radians(off)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    measured = np.array([turn @ TENDONS[:, j] for j in (1, 0, 2)])
    assert explain(measured, TENDONS)[0].order == (1, 0, 2)
    measured[2] = np.nan
    assert explain(measured, TENDONS)[0].order == (1, 0, 2)


def test_a_robot_of_six_motors_is_explained_without_trying_720_orders() -> None:
    angles = np.arange(6) * math.pi / 3.0
    tendons = np.array([np.cos(angles), np.sin(angles)])
    order = (0, 1, 3, 2, 4, 5)
    found = explain(np.array([tendons[:, k] for k in order]), tendons)
    assert (found[0].order, found[0].axes) == (order, STRAIGHT)


def test_exchanges_are_the_length_less_the_cycles() -> None:
    assert [exchanges(order) for order in ((0, 1, 2), (1, 0, 2), (1, 2, 0), (3, 2, 1, 0))] == [0, 1, 2, 2]


# -- scales ---------------------------------------------------------------------------------------------------------


@given(
    k=st.lists(st.sampled_from([0, 0, 1, -1]), min_size=3, max_size=3),
    common=st.floats(-0.25, 0.25),
    noise=st.lists(st.floats(-0.1, 0.1), min_size=3, max_size=3),
)
def test_powers_of_two_are_found_behind_a_neck_that_is_another_one(
    k: list[int], common: float, noise: list[float]
) -> None:  # fmt: skip
    """A neck 19 % off and motors 7 % off each other are what the two standard deviations were chosen for."""
    assert factors(np.array(k) + common + np.array(noise)).tolist() == [2.0**power for power in k]


def test_what_is_no_power_of_two_is_what_was_measured() -> None:
    found = factors(np.array([0.0, 0.0, 0.5]))
    assert found[:2].tolist() == [1.0, 1.0]
    assert found[2] == pytest.approx(2.0**0.5, rel=0.1)


def test_a_wiggle_that_drowns_is_named_and_not_guessed_from() -> None:
    """Its gear was nan times the file's."""
    moves = Toy().run(mover_of())
    one, rng = moves.motors[0], np.random.default_rng(0)
    outputs = one.outputs.copy()
    # Ten times the wiggle's own 0.25 deg.
    outputs[one.rows(WIGGLE)] = math.radians(2.5) * rng.standard_normal((int(one.rows(WIGGLE).sum()), 2))
    found = identify(replace(moves, motors=(replace(one, outputs=outputs), *moves.motors[1:])), default_drives(), None)
    assert [told.motors for told in found.findings if told.name == "unclear"] == [(1,)]
    assert found.scales[0] == Scale()


def test_a_poor_measurement_says_less() -> None:
    assert factors(np.array([0.0, 0.0, 0.45]), np.array([0.15, 0.15, 0.6])).tolist() == [1.0, 1.0, 1.0]


# -- files ----------------------------------------------------------------------------------------------------------


@given(axes_strategy)
def test_axes_back_and_forth_are_the_sample(axes: Axes) -> None:
    sample = to_robot_axes(Tilt(0.1, -0.2), ((0, 1.0), (1, 1.0)))
    names = ("a", "b", "c")
    assert axes_of(said_of(axes, names), names) == axes
    there = tuple(sign * (1.0, 2.0, 3.0)[number] for number, sign in inverse(axes))
    assert tuple(sign * there[number] for number, sign in axes) == (1.0, 2.0, 3.0)
    assert sample.values == (0.1, -0.2)


@pytest.mark.parametrize("axes", [["roll"], ["roll", "roll"], ["pitch", "yaw"], ["-pitch"], "roll", [1, 2]])
def test_axes_that_are_none_are_one_line(axes: Any) -> None:
    table = drives_table(default_drives())
    table["sensor"]["axes"] = axes
    with pytest.raises(SettingsError, match=r"\[sensor\] axes must"):
        make_drives(table)


def test_a_drives_file_comes_back_from_its_table(tmp_path: Path) -> None:
    example = load_drives(ROOT / "examples" / "drives" / "drives.toml")
    for file in (default_drives(), default_drives("ds402", sensor_axes=("-roll", "pitch")), example):
        assert make_drives(drives_table(file), tmp_path) == replace(file, sensor_source=make_drives(
            drives_table(file), tmp_path).sensor_source)  # fmt: skip
    python = make_drives(
        {**drives_table(default_drives()), "sensor": {"kind": "python", "python": "a:b", "options": {"x": 1}}}, tmp_path
    )
    assert make_drives(drives_table(python), tmp_path) == python


@pytest.mark.parametrize(
    "mistakes",
    [[], ["reversed:2"], ["exchanged:1:3"], ["gear:2:2"], ["lines:3:0.5"], ["current:1:2"], ["axes"], ["sign:pitch"],
     ["axes", "sign:roll"], ["exchanged:1:2", "gear:1:0.5", "sign:pitch"]],
)  # fmt: skip
def test_what_was_found_put_right_is_what_was_planted(mistakes: list[str]) -> None:
    """The way from a file to planted drives, and from all that is wrong of them back to a file, without a move."""
    file = default_drives()
    right = plant(file, mistakes).file
    names = file.moves.outputs.names
    order = tuple(next(k for k, made in enumerate(right.drives) if made.node == entry.node) for entry in file.drives)
    motors, scales = [], []
    for entry, k in zip(file.drives, order, strict=True):
        old, new = entry.scale, right.drives[k].scale
        motors.append(_features(pull=-1 if new.reversed else 1, turn=round(new.counts_per_turn)))
        scales.append(_scale(new.counts_per_turn / old.counts_per_turn, new.gear / old.gear,
                             new.peak_current / old.peak_current))  # fmt: skip
    axes = inverse(axes_of(right.sensor_axes, names))
    found = Identified((), tuple(motors), tuple(scales), Mounting(order, axes, 0.0), 0.0, 0.0, True)
    assert apply_findings(file, found) == right


def _scale(lines: float, gear: float, peak: float) -> Any:
    from softneck.drives.commissioning._identify import Scale

    return Scale(lines=lines, gear=gear, peak=peak)


def _features(**changes: Any) -> Features:
    values = {"pull": 1, "slack": 0.0, "gain": 1.0, "error": 0.0, "direction": np.array([1.0, 0.0]), "force": 1.0,
              "rise": 5.0,
              "friction": 1.0, "lag": 0.0, "noise": 0.0, "turn": 2048, "residual": 0.0}  # fmt: skip
    return Features(**{**values, **changes})


@pytest.mark.parametrize(
    "mistake", ["", "reversed", "reversed:4", "gear:1", "gear:1:x", "gear:1:0", "sign:yaw", "late:soon", "axes:1",
                "duplicate:0", "exchanged:1", "exchanged:1:1", "late:-1", "late:inf", "lazy"],
)  # fmt: skip
def test_a_mistake_that_is_none_is_refused(mistake: str) -> None:
    with pytest.raises((ValueError, SettingsError), match=r"a mistake is one of reversed:N|gear"):
        plant(default_drives(), [mistake])


# -- who is there ---------------------------------------------------------------------------------------------------


def drive(node: int, **changes: Any) -> dict[str, Any]:
    said = {"node": node, "device_type": 0x192, "drive": True, "serials": [1000 + node], "serial": 1000 + node,
            "product": 0, "name": "a drive"}  # fmt: skip
    return {**said, **changes}


ALL = [drive(1), drive(2), drive(3)]


@pytest.mark.parametrize(
    ("found", "names", "stops"),
    [
        (ALL, [], False),
        ([drive(1), drive(2)], ["no drive"], True),
        ([drive(1), drive(2), drive(3, drive=False)], ["no drive"], True),
        ([drive(1), drive(2, serials=[1, 2]), drive(3)], ["duplicate node"], True),
        ([*ALL, drive(7)], ["unknown node"], False),
        ([*ALL, drive(10, drive=False)], [], False),
        ([drive(1, name="iPOS4808 MX-CAN"), drive(2), drive(3)], ["wrong type"], False),
        ([drive(1, product=27014101), drive(2), drive(3)], ["wrong type"], False),
        ([drive(1, name="iPOS3604 MX-CAN"), drive(2), drive(3)], [], False),
    ],
)
def test_who_is_there_says_what_no_move_has_to(found: list[dict[str, Any]], names: list[str], stops: bool) -> None:
    told = known_before(default_drives(), found)
    assert [one.name for one in told] == names
    assert fatal(told) is stops


def test_serial_numbers_tell_exchanged_nodes() -> None:
    file = default_drives()
    drives = tuple(replace(entry, serial=serial) for entry, serial in zip(file.drives, (1001, 1003, 1002), strict=True))
    told = known_before(replace(file, drives=drives), ALL)
    assert [(one.name, one.motors) for one in told] == [("exchanged nodes", (2, 3)), ("exchanged nodes", (3, 2))]


def test_a_type_that_is_public_gives_the_peak_current_from_the_first_move_on() -> None:
    found = [drive(1, name="iPOS4808 BX-CAN"), drive(2, name="iPOS3604 MX-CAN"), drive(3)]
    file, peaks = with_type_currents(default_drives(), found)
    assert peaks == {1: 20.0, 2: 10.0}
    assert [entry.scale.peak_current for entry in file.drives] == [20.0, 10.0, 10.0]
    assert peak_of(drive(1, name=None)) is None


def test_nobody_on_the_bus_is_one_line() -> None:
    with pytest.raises(CheckFailedError, match=r"can0: no node answers\. Are the drives on, is the bit rate right"):
        require_answers([], "can0")


def test_every_finding_has_its_name_in_the_table_and_says_which_motor() -> None:
    text = str(Finding("gear", "twice", "look", (1, 2)))
    assert text == "motors 1, 2: gear: twice"
    assert Finding("sensor sign", "roll", "turn", instead=("x",)).table()["or"] == ["x"]
    source = "".join(path.read_text() for path in (ROOT / "softneck/drives/commissioning").glob("*.py"))
    page = (ROOT / "docs" / "reference" / "drives.md").read_text()
    given = set(re.findall(r'Finding\(\s*"([a-z ]+)"', source))
    assert len(given) > 15
    assert [name for name in given if f"`{name}`" not in page] == []
    assert Robot.preset("neck").is_neck
