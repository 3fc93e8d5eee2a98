"""Four robots, and each of them seen otherwise: in other units, at another pace, renamed, permuted, turned, moved.

The laws of this folder say that nothing but the map between two views of one robot shows in what softneck returns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.signal import lfilter

from softneck.core import Matrix, Vector, to_si
from softneck.robot import Robot
from softneck.signals import Recording


@dataclass(frozen=True)
class Plant:
    """A robot as physics has it: first order with dead time and a soft limit, in the units of `robot`.

    Attributes:
        robot: tables of its robot.toml, in its first units.
        weights: (outputs, motors).
        gain: of an output's unit over a motor's.
        time_constant, delay: [samples].
    """

    robot: dict[str, Any]
    weights: tuple[tuple[float, ...], ...]
    gain: float
    time_constant: float = 12.0
    delay: int = 3


def _robot(name: str, sample_time: float, motors: tuple[str, ...], unit: str, span: tuple[float, float], rate: float,
           outputs: tuple[str, ...], shown: str, reach: tuple[float, float],
           directions: dict[str, Any]) -> dict[str, Any]:  # fmt: skip
    return {
        "name": name, "sample_time_s": sample_time,
        "motors": {"names": list(motors), "unit": unit, "setpoint_min": span[0], "setpoint_max": span[1],
                   "rate_limit": rate},
        "outputs": {"names": list(outputs), "unit": shown, "min": reach[0], "max": reach[1]},
        "directions": directions,
        "sensor": {"noise_std": 0.002 * (reach[1] - reach[0]), "delay_s": sample_time, "rate_hz": 1.0 / sample_time},
    }  # fmt: skip


_THREE = ((1.0, -0.4, -0.5), (0.1, 0.9, -0.8))
_FOUR = ((1.0, 0.1, -0.9, 0.0), (0.0, 1.1, 0.2, -0.8), (0.5, -0.4, 0.6, -0.5))
#: 1 to 4 motors, 1 to 3 outputs; pressure, tendons that pull against each other, voltage.
PLANTS = {
    "finger": Plant(_robot("finger", 0.01, ("pressure",), "kPa", (0.0, 150.0), 600.0, ("flexion",), "deg",
                           (-5.0, 70.0), {"kind": "identified"}), ((1.0,),), 0.4),
    "joint": Plant(_robot("joint", 0.02, ("flexor", "extensor"), "rad", (0.0, 4.0), 10.0, ("angle",), "deg",
                          (-40.0, 40.0), {"kind": "matrix", "matrix": [[1.0, -1.0]]}), ((1.0, -1.0),), 8.0),
    "arm": Plant(_robot("arm", 0.02, ("left", "right", "back"), "bar", (0.0, 2.0), 8.0, ("x", "y"), "mm",
                        (-60.0, 60.0), {"kind": "identified"}), _THREE, 20.0),
    "platform": Plant(_robot("platform", 0.001, ("a", "b", "c", "d"), "V", (-10.0, 10.0), 1000.0, ("x", "y", "z"),
                             "mm", (-30.0, 30.0), {"kind": "identified"}), _FOUR, 2.0),
}  # fmt: skip


@dataclass(frozen=True)
class View:
    """How one sees a plant; the plain view is that of `PLANTS`.

    Attributes:
        motor_unit, output_unit: of the robot's file, of the same dimension or of another; "" for the plant's own.
        motor_number, output_number: what one of the plant's own units is called in them, where the dimension differs.
        pace: all times multiplied.
        motors, outputs: order in which they are listed; () for the plant's own.
        turned: (outputs,) signs; () for none turned.
        turned_motors: (motors,) signs, their limits exchanged; () for none turned.
        offset: added to all set-points, in the plant's own unit.
        prefix: put before every name.
    """

    motor_unit: str = ""
    output_unit: str = ""
    motor_number: float | None = None
    output_number: float | None = None
    pace: float = 1.0
    motors: tuple[int, ...] = ()
    outputs: tuple[int, ...] = ()
    turned: tuple[int, ...] = ()
    turned_motors: tuple[int, ...] = ()
    offset: float = 0.0
    prefix: str = ""


@dataclass(frozen=True)
class World:
    """A plant as it is seen.

    Attributes:
        robot: the robot in this view.
        recording: of it.
        view: the view.
        plant: the plant.
        numbers: an output's unit here over the plant's own, both in SI.
    """

    robot: Robot
    recording: Recording
    view: View
    plant: Plant
    numbers: tuple[float, float] = field(default=(1.0, 1.0))

    def plain_outputs(self, values: Matrix) -> Matrix:
        """Return outputs (time, outputs) in SI of this view as the plain view has them."""
        order, signs = _order(self.view.outputs, values.shape[1]), _signs(self.view.turned, values.shape[1])
        found = np.empty_like(values)
        found[:, order] = values / self.numbers[1]
        return found * signs

    def plain_motors(self, values: Matrix) -> Matrix:
        """Return set-points (time, motors) in SI of this view as the plain view has them."""
        order, signs = _order(self.view.motors, values.shape[1]), _signs(self.view.turned_motors, values.shape[1])
        found = np.empty_like(values)
        found[:, order] = values / self.numbers[0]
        own = to_si(self.plant.robot["motors"]["unit"])[0]
        return (found - self.view.offset * own) * signs

    def simulated(self, model: Any) -> Matrix:
        """Return the simulation of a model of this view as the plain view has it, over the range of each output."""
        low, high = (np.array(self.plant.robot["outputs"][key]) for key in ("min", "max"))
        size = to_si(self.plant.robot["outputs"]["unit"])[0] * (high - low)
        outputs = len(self.robot.outputs.names)
        return self.plain_outputs(np.asarray(model.simulate(self.recording))[:, :outputs]) / size


#: In which units each plant is seen: of the same dimension, and of another.
UNITS = {
    "finger": [View(motor_unit="Pa", output_unit="rad"), View(motor_unit="bar"),
               View(motor_unit="V", motor_number=0.05, output_unit="mm", output_number=3.0)],
    "joint": [View(motor_unit="deg", output_unit="rad"), View(output_unit="mm", output_number=0.7)],
    "arm": [View(motor_unit="kPa", output_unit="m"), View(motor_unit="psi", output_unit="cm"),
            View(motor_unit="rad", motor_number=1.3, output_unit="rad", output_number=0.01)],
    "platform": [View(motor_unit="mV", output_unit="m"),
                 View(motor_unit="Pa", motor_number=7e3, output_unit="deg", output_number=0.3)],
}  # fmt: skip
#: Paces of issue "One world".
PACES = [View(pace=pace) for pace in (0.1, 10.0, 1000.0)]


def orders(name: str) -> list[View]:
    """Return the plant renamed, its motors and outputs listed the other way round, and an output turned."""
    motors, outputs = (len(PLANTS[name].robot[key]["names"]) for key in ("motors", "outputs"))
    back = (tuple(range(motors))[::-1], tuple(range(outputs))[::-1])
    return [
        View(prefix="other_"),
        View(motors=back[0], outputs=back[1]),
        View(turned=(-1,) + (1,) * (outputs - 1)),
    ]


def world(name: str, view: View = View(), *, rows: int = 400, seed: int = 0) -> World:
    """Return the plant `name` as `view` has it; the same rows of the same motion in every view."""
    plant = PLANTS[name]
    U, Y = _rows(name, rows, seed)
    motors, outputs = U.shape[1], Y.shape[1]
    robot, per = _seen(plant, view)
    mo, oo = _order(view.motors, motors), _order(view.outputs, outputs)
    U = ((U * _signs(view.turned_motors, motors) + view.offset) * per[0])[:, mo]
    Y = (Y * _signs(view.turned, outputs) * per[1])[:, oo]
    units = to_si(robot.motors.unit)[0], to_si(robot.outputs.unit)[0]
    recording = Recording.from_arrays(
        U * units[0], Y * units[1], sample_time=plant.robot["sample_time_s"] * view.pace, robot=robot
    )
    own = to_si(plant.robot["motors"]["unit"])[0], to_si(plant.robot["outputs"]["unit"])[0]
    numbers = per[0] * units[0] / own[0], per[1] * units[1] / own[1]
    return World(robot, recording, view, plant, numbers)


def _seen(plant: Plant, view: View) -> tuple[Robot, tuple[float, float]]:
    """Return the robot in a view, and by what its motors' and outputs' numbers are multiplied."""
    table: dict[str, Any] = {key: dict(v) if isinstance(v, dict) else v for key, v in plant.robot.items()}
    per = []
    for key, unit, number in (("motors", view.motor_unit, view.motor_number),
                              ("outputs", view.output_unit, view.output_number)):  # fmt: skip
        own = table[key]["unit"]
        factor = 1.0 if not unit else number if number is not None else to_si(own)[0] / to_si(unit)[0]
        per.append(factor)
        table[key]["unit"] = unit or own
    motors, outputs = len(table["motors"]["names"]), len(table["outputs"]["names"])
    mo, oo = _order(view.motors, motors), _order(view.outputs, outputs)
    _limits(table["motors"], ("setpoint_min", "setpoint_max"), _signs(view.turned_motors, motors), view.offset,
            per[0], mo)  # fmt: skip
    _limits(table["outputs"], ("min", "max"), _signs(view.turned, outputs), 0.0, per[1], oo)
    table["motors"]["rate_limit"] *= per[0] / view.pace
    table["sample_time_s"] *= view.pace
    sensor = table["sensor"]
    table["sensor"] = {"noise_std": sensor["noise_std"] * per[1], "delay_s": sensor["delay_s"] * view.pace,
                       "rate_hz": sensor["rate_hz"] / view.pace}  # fmt: skip
    for key, order in (("motors", mo), ("outputs", oo)):
        table[key]["names"] = [view.prefix + table[key]["names"][i] for i in order]
    if "matrix" in table["directions"]:
        W = np.array(table["directions"]["matrix"]) * _signs(view.turned_motors, motors)
        W = (_signs(view.turned, outputs)[:, None] * W)[oo][:, mo]
        table["directions"] = {"kind": "matrix", "matrix": W.tolist()}
    return Robot.from_dict(table), (per[0], per[1])


def _limits(table: dict[str, Any], keys: tuple[str, str], signs: Vector, offset: float, per: float,
            order: np.ndarray) -> None:  # fmt: skip
    """Write lowest and highest values (channels,) of a view into its table."""
    both = np.sort(np.array([table[key] * signs for key in keys]), axis=0)
    for key, values in zip(keys, both, strict=True):
        table[key] = ((values + offset) * per)[order].tolist()


def _order(order: tuple[int, ...], count: int) -> np.ndarray:
    return np.array(order or range(count))


def _signs(signs: tuple[int, ...], count: int) -> Vector:
    return np.array(signs or (1,) * count, dtype=np.float64)


@cache
def _rows(name: str, rows: int, seed: int) -> tuple[Matrix, Matrix]:
    """Return set-points (rows, motors) and outputs (rows, outputs) in the plant's own units."""
    plant, rng = PLANTS[name], np.random.default_rng(seed)
    W = np.array(plant.weights)
    low, high = (float(plant.robot["motors"][key]) for key in ("setpoint_min", "setpoint_max"))
    hold = round(2.0 * plant.time_constant)
    levels = rng.uniform(low, high, (rows // hold + 2, W.shape[1]))
    # Each motor moves at another time: their levels begin elsewhere.
    U = np.column_stack([np.repeat(column, hold)[5 * j : 5 * j + rows] for j, column in enumerate(levels.T)])
    v = (U - 0.5 * (low + high)) @ W.T
    late = np.vstack([np.repeat(v[:1], plant.delay, axis=0), v])[:rows]
    a = np.exp(-1.0 / plant.time_constant)
    linear = np.asarray(lfilter([0.0, 1.0 - a], [1.0, -a], late, axis=0))
    reach = np.abs(linear).max(axis=0)
    Y = np.asarray(plant.gain * linear / (1.0 + 0.2 * (linear / reach) ** 2))
    return U, Y + 0.01 * Y.std(axis=0) * rng.standard_normal(Y.shape)


def without_limits(seen: World) -> World:
    """Return the world with a robot that gives neither ranges nor a sensor: all that is known are the data."""
    table = seen.robot.as_dict()
    for key, names in (("motors", ("setpoint_min", "setpoint_max", "rate_limit")), ("outputs", ("min", "max"))):
        table[key] = {name: value for name, value in table[key].items() if name not in names}
    table.pop("sensor", None)
    robot = Robot.from_dict(table)
    return replace(seen, robot=robot, recording=replace(seen.recording, robot=robot))
