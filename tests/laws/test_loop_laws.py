"""Loops and FMUs of one robot in other units, at another pace, renamed, in another order and turned: the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from softneck import build_fmu
from softneck.core import Matrix, Vector, to_si
from softneck.cosim import Result, simulate
from softneck.cosim.parts._fmu_part import drive_fmu
from softneck.fmu import build_compiled_fmu

from .models import model_of
from .worlds import PACES, PLANTS, UNITS, View, World, orders, world

VIEWS = [
    (name, view)
    for name, plant in PLANTS.items()
    for view in (*UNITS[name], *PACES, *orders(name), View(turned_motors=(-1,) * len(plant.weights[0])))
]
ROWS, AT = 60, 10


def seen_as(seen: World, values: Vector, what: str) -> Vector:
    """Return outputs or set-points of the plain view, in SI, as `seen` has them: the inverse of its own map."""
    back = seen.plain_outputs if what == "outputs" else seen.plain_motors
    n = len(values)
    zero = back(np.zeros((1, n)))[0]
    A = np.column_stack([back(np.eye(n)[[j]])[0] - zero for j in range(n)])
    return np.linalg.solve(A, values - zero)


class Proportional:
    """Each motor follows the errors by the plant's own weights: written once, for the plain view."""

    def __init__(self, seen: World) -> None:
        """Act in the names and units of `seen`."""
        self.seen, self.robot = seen, seen.robot
        self.sample_time = seen.recording.sample_time
        plain = world(next(name for name, plant in PLANTS.items() if plant is seen.plant)).robot
        low, high = (np.array(side) for side in (plain.motors.setpoint_min, plain.motors.setpoint_max))
        own = [to_si(plain.motors.unit)[0], to_si(plain.outputs.unit)[0]]
        self.middle = 0.5 * own[0] * (low + high)
        self.gain = 0.3 * own[0] / own[1] / seen.plant.gain * np.linalg.pinv(np.array(seen.plant.weights))

    def step(self, state: Vector, inputs: dict[str, float]) -> tuple[Vector, Vector]:
        names = self.robot.outputs.names
        r, y = (np.array([[inputs[f"{name}{end}"] for name in names]]) for end in ("_reference", ""))
        error = (self.seen.plain_outputs(r) - self.seen.plain_outputs(y))[0]
        return state, seen_as(self.seen, self.middle + self.gain @ error, "motors")


@cache
def closed(name: str, view: View) -> tuple[World, Result]:
    seen = world(name, view)
    low, high = (np.array(side) for side in (world(name).robot.outputs.min, world(name).robot.outputs.max))
    wanted = seen_as(seen, (0.5 * (low + high) + 0.2 * (high - low)) * to_si(seen.plant.robot["outputs"]["unit"])[0],
                     "outputs")  # fmt: skip
    Ts, si = seen.recording.sample_time, to_si(seen.robot.outputs.unit)[1]
    keys = {f"{output}_{si}": float(value) for output, value in zip(seen.robot.outputs.names, wanted, strict=True)}
    return seen, simulate({
        "duration_s": ROWS * Ts, "sample_time_s": Ts, "plant": model_of(seen), "controller": Proportional(seen),
        "reference": {"kind": "step", "at_s": AT * Ts, **keys},
    })  # fmt: skip


def spans(name: str) -> tuple[Vector, Vector]:
    """Return the range of outputs and motors of the plain view, in SI."""
    robot = world(name).robot
    ends = (
        (robot.outputs.unit, robot.outputs.min, robot.outputs.max),
        (robot.motors.unit, robot.motors.setpoint_min, robot.motors.setpoint_max),
    )
    outputs, motors = (to_si(unit)[0] * (np.array(high) - np.array(low)) for unit, low, high in ends)
    return outputs, motors


