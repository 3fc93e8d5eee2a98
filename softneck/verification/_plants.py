"""Uncertain plants: a box of static gain, pole and dead time for each axis, and plants drawn from it.

An axis is `K p exp(-L s)/(s + p)` with a zero-order hold, discretised exactly for every dead time L, times certain
dynamics (for a model of higher order, all but its slowest pole).
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.design import polynomials_at
from softneck.estimation import AxisPlant, axis_plant, directions_of, robot_of
from softneck.identification import AxisMeasured, response_of
from softneck.robot import Robot

# Bisection steps towards an excluded plant, to a thousandth.
_BISECTION_STEPS = 10


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisBox:
    """The uncertain first-order part of one axis: static gain [rad/rad, else SI], pole [1/s], dead time [s].

    `nominal`: (3,). `low`, `high`: (3,). `samples`: (n, 3) identified plants; none for a model. `std`: (n, 3) their
    standard deviations, if known. `rest`: numerator and denominator (r + 1,) of certain dynamics, highest power first.
    `measured`: response in the recordings of a tested family; plants that these exclude are not in the box.
    """

    nominal: Vector
    low: Vector
    high: Vector
    samples: Matrix
    std: Matrix | None = None
    rest: tuple[Vector, Vector] = field(default_factory=lambda: (np.ones(1), np.ones(1)))
    measured: AxisMeasured | None = None

    @property
    def widths(self) -> Vector:
        """Half the width of the box (3,)."""
        return 0.5 * (self.high - self.low)

    @property
    def middle(self) -> Vector:
        """Middle of the box (3,)."""
        return 0.5 * (self.high + self.low)


def within_weight(numbers: Matrix, box: AxisBox, Ts: float) -> Matrix:
    """Return plants of an axis (n, 3); those that the recordings exclude are moved towards the best sample.

    Corners combine values of different recordings. If even the best sample is excluded, the order is too low for this
    plant, and the box stays as it is.
    """
    if box.measured is None:
        return numbers
    known = np.concatenate([box.nominal[None], box.samples])
    excess = _excess(known, box, Ts)
    if excess.min() > 1.0:
        return numbers
    inside = known[int(np.argmin(excess))]
    share = np.where(_excess(numbers, box, Ts) <= 1.0, 1.0, 0.0)[:, None]
    excluded = 1.0 - share
    for k in range(1, _BISECTION_STEPS + 1):
        further = share + 0.5**k * excluded
        allowed = _excess(inside + further * (numbers - inside), box, Ts) <= 1.0
        share = np.where(allowed[:, None], further, share)
    return inside + share * (numbers - inside)


def _excess(numbers: Matrix, box: AxisBox, Ts: float) -> Vector:
    """Return the largest relative error of each plant (n, 3) over the weight of the recordings."""
    measured: Any = box.measured
    z = np.exp(1j * measured.frequency * Ts)
    above, below, delay = discretize_axis(numbers, box.rest, Ts)
    powers = z ** np.arange(above.shape[1] - 1, -1, -1)[:, None]
    G = (above @ powers) / (below @ powers) * z ** -delay[:, None].astype(float)
    error = np.abs(G / response_of(measured.model, measured.frequency, Ts) - 1.0)
    return (error / np.maximum(measured.weight, 1e-12)).max(axis=1)


def discretize_axis(numbers: Matrix, rest: tuple[Vector, Vector], Ts: float) -> tuple[Matrix, Matrix, np.ndarray]:
    """Return numerator and denominator (n, q) and delay (n,) of one axis: y+ = a y + b0 u(k-d) + b1 u(k-d-1)."""
    K, p, L = numbers.T
    # 1e-9: rounding of dead times such as 0.08 / 0.02.
    d = np.floor(L / Ts + 1e-9)
    part = np.clip(L / Ts - d, 0.0, 1.0)
    a = np.exp(-p * Ts)
    late = np.exp(-p * Ts * (1.0 - part))
    first = np.stack([K * (1.0 - late), K * (late - a)], axis=1)
    own = np.stack([np.ones_like(a), -a], axis=1)
    above = _products(first, rest[0])
    below = _products(own, np.append(rest[1], 0.0))
    above = np.pad(above, ((0, 0), (below.shape[1] - above.shape[1], 0)))
    return above, below, d.astype(int)


def _products(rows: Matrix, polynomial: Vector) -> Matrix:
    return np.stack([np.convolve(row, polynomial) for row in rows])


# A pole times the sample time that is too fast to see.
_INVISIBLE_POLE = 200.0
_CROSS_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlantSource:
    """A model or family as a source of plants.

    `name`: of its file. `sample_time`: [s]. `axes`: one for each output. `cross`: (m (m - 1),) gains of the other axes'
    inputs over the axis's own, axis by axis: for the neck phi_i into pitch, theta_i into roll. `kind`: "family" or
    "model". `robot`: of the plant. `weights`: (m, motors) of the motors in each axis's input; for the neck Eq. 9, 10.
    `decay`: time constant in which its slowest oscillation decays [s]; 0 without one.
    """

    name: str
    sample_time: float
    axes: tuple[AxisBox, ...]
    cross: Vector
    kind: str
    weights: Matrix
    robot: Robot = field(default_factory=Robot.preset)
    decay: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes: the robot's outputs."""
        return self.robot.outputs.names

    @property
    def gain_unit(self) -> str:
        """SI unit of static gains: `rad/rad` for the neck."""
        return f"{to_si(self.robot.outputs.unit)[1]}/{to_si(self.robot.motors.unit)[1]}"


