"""Gain scheduling over the inclination: a robust PI at every operating point, interpolated without bumps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between
from softneck.estimation import AxisPlant
from softneck.estimation._axis import HasTransferFunctions, robot_of
from softneck.identification import Family
from softneck.identification.uncertainty._lpv import require_inclination
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault

from ..linear._assembly import AxisController, ReferenceFilter, assemble
from ..linear._axis_settings import slowest
from ..linear._linear_parts_runtime import LinearArrays
from ..linear._loop_settings import LoopSettings
from ..linear._margins import LOWEST, frequencies
from ..linear._rise import filter_for_lag
from ..linear._tuning import Gains, tune_pi
from ..plants._uncertain import UncertainPlant, uncertain_plant
from ._operating_points import OperatingPoint, family_points, model_points
from ._varying import RUNTIMES, VaryingController


def following_axis(gains: Gains, plant: AxisPlant, delay: int, leak_time: float) -> AxisController:
    """Return `v = r/G0 + K (ym - y) + s`, `s+ = s + K Ts/Ti (ym - y)`, `ym = z^-d (1 - a)/(z - a) r`.

    The static gain G0 and the pole a are the plant's: if it is as modelled, y follows ym, the feedback rests, and the
    response is that of the plant with its input filtered as the reference is (Astrom and Hagglund 2006, Advanced PID
    Control, sec. 5.4). Loop and margins are those of the PI alone.

    Conditioning: the model gets what the motors can do instead of what was asked, so that it waits for a limited
    input; the integral besides leaks what is beyond a limit, over `leak_time`.

    States: s, the model's lag, its delay line. All mean the same for all gains.

    Args:
        gains: K and Ti.
        plant: of order one, or of any with the slowest pole taken.
        delay: of the model beyond its first sample [samples].
        leak_time: [s].
    """
    Ts = plant.sample_time
    a = float(np.abs(np.roots(plant.denominator)).max(initial=0.0))
    forward, K, rate = 1.0 / plant.static_gain, gains.gain, gains.gain * Ts / gains.integral_time
    n = 2 + delay
    A = np.zeros((n, n))
    A[0, 0], A[1, 1] = 1.0, a
    A[0, -1] += rate
    for i in range(2, n):
        A[i, i - 1] = 1.0
    Br, By, C, L = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((1, n)), np.zeros((n, 1))
    Br[1], By[0] = 1.0 - a, -rate
    C[0, 0], C[0, -1] = 1.0, K
    L[0], L[1] = Ts / leak_time, (1.0 - a) / forward
    return AxisController(A=A, Br=Br, By=By, C=C, Dr=forward, Dy=-K, L=L)


# The arrays that follow the inclination.
_VARYING = ("A", "Br", "By", "C", "Dr", "Dy", "L", "align")
# Between two operating points the loop is judged at so many places.
_BETWEEN = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledSettings(LoopSettings):
    """PI at every operating point of a family, gains linear over the inclination between them.

    The inclination is that of the platform of a neck, or of another robot with one or two angles; its times are
    stretched by its slowest pole.

    Limits, the order of the loop and what is doubted of the plant are those of `LoopSettings`.

    Attributes:
        max_sensitivity: bound on Ms at every operating point, on every plant there.
        phase_margin: least phase margin [rad] there.
        inclinations: [rad] of several models given by themselves, one each; empty for a family, which knows its own.
        schedule_time: time constant of the lag through which the inclination is seen [s].
        reference_time: time constant of the reference filter [s].
        leak_time: over which the integral gives up what is beyond a limit [s].
    """

    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    inclinations: tuple[float, ...] | list[float] = ()
    # As slow as the loop's own time constant.
    schedule_time: float = NeckDefault(0.3)
    # The model that is followed is the filter; this one only keeps the slew limit out of a step.
    reference_time: float = NeckDefault(0.06)
    leak_time: float = NeckDefault(3.0)
    lead_limit: float = NeckDefault(0.8)

    def __post_init__(self) -> None:
        LoopSettings.__post_init__(self)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")
        require_between("schedule_time", self.schedule_time, 0.0, 1e6, "s")
        require_between("reference_time", self.reference_time, 0.0, 1e6, "s")
        require_between("leak_time", self.leak_time, 0.1, 1e6, "s")
        for inclination in self.inclinations:
            require_between("inclinations", inclination, 0.0, 1.5, "rad")

    def design(self, plant: Family | Sequence[HasTransferFunctions]) -> VaryingController:
        """Return the controller for a family, or for several linear models at `inclinations`.

        Raises:
            SettingsError: fewer than two operating points, no gains that keep the robustness, a loop between two
                points that does not keep it, or a robot that has no inclination.
        """
        robot = robot_of(plant[0] if isinstance(plant, Sequence) else plant)
        require_inclination(robot, "scheduling over the inclination")
        if robot.is_neck:
            return self._designed(plant, robot, self.neck_redefinition())
        uncertain = uncertain_plant(plant)
        return self.of_robot(uncertain)._designed(plant, robot, self.redefinition(uncertain))

    def _others(self, plant: UncertainPlant) -> dict[str, Any]:
        stretch = max(axis.nominal.stretch for axis in plant.axes.values())
        times = ("schedule_time", "reference_time", "leak_time")
        return {**LoopSettings._others(self, plant), **{name: stretch * float(getattr(self, name)) for name in times}}

    def _designed(
        self, plant: Family | Sequence[HasTransferFunctions], robot: Robot, redefinition: tuple[Matrix, Matrix]
    ) -> VaryingController:
        names = robot.outputs.names
        points = [self._with_doubt(point) for point in self._points(plant)]
        sample_time = points[0].plants[0][0].sample_time
        gains = [tuple(self._tune(point, axis, name) for axis, name in enumerate(names)) for point in points]
        memory = math.exp(-sample_time / self.schedule_time) if self.schedule_time > 0.0 else 0.0
        limits = self.limits(robot)
        arrays = self._arrays(points, gains, redefinition, limits.constants(sample_time)) | {
            "knots": np.array([point.inclination for point in points]),
            "memory": np.array([memory]),
        }
        found = self._between(points, gains, names)
        return VaryingController(
            kind="scheduled",
            runtime=RUNTIMES["scheduled"],
            sample_time=sample_time,
            arrays=arrays,
            limits=limits,
            order=self.order,
            lines=tuple(_lines(points, gains, found, names)),
            design={
                "settings": asdict(self),
                "extra_delay": self.extra_delay,
                "inclinations_deg": [math.degrees(point.inclination) for point in points],
                "gains": [[asdict(axis) for axis in pair] for pair in gains],
                "largest_ms": found,
            },
        )

    def _points(self, plant: Family | Sequence[HasTransferFunctions]) -> list[OperatingPoint]:
        if isinstance(plant, Family):
            if self.inclinations:
                raise SettingsError("`inclinations` are for several models; a family knows its own. Leave them out.")
            return family_points(plant)
        models = list(plant) if isinstance(plant, Sequence) else [plant]
        return model_points(models, self.inclinations)

    def _with_doubt(self, point: OperatingPoint) -> OperatingPoint:
        """Return the point with what the axes may be besides: later, and faster in small moves."""
        pairs = []
        for plants in point.plants:
            late = [plant.delayed(self.least_delay) for plant in plants]
            quick = [late[0].faster(self.small_move_pole)] if self.small_move_pole > 0.0 else []
            pairs.append((*late, *(plant for plant in quick if plant is not late[0])))
        return OperatingPoint(point.inclination, tuple(pairs))

    def _followed(self, plant: AxisPlant) -> AxisPlant:
        """Return the plant whose response is asked for: no slower than small moves are."""
        return plant.faster(self.small_move_pole) if self.small_move_pole > 0.0 else plant

    def _tune(self, point: OperatingPoint, axis: int, name: str) -> Gains:
        try:
            return tune_pi(point.plants[axis], self.extra_delay, self.max_sensitivity, self.phase_margin)
        except SettingsError as error:
            where = f"{name} at {math.degrees(point.inclination):.3g} deg of inclination"
            raise SettingsError(f"{where}: {error}") from error

    def _arrays(
        self, points: Sequence[OperatingPoint], gains: Sequence[Sequence[Gains]],
        redefinition: tuple[Matrix, Matrix], constants: Vector,
    ) -> dict[str, Matrix]:  # fmt: skip
        """Return the arrays of the runtime: those of every point below each other where they differ."""
        # One delay line for all points of an axis, or their states would not mean the same.
        m = len(points[0].plants)
        delays = [max(point.plants[axis][0].delay for point in points) + self.extra_delay for axis in range(m)]
        axes = [
            [
                following_axis(pair[axis], self._followed(point.plants[axis][0]), delays[axis], self.leak_time)
                for point, pair in zip(points, gains, strict=True)
            ]
            for axis in range(m)
        ]
        filters = self._filters([points[len(points) // 2].plants[axis][0] for axis in range(m)])
        each = [
            assemble(
                there,
                filters=filters,
                redefinition=redefinition,
                constants=constants,
            )
            for there in zip(*axes, strict=True)
        ]
        return {
            name: np.vstack([arrays[i] for arrays in each]) if name in _VARYING else each[0][i]
            for i, name in enumerate(LinearArrays.names())
        }

    def _filters(self, plants: Sequence[AxisPlant]) -> tuple[ReferenceFilter, ...]:
        """Return the reference filters, the last of co-contraction: for `rise_s` at the middle operating point."""
        if self.rise_s is None:
            return (ReferenceFilter(self.reference_time),) * (len(plants) + 1)
        each = [filter_for_lag(self.rise_s, self._followed(plant).time_constant) for plant in plants]
        return (*each, slowest(each))

    def _between(
        self, points: Sequence[OperatingPoint], gains: Sequence[Sequence[Gains]], names: tuple[str, ...]
    ) -> float:
        """Return the largest Ms of all frozen loops at and between the points; refuse an unstable one.

        Between two points the plants of both must stand the gains there.
        """
        worst = 0.0
        for low in range(len(points) - 1):
            for part in np.linspace(0.0, 1.0, _BETWEEN + 1):
                for axis, name in enumerate(names):
                    mixed = _mixed(gains[low][axis], gains[low + 1][axis], float(part))
                    for plant in (points[low].plants[axis][0], points[low + 1].plants[axis][0]):
                        where = points[low].inclination + part * (points[low + 1].inclination - points[low].inclination)
                        worst = max(worst, self._sensitivity(plant, mixed, name, float(where)))
        return worst

    def _sensitivity(self, plant: AxisPlant, gains: Gains, axis: str, inclination: float) -> float:
        """Return Ms of a frozen loop, whose stability is read off its closed-loop poles."""
        rate = plant.sample_time / gains.integral_time
        above = np.convolve(gains.gain * np.array([1.0, rate - 1.0]), plant.numerator)
        below = np.convolve([1.0, -1.0], np.append(plant.denominator, np.zeros(plant.delay + self.extra_delay)))
        radius = float(np.abs(np.roots(np.polyadd(above, below))).max())
        if radius >= 1.0:
            raise SettingsError(
                f"{axis} at {math.degrees(inclination):.3g} deg, between two operating points, is not stable (spectral "
                f"radius {radius:.4f}): the points differ too much; give more of them."
            )
        w = frequencies(plant.sample_time, lowest=LOWEST / plant.stretch)
        pi = gains.gain * (1.0 + rate / (np.exp(1j * w * plant.sample_time) - 1.0))
        return float(np.max(1.0 / np.abs(1.0 + pi * plant.response(w, extra_delay=self.extra_delay))))


def _mixed(low: Gains, high: Gains, part: float) -> Gains:
    """Return the gains between: K and K/Ti are linear, as the runtime's matrices are."""
    gain = (1.0 - part) * low.gain + part * high.gain
    rate = (1.0 - part) * low.gain / low.integral_time + part * high.gain / high.integral_time
    return Gains(gain, gain / rate)


def _lines(
    points: Sequence[OperatingPoint], gains: Sequence[Sequence[Gains]], worst: float, names: tuple[str, ...]
) -> list[str]:
    lines = [
        f"  at {math.degrees(point.inclination):5.1f} deg: "
        + "; ".join(f"{name} K {g.gain:.4g}, Ti {g.integral_time:.3g} s" for name, g in zip(names, pair, strict=True))
        for point, pair in zip(points, gains, strict=True)
    ]
    return [*lines, f"  largest Ms of all loops at and between these inclinations: {worst:.3g}"]