def check_loop(name: str, view: View) -> None:
    (_, plain), (seen, found) = closed(name, View()), closed(name, view)
    outputs, motors = spans(name)
    for names, back, size in ((lambda r: r.robot.outputs.names, seen.plain_outputs, outputs),
                              (lambda r: r.robot.set_points, seen.plain_motors, motors)):  # fmt: skip
        one, other = (np.column_stack([result[n] for n in names(result)]) for result in (plain, found))
        # Sixty steps of rounding; the plain view's are of the size of its range.
        np.testing.assert_allclose(back(other) / size, one / size, rtol=0, atol=1e-9)
    order = view.outputs or range(len(seen.robot.outputs.names))
    unit = to_si(found.robot.outputs.unit)[0], to_si(plain.robot.outputs.unit)[0]
    for axis, i in zip(found.robot.outputs.names, order, strict=True):
        here, there = found.metrics[axis], plain.metrics[plain.robot.outputs.names[i]]
        for (key, value), (plain_key, expected) in zip(here.items(), there.items(), strict=True):
            scale = view.pace if key.endswith("_s") else 1.0
            if "_error_" in key or "steady_rms_" in key:
                ends = ["deg" if to_si(r.outputs.unit)[1] == "rad" else r.outputs.unit
                        for r in (found.robot, plain.robot)]  # fmt: skip
                assert (key.rpartition("_")[2], plain_key.rpartition("_")[2]) == tuple(ends)
                sizes = [np.radians(1.0) if end == "deg" else size for end, size in zip(ends, unit, strict=True)]
                scale = seen.numbers[1] * sizes[1] / sizes[0]
            elif key in ("iae", "itae", "ise"):
                times = {"iae": 1, "itae": 2, "ise": 1}[key]
                scale = seen.numbers[1] ** (2 if key == "ise" else 1) * view.pace**times
            if expected is None:
                assert value is None, key
            else:
                assert value == pytest.approx(scale * expected, rel=1e-6, abs=1e-6 * scale), key


@pytest.mark.parametrize(("name", "view"), [("finger", UNITS["finger"][0]), ("joint", orders("joint")[1]),
                                            ("arm", PACES[2]), ("platform", orders("platform")[1])])  # fmt: skip
def test_a_loop_does_not_depend_on_units_pace_or_order(name: str, view: View) -> None:
    check_loop(name, view)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_a_loop_is_the_same(name: str, view: View) -> None:
    check_loop(name, view)


def answer(seen: World, folder: Path, build: Callable[..., Any] = build_fmu) -> Matrix:
    """Return outputs (rows, outputs) of the model's FMU under the recording's set-points."""
    model, path = model_of(seen), folder / "Plant.fmu"
    build(model, path)
    names = seen.robot.outputs.names
    ports: dict[str, Any] = {
        variable.name: variable for variable in fmpy.read_model_description(str(path)).modelVariables
    }
    shown = seen.robot.outputs.display_unit
    if to_si(shown)[1] != shown:
        assert {ports[name].declaredType.displayUnit if ports[name].declaredType else ports[name].displayUnit
                for name in names} == {shown}  # fmt: skip
    part = seen.recording.rows(0, ROWS)
    return drive_fmu(path, dict(zip(seen.robot.set_points, part.set_points.T, strict=True)), outputs=names)


def check_fmu(name: str, view: View, folder: Path, build: Callable[..., Any] = build_fmu) -> None:
    plain, seen = world(name), world(name, view)
    folders = [folder / end for end in ("plain", "seen")]
    for made in folders:
        made.mkdir()
    one, other = (answer(w, made, build) for w, made in zip((plain, seen), folders, strict=True))
    # Sixty steps of rounding; outputs are of the size of their range.
    np.testing.assert_allclose(seen.plain_outputs(other) / spans(name)[0], one / spans(name)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("name", "view"), [("finger", UNITS["finger"][0]), ("arm", orders("arm")[1])])
def test_an_fmu_does_not_depend_on_units_or_order(name: str, view: View, tmp_path: Path) -> None:
    check_fmu(name, view, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_an_fmu_is_the_same(name: str, view: View, tmp_path: Path) -> None:
    check_fmu(name, view, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTS)
def test_a_compiled_fmu_is_the_same(name: str, tmp_path: Path) -> None:
    for i, view in enumerate((UNITS[name][-1], PACES[2], orders(name)[1])):
        (tmp_path / str(i)).mkdir()
        check_fmu(name, view, tmp_path / str(i), build_compiled_fmu)


def test_the_inverse_of_the_map() -> None:
    for name, view in VIEWS[:6]:
        seen = world(name, view)
        for what, back in (("outputs", seen.plain_outputs), ("motors", seen.plain_motors)):
            values: Any = np.arange(
                1.0, 1.0 + len(seen.robot.outputs.names if what == "outputs" else seen.robot.set_points)
            )
            np.testing.assert_allclose(back(seen_as(seen, values, what)[None])[0], values, rtol=1e-9)