@dataclass(frozen=True, slots=True, eq=False)
class Plants:
    """Plants, one per row.

    Attributes:
        sample_time: [s].
        numbers: (n, axes, 3) static gain, pole, dead time of every axis.
        cross: (n, axes (axes - 1)).
        names: of each.
        source: (n,) number of its source.
        numerator, denominator: (n, axes, q) highest power first, monic; the numerator starts with 0.
        delay: (n, axes) additional samples.
        axes: names of the axes.
        unit: SI unit of static gains, as a word.
    """

    sample_time: float
    numbers: np.ndarray
    cross: Matrix
    names: tuple[str, ...]
    source: np.ndarray
    numerator: np.ndarray
    denominator: np.ndarray
    delay: np.ndarray
    axes: tuple[str, ...] = ("pitch", "roll")
    unit: str = "rad_per_rad"

    def __len__(self) -> int:
        return len(self.names)

    def take(self, rows: Any) -> Plants:
        """Return the plants of some rows."""
        rows = np.atleast_1d(np.asarray(rows, dtype=int))
        fields = ("numbers", "cross", "source", "numerator", "denominator", "delay")
        taken: Any = {name: getattr(self, name)[rows] for name in fields}
        return replace(self, names=tuple(self.names[int(row)] for row in rows), **taken)

    def later(self, samples: int) -> Plants:
        """Return the plants with additional delay, as a loop's order adds."""
        return replace(self, delay=self.delay + samples)

    def response(self, frequency: Vector) -> np.ndarray:
        """Return the exact complex response (n, axes, m) of all axes at `frequency` [rad/s], without cross gains."""
        z = np.exp(1j * frequency * self.sample_time)
        powers = z[None, :] ** np.arange(self.numerator.shape[2] - 1, -1, -1)[:, None]
        return (self.numerator @ powers) / (self.denominator @ powers) * z ** -self.delay[:, :, None].astype(float)

    def response_at(self, rows: np.ndarray, frequency: Vector) -> np.ndarray:
        """Return the responses (k, axes) of the plants `rows` (k,), each at its own `frequency` (k,) [rad/s]."""
        z = np.exp(1j * frequency * self.sample_time)
        ratio = polynomials_at(self.numerator[rows], z) / polynomials_at(self.denominator[rows], z)
        return ratio * z[:, None] ** -self.delay[rows].astype(float)


