"""What a neck, or another robot of one or two angles, may be near each inclination: a schedule's operating points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, SettingsError
from softneck.estimation import AxisPlant, axis_plant
from softneck.estimation._axis import HasTransferFunctions, robot_of
from softneck.identification import Family, Lpv
from softneck.signals.recording._recording import require_same_robot

from ..linear._tuning import Plants

# Operating points nearer to each other than this [rad] are one.
_NEAREST = math.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class OperatingPoint:
    """What the neck may be near one inclination.

    Attributes:
        inclination: [rad].
        plants: of each output, such as pitch and roll; the first of each is the one that is interpolated.
    """

    inclination: float
    plants: tuple[Plants, ...]


def family_points(family: Family) -> list[OperatingPoint]:
    """Return the operating points of a family: those of its interpolation, else of a neck those of its local models.

    Raises:
        SettingsError: fewer than two.
    """
    names = family.robot.outputs.names
    if family.lpv is not None and family.lpv.knots.size > 1:
        return [_of_knot(family.lpv, k, family.sample_time) for k in range(family.lpv.knots.size)]
    if not family.robot.is_neck:
        raise SettingsError(
            f"the family of robot {family.robot.label()} knows no inclinations: make it with `--set lpv_knots=3`, or "
            "give several models with one of `inclinations` each."
        )
    step = float(family.settings.get("inclination_step", math.radians(7.5)))
    bins = {name: _bins(axis.samples[axis.used > 0.5], axis.where[axis.used > 0.5], step) for name, axis in
            family.axes.items()}  # fmt: skip
    common = sorted(set.intersection(*(set(bins[name]) for name in names)))
    if len(common) < 2:
        raise SettingsError(
            f"the family has {len(common)} operating point(s) over the inclination where scheduling needs 2: make it "
            "with `--set lpv_knots=3`, or record at more inclinations."
        )
    points = []
    for number in common:
        where = float(np.mean(np.concatenate([bins[name][number][:, 3] for name in names])))
        pairs = [
            tuple(
                one_pole(gain, pole, round(delay / family.sample_time), family.sample_time)
                for gain, pole, delay in _median_first(bins[name][number][:, :3])
            )
            for name in names
        ]
        points.append(OperatingPoint(where, tuple(pairs)))
    return points


def one_pole(gain: float, pole: float, delay: float, sample_time: float) -> AxisPlant:
    """Return `gain pole exp(-L s)/(s + pole)` sampled, L = `delay` samples, the input held between them."""
    a = math.exp(-pole * sample_time)
    return AxisPlant(np.array([gain * (1.0 - a)]), np.array([1.0, -a]), int(delay), sample_time)


def _bins(samples: Matrix, where: Matrix, step: float) -> dict[int, Matrix]:
    """Return number of the inclination's bin -> (k, 4) gain, pole, dead time, inclination of its operating points."""
    bins: dict[int, list[np.ndarray]] = {}
    for numbers, place in zip(samples, where, strict=True):
        if place[0] == 1.0:  # scope "point"
            bins.setdefault(int(place[3] / step), []).append(np.append(numbers, place[3]))
    return {number: np.array(rows) for number, rows in bins.items()}


def _median_first(samples: Matrix) -> Matrix:
    """Return the median of (k, 3) samples, and below it all of them."""
    return np.vstack([np.median(samples, axis=0), samples])


def _of_knot(lpv: Lpv, k: int, sample_time: float) -> OperatingPoint:
    """Return knot `k` of an interpolation as an operating point."""
    plants = (
        one_pole(float(lpv.gains[i, k]), float(lpv.poles[i, k]), float(lpv.delays[i]), sample_time)
        for i in range(len(lpv.gains))
    )
    return OperatingPoint(float(lpv.knots[k]), tuple((plant,) for plant in plants))


def model_points(models: Sequence[HasTransferFunctions], inclinations: Sequence[float]) -> list[OperatingPoint]:
    """Return the operating points of linear models with an inclination [rad] each, in their order.

    Raises:
        SettingsError: fewer than two, another number of inclinations, or two that are nearly the same.
        DataError: models of different sample times.
    """
    if len(models) != len(inclinations) or len(models) < 2:
        raise SettingsError(
            "scheduling needs a family, or at least two models with one of `inclinations` each; got "
            f"{len(models)} model(s) and {len(inclinations)} inclination(s)."
        )
    robot = robot_of(models[0])
    for model in models[1:]:
        require_same_robot(robot_of(model), robot, "models")
    points = [
        OperatingPoint(float(inclination), tuple((axis_plant(model, name),) for name in robot.outputs.names))
        for inclination, model in zip(inclinations, models, strict=True)
    ]
    points.sort(key=lambda point: point.inclination)
    _check_times([plants[0] for point in points for plants in point.plants])
    for low, high in itertools.pairwise(points):
        if high.inclination - low.inclination < _NEAREST:
            raise SettingsError(
                f"`inclinations` must be at least 1 deg apart; got {math.degrees(low.inclination):.4g} and "
                f"{math.degrees(high.inclination):.4g} deg."
            )
    return points


def _check_times(plants: Sequence[AxisPlant]) -> None:
    for plant in plants:
        if not math.isclose(plant.sample_time, plants[0].sample_time, rel_tol=1e-9):
            raise DataError(
                f"models of different sample times cannot be scheduled together: {plants[0].sample_time:g} s and "
                f"{plant.sample_time:g} s. Identify them at one."
            )