def source_of_family(family: Any, name: str) -> PlantSource:
    """Return a `Family` as a source of plants."""
    boxes, names = [], tuple(family.axes)
    for axis in names:
        found = family.axes[axis]
        used = found.used > 0.5
        if not used.any():
            raise SettingsError(f"{name}: the family has no samples of {axis}; fit it on longer recordings.")
        low, high = found.box
        boxes.append(
            AxisBox(
                nominal=found.nominal.copy(), low=np.minimum(low, found.nominal), high=np.maximum(high, found.nominal),
                samples=found.samples[used], std=found.std[used][:, :3],
                measured=getattr(family, "measured", {}).get(axis),
            )
        )  # fmt: skip
    own = np.array([family.axes[axis].nominal[0] for axis in names])
    robot = robot_of(family)
    return PlantSource(
        name=name, sample_time=family.sample_time, axes=tuple(boxes), kind="family", robot=robot,
        cross=_known_cross(family.cross[:, : len(names)] / own[:, None], name, robot), weights=directions_of(family),
        decay=0.0 if getattr(family, "draws", None) is None else _decay_of(family.draws.model),
    )  # fmt: skip


def _decay_of(model: Any) -> float:
    """Return the time constant [s] in which the slowest oscillation of an identified linear model decays; 0 without.

    What turns within four samples is no motion of a robot, but noise that a model of many poles has fitted.
    """
    found = getattr(model, "findings", {}).get("transfer_functions", {})
    poles = np.concatenate([np.zeros(0), *(np.roots([1.0, *one["a"]]) for one in found.values())])
    sizes = np.abs(poles[(np.imag(poles) != 0.0) & (np.real(poles) > 0.0)])
    return float(-model.sample_time / np.log(sizes.max())) if sizes.size else 0.0


def _known_cross(gains: Matrix, name: str, robot: Robot) -> Vector:
    """Return the gains beside the diagonal; raise SettingsError for one that is not finite: it would count as none."""
    for axis, row in zip(robot.outputs.names, gains, strict=True):
        for other, value in zip(robot.input_names, row, strict=True):
            if not math.isfinite(value):
                raise SettingsError(
                    f"{name}: the gain from {other} to {axis} is not known ({value:g} of the axis's own); record runs "
                    "of 100 samples or more in which every input moves, and identify it again."
                )
    return off_diagonal(gains)


def off_diagonal(matrix: Matrix) -> Vector:
    """Return the off-diagonal entries (m (m - 1),) of a matrix (m, m), row by row."""
    return np.asarray(matrix)[~np.eye(len(matrix), dtype=bool)]


def mixing_matrix(cross: np.ndarray, axes: int) -> np.ndarray:
    """Return X (..., m, m) of the inputs X v: ones on the diagonal, `cross` (..., m (m - 1)) beside it."""
    X = np.zeros((*cross.shape[:-1], axes, axes))
    X[..., np.eye(axes, dtype=bool)] = 1.0
    X[..., ~np.eye(axes, dtype=bool)] = cross
    return X


def source_of_model(model: Any, name: str, spread: Mapping[str, float]) -> PlantSource:
    """Return a linear model as a source of plants within +-`gain` and +-`pole` (relative) and +-`delay` [s] of it."""
    plants, robot = [], robot_of(model)
    names = robot.outputs.names
    for axis in names:
        try:
            plants.append(axis_plant(model, axis))
        except SettingsError as error:
            raise SettingsError(f"{name}: {error}") from error
        if plants[-1].static_gain == 0.0:
            raise SettingsError(f"{name}: {axis} has a static gain of 0: no controller holds it at a set-point.")
    if not all(math.isclose(plants[0].sample_time, plant.sample_time, rel_tol=1e-9) for plant in plants):
        raise SettingsError(f"{name}: {' and '.join(names)} have different sample times.")
    return PlantSource(
        name=name, sample_time=plants[0].sample_time, axes=tuple(_axis_of(plant, spread) for plant in plants),
        cross=_cross_gains(model, plants, name), kind="model", robot=robot, weights=directions_of(model),
        decay=_decay_of(model),
    )  # fmt: skip


def _axis_of(plant: AxisPlant, spread: Mapping[str, float]) -> AxisBox:
    poles = np.roots(plant.denominator)
    slowest = complex(poles[int(np.argmax(np.abs(poles)))]) if poles.size else 0j
    gain, Ts = plant.static_gain, plant.sample_time
    dead = plant.delay * Ts
    if abs(slowest.imag) > 1e-9 or slowest.real <= 1e-6:
        # Without a slowest real pole the whole model is certain but for gain and delay.
        nominal = np.array([gain, _INVISIBLE_POLE / Ts, dead])
        rest = (np.append(plant.numerator, 0.0) / gain, plant.denominator)
        pole_spread = 0.0
    else:
        a = slowest.real
        others = np.atleast_1d(np.real(np.poly(np.delete(poles, int(np.argmax(np.abs(poles)))))))
        nominal = np.array([gain, -math.log(a) / Ts, dead])
        # The first-order part is (1 - a)/(z - a); the rest is B over all other poles.
        rest = (plant.numerator / (gain * (1.0 - a)), others)
        pole_spread = spread["pole"]
    half = np.array([abs(gain) * spread["gain"], nominal[1] * pole_spread, spread["delay"]])
    low, high = nominal - half, nominal + half
    low[2] = max(low[2], 0.0)
    return AxisBox(nominal=nominal, low=low, high=high, samples=np.zeros((0, 3)), rest=rest)


def _cross_gains(model: Any, plants: list[AxisPlant], name: str) -> Vector:
    """Return the static gains from the other axes' inputs to each axis over its own gain."""
    robot = robot_of(model)
    if "input" not in inspect.signature(model.tf).parameters:
        return np.zeros(len(plants) * (len(plants) - 1))  # a model of single axes
    gains = [[np.real(model.tf(axis, input=other).dcgain()) / plant.static_gain for other in robot.input_names]
             for axis, plant in zip(robot.outputs.names, plants, strict=True)]  # fmt: skip
    cross = _known_cross(np.array(gains), name, robot)
    # Remove rounding errors of decoupled axes.
    return np.where(np.abs(cross) < _CROSS_TOLERANCE, 0.0, cross)


def make_plants(neck: PlantSource, numbers: np.ndarray, names: list[str], *, source: int = 0) -> Plants:
    """Return exactly discretised plants with `numbers` (n, axes, 3), within the weight of a tested family."""
    Ts = neck.sample_time
    numbers = np.stack([within_weight(numbers[:, i], box, Ts) for i, box in enumerate(neck.axes)], axis=1)
    parts = [discretize_axis(numbers[:, i], box.rest, Ts) for i, box in enumerate(neck.axes)]
    q = max(part[0].shape[1] for part in parts)
    padded = [[np.pad(p, ((0, 0), (0, q - p.shape[1]))) for p in part[:2]] for part in parts]
    # Zeros appended to both polynomials of an axis are poles and zeros at 0 that cancel.
    numerator, denominator = (np.stack([part[k] for part in padded], axis=1) for k in (0, 1))
    delay = np.stack([part[2] for part in parts], axis=1)
    n = len(numbers)
    return Plants(
        Ts, numbers, np.tile(neck.cross, (n, 1)), tuple(names), np.full(n, source), numerator, denominator, delay,
        neck.names, neck.gain_unit.replace("/", "_per_"),
    )  # fmt: skip


def measured_plant(neck: PlantSource, source: int) -> Plants | None:
    """Return the middle of the measured responses, of one to three poles; None without a tested family."""
    models = [box.measured.model for box in neck.axes if box.measured is not None]
    if len(models) < len(neck.axes):
        return None
    parts = [model.discretize(neck.sample_time) for model in models]
    # As in `response_of`: b/(z A) after the whole samples of delay.
    above, below = (
        np.array([np.pad(row, (0, 5 - row.size)) for row in rows])
        for rows in ([np.append(0.0, b) for _, b, _ in parts], [np.append(1.0, a) for a, _, _ in parts])
    )
    numbers = [[m.b[0] / m.a[-1], -np.roots(np.append(1.0, m.a)).real.max(), m.delay] for m in models]
    return Plants(
        neck.sample_time, np.array([numbers]), neck.cross[None], (f"{neck.name}: middle of its recordings",),
        np.array([source]), above[None], below[None], np.array([[d for _, _, d in parts]]), neck.names,
        neck.gain_unit.replace("/", "_per_"),
    )  # fmt: skip


def nominal_plants(necks: list[PlantSource]) -> list[Plants]:
    """Return the nominal plant of each source."""
    return [
        make_plants(neck, np.stack([box.nominal for box in neck.axes])[None], [f"{neck.name}: nominal"], source=i)
        for i, neck in enumerate(necks)
    ]


def all_plants(necks: list[PlantSource], count: int, seed: int) -> Plants:
    """Return nominal plants, corners, samples and, up to `count` in all, a Latin hypercube inside the boxes.

    Corners of the first axis are combined with equal and with opposite ones of every other axis.
    """
    share = max(1, count // len(necks))
    return join([_plants_of(neck, share, seed + i, i) for i, neck in enumerate(necks)])


def _plants_of(neck: PlantSource, count: int, seed: int, source: int) -> Plants:
    from scipy.stats import qmc

    m = len(neck.axes)
    numbers: list[np.ndarray] = [np.stack([box.nominal for box in neck.axes])]
    names = [f"{neck.name}: nominal"]
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    for first, opposite in itertools.product(range(8), (False, True) if m > 1 else (False,)):
        chosen = [signs[7 - first] if opposite and i % 2 else signs[first] for i in range(m)]
        numbers.append(np.stack([_corner(box, s) for box, s in zip(neck.axes, chosen, strict=True)]))
        texts = ["".join("+" if value > 0 else "-" for value in s) for s in chosen]
        told = ", ".join(f"{text} of {axis}" for text, axis in zip(texts, neck.names, strict=True))
        names.append(f"{neck.name}: corner {told}")
    sizes = [len(box.samples) for box in neck.axes]
    for k in range(max(sizes)):
        rows = [k % size for size in sizes]
        numbers.append(np.stack([box.samples[row] for box, row in zip(neck.axes, rows, strict=True)]))
        told = ", ".join(f"{row} of {axis}" for row, axis in zip(rows, neck.names, strict=True))
        names.append(f"{neck.name}: sample {told}")
    inside = max(0, count - len(numbers))
    if inside:
        drawn = qmc.LatinHypercube(d=3 * m, rng=np.random.default_rng(seed)).random(inside)
        drawn = drawn.reshape(inside, m, 3)
        low, high = (np.stack([getattr(box, end) for box in neck.axes]) for end in ("low", "high"))
        numbers += list(low + drawn * (high - low))
        names += [f"{neck.name}: inside {k}" for k in range(inside)]
    made, middle = make_plants(neck, np.array(numbers), names, source=source), measured_plant(neck, source)
    return made if middle is None else join([made, middle])


def _corner(box: AxisBox, signs: Vector) -> Vector:
    return np.where(signs > 0.0, box.high, box.low)


def join(parts: list[Plants]) -> Plants:
    """Return the plants of several objects as one."""
    q = max(part.numerator.shape[2] for part in parts)

    joined: Any = {}
    for name in ("numbers", "cross", "source", "delay", "numerator", "denominator"):
        rows = [getattr(part, name) for part in parts]
        if name in ("numerator", "denominator"):
            rows = [np.pad(row, ((0, 0), (0, 0), (0, q - row.shape[2]))) for row in rows]
        joined[name] = np.concatenate(rows)
    return replace(parts[0], names=tuple(name for part in parts for name in part.names), **joined)
