"""Indirect adaptive control: settings, the loop that its redesign keeps, and its checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, Vector, require_between, write_archive
from softneck.estimation import NECK_REACH, AxisPlant, linear_reach
from softneck.robot import Robot, Scaling, find_robot
from softneck.runtime import Block, Port, SteppedMixin, sized_name

from ..linear._axis_loop import LOWEST, filter_for_lag, frequencies
from ..linear._controller import ReferenceFilter, assemble, pi_axis, robot_in
from ..linear._linear_parts_runtime import LinearArrays
from ..linear._ports import ControllerLimits, controller_inputs, controller_outputs
from ..linear._settings import LoopSettings
from ..plants._uncertain import UncertainPlant, scale_gain, uncertain_plant
from ._adaptive_runtime import AdaptiveArrays

_RUNTIME_MODULE = "softneck.design.varying._adaptive_runtime"
_UNSAID = ("integer", "display_unit", "tunable")
_ADAPT = Port(name="adapt", description="1: learn; 0: nominal gains", start=1.0, minimum=0.0, maximum=1.0)
# Sizes of the loop kappa z^-d / (z - 1) that are tried, 1 % apart.
_LOOP_SIZES = np.geomspace(1e-3, 1.0, 695)
# The paper's static gain [rad/rad], 27.69 / 5.293 deg/rad (Eq. 31).
_SCALED_GAIN = math.radians(27.69 / 5.293)


# Of the reference filter, in scaled seconds.
_REFERENCE_TIME_S = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class Learning:
    """Constants of the estimation, for a plant with the neck's static gain, reach and pole.

    Attributes:
        forgetting: lambda of the recursion, for the samples it takes in; 4 s of motion.
        start_covariance: diagonal of F(0); small trusts the identified plant, so that no first step is one of learning:
            one step of 15 deg teaches about as much.
        covariance_bound: on the trace of F.
        dead_zone: errors of the band-passed angle up to this [rad], the filtered noise of the 3DM inclinometer, teach
            nothing.
        excitation: band-passed input [rad], rms over the last second, below which nothing is learnt.
        band: centre of the band-pass of the regression [rad/s]: the neck's own pole, and about the crossover.
        pole_range: the pole stays within the nominal one divided and multiplied by this.
        distrust: the nominal plant is used where its mean square prediction error is this many times smaller.
        gain_rate: change of lag and gain in use [1/s].
        leak_time: over which the integral gives up what is beyond a limit [s].
    """

    forgetting: float = 0.995
    start_covariance: float = 0.5
    covariance_bound: float = 100.0
    dead_zone: float = math.radians(0.02)
    excitation: float = 0.05
    band: float = 5.0
    pole_range: float = 2.0
    distrust: float = 1.5
    gain_rate: float = 1.0
    leak_time: float = 3.0

    def scale(self, size: float, second: float) -> Learning:
        """Return them for outputs that go `size` times as far, where a scaled second is `second` [s]."""
        # Inputs and outputs have the neck's ratio: a covariance goes by 1 / size^2.
        return replace(
            self, start_covariance=self.start_covariance / size**2, covariance_bound=self.covariance_bound / size**2,
            dead_zone=self.dead_zone * size, excitation=self.excitation * size, band=self.band / second,
            gain_rate=self.gain_rate / second, leak_time=self.leak_time * second,
        )  # fmt: skip


LEARNING = Learning()


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptiveSettings(LoopSettings):
    """Online recursive least squares and a redesign in every sample, with safeguards.

    Limits and the order of the loop are those of `LoopSettings`. The nominal plant is taken as late and as quick as
    small moves are (`ModelUncertainty`). The numbers of the learning are in `Learning`, in scaled quantities.

    Attributes:
        max_sensitivity: bound on Ms of the loop that every redesign makes, with its delay in full.
        phase_margin: least phase margin [rad] of it.
        gain_range: the static gain stays within this part of the nominal one, up and down, 0.5 for half to 1.5 times.
        reference_time: time constant of the reference filter [s]; None: 0.3 time constants, of the neck 0.06 s.
    """

    LEAD: ClassVar[float] = 0.8

    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    gain_range: float = 0.5
    reference_time: float | None = None

    def __post_init__(self) -> None:
        LoopSettings.__post_init__(self)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")
        require_between("gain_range", self.gain_range, 0.0, 0.9)
        if self.reference_time is not None:
            require_between("reference_time", self.reference_time, 0.0, 1e6, "s")

    def design(self, model: Any, *, robot: Robot | str | Path | None = None) -> VaryingController:
        """Return the controller that starts from `model`, of one pole and a dead time in each axis.

        Args:
            model: whatever `uncertain_plant` takes but a list; its nominal plant counts.
            robot: whose limits count, itself, a preset or a file; None: those that the model says.

        Raises:
            SettingsError: another model, or a box that the nominal gains do not stand.
        """
        if isinstance(model, Sequence):
            raise SettingsError(
                f"adaptive control starts from one model or a family; got {len(model)} models. Name one."
            )
        uncertain = uncertain_plant(model, None if robot is None else find_robot(robot))
        asked = self.of_robot(uncertain)
        nominal = [axis.nominal for axis in uncertain.axes.values()]
        second = max(plant.second for plant in nominal)
        if Scaling.of(uncertain.robot).is_identity and uncertain.robot.motors.nominal is not None:
            ones = np.ones(len(uncertain.names))
            return asked._design_scaled(uncertain, LEARNING.scale(1.0, second), uncertain.redefinition, ones)
        # Inputs in such a unit that every static gain has the neck's size: what learns need not know the robot's units.
        units = np.array([_SCALED_GAIN / abs(plant.static_gain) for plant in nominal])
        T, inverse = uncertain.redefinition
        T, inverse = T.copy(), inverse.copy()
        T[:-1] /= units[:, None]
        inverse[:, :-1] *= units
        size = linear_reach(nominal, uncertain.robot, np.asarray(uncertain.weights)) / NECK_REACH
        return asked._design_scaled(uncertain, LEARNING.scale(size, second), (T, inverse), units)

    def _defaults(self, plant: UncertainPlant) -> dict[str, Any]:
        second = max(axis.nominal.second for axis in plant.axes.values())
        return {**LoopSettings._defaults(self, plant), "reference_time": _REFERENCE_TIME_S * second}

    def _design_scaled(
        self, uncertain: UncertainPlant, learning: Learning, redefinition: tuple[Matrix, Matrix], units: Vector
    ) -> VaryingController:
        """Return the controller: `units` of the inputs (axes,)."""
        names, robot = uncertain.names, uncertain.robot
        plants = [self._plant(uncertain, axis, unit) for axis, unit in zip(names, units.tolist(), strict=True)]
        Ts = plants[0].sample_time
        delays = [plant.delay + self.extra_delay for plant in plants]
        kappas = [self._loop(plant, delay) for plant, delay in zip(plants, delays, strict=True)]
        worst = [
            self._box_sensitivity(axis, plant, delay, kappa)
            for axis, plant, delay, kappa in zip(names, plants, delays, kappas, strict=True)
        ]
        found = {
            axis: {"static_gain": plant.static_gain / float(unit), "pole": _pole(plant), "kappa": kappa,
                   "largest_ms_nominal": ms, "dead_time_s": delay * Ts}
            for axis, plant, kappa, ms, delay, unit in zip(names, plants, kappas, worst, delays, units, strict=True)
        }  # fmt: skip
        return VaryingController(
            sample_time=Ts,
            arrays=self._arrays(plants, delays, kappas, self.limits(robot), redefinition, learning),
            limits=self.limits(robot),
            order=self.order,
            lines=tuple(_line(axis, values, robot) for axis, values in found.items()),
            design={"settings": asdict(self), "extra_delay": self.extra_delay, **found},
        )

    def _plant(self, uncertain: UncertainPlant, name: str, unit: float) -> AxisPlant:
        axis = uncertain.axis(name)
        plant = scale_gain(axis.nominal, unit)
        if plant.order != 1 or plant.denominator[1] >= 0.0:
            raise SettingsError(
                f"{name}: adaptive control takes a plant of one pole and a dead time; this one is of order "
                f"{plant.order}. Identify `rls` or `oe` of order 1."
            )
        late, pole = plant.with_min_delay(axis.uncertainty.least_delay), axis.uncertainty.small_move_pole
        return late.with_faster_pole(pole) if pole > 0.0 else late

    def _loop(self, plant: AxisPlant, delay: int) -> float:
        """Return the largest kappa up to which kappa z^-d/(z - 1) keeps both bounds."""
        w = frequencies(plant.sample_time, lowest=1e-3 / plant.sample_time)
        z = np.exp(1j * w * plant.sample_time)
        shape = z ** (-delay) / (z - 1.0)
        best = 0.0
        for size in _LOOP_SIZES:
            L = size * shape
            # |L| falls with the frequency, so it crosses 1 once.
            crossing = L[np.abs(L) >= 1.0]
            margin = abs(float(np.angle(-crossing[-1]))) if crossing.size else math.pi
            if np.min(np.abs(1.0 + L)) * self.max_sensitivity < 1.0 or margin < self.phase_margin:
                break
            best = float(size)
        if best == 0.0:
            raise SettingsError(f"no gain keeps Ms and the phase margin with a delay of {delay} samples; ask for less.")
        return best

    def _box_sensitivity(self, axis: str, plant: AxisPlant, delay: int, kappa: float) -> float:
        """Return the largest Ms of the nominal gains at the corners of the box; refuse an unstable one."""
        a0, b0 = -float(plant.denominator[1]), float(plant.numerator[0])
        w = frequencies(plant.sample_time, lowest=LOWEST / plant.second)
        z = np.exp(1j * w * plant.sample_time)
        worst = 0.0
        low, high, weak, strong = self._box(plant)
        for a in (low, high):
            for gain in (weak, strong):
                b = gain * (1.0 - a)
                above = kappa * b / b0 * np.array([1.0, -a0])
                below = np.convolve([1.0, -1.0], np.append([1.0, -a], np.zeros(delay)))
                radius = float(np.abs(np.roots(np.polyadd(above, below))).max())
                if radius >= 1.0:
                    raise SettingsError(
                        f"{axis}: the nominal gains, which must hold where nothing was learnt, are not stable at a "
                        f"corner of the box (spectral radius {radius:.4f}); lower `gain_range` or `max_sensitivity`."
                    )
                S = 1.0 / (1.0 + np.polyval(above, z) / np.polyval(below, z))
                worst = max(worst, float(np.abs(S).max()))
        return worst

    def _box(self, plant: AxisPlant) -> Vector:
        """Return lower and upper bounds of a and of the static gain."""
        a, K = -float(plant.denominator[1]), plant.static_gain
        gains = sorted((K * (1.0 - self.gain_range), K * (1.0 + self.gain_range)))
        return np.array([a**LEARNING.pole_range, a ** (1.0 / LEARNING.pole_range), *gains])

    def _filters(self, plants: list[AxisPlant]) -> tuple[ReferenceFilter, ...]:
        """Return the reference filters, the last of co-contraction."""
        if self.rise_s is None:
            return (ReferenceFilter(self.reference_time or 0.0),) * (len(plants) + 1)
        each = [filter_for_lag(self.rise_s, 1.0 / _pole(plant)) for plant in plants]
        return (*each, ReferenceFilter(max(item.time for item in each)))

    def _arrays(
        self, plants: list[AxisPlant], delays: list[int], kappas: list[float], limits: ControllerLimits,
        redefinition: tuple[Matrix, Matrix], learning: Learning,
    ) -> dict[str, Matrix]:  # fmt: skip
        """Return the arrays of the runtime by name."""
        Ts = plants[0].sample_time
        common = assemble(
            [pi_axis(1.0, plants[0].second, Ts)] * len(plants),
            filters=self._filters(plants),
            redefinition=redefinition,
            constants=limits.constants(Ts),
        )
        guards = [
            learning.forgetting, learning.covariance_bound, learning.dead_zone,
            max(-float(plant.denominator[1]) for plant in plants) ** (1.0 / (2.0 * learning.pole_range)),
            learning.excitation, math.exp(-learning.band * Ts), learning.distrust, min(learning.gain_rate * Ts, 0.5),
            Ts / learning.leak_time, learning.start_covariance,
        ]  # fmt: skip
        arrays = dict(zip(LinearArrays.names(), common, strict=True)) | {
            "nominal": np.array([[-plant.denominator[1], plant.numerator[0]] for plant in plants]),
            "box": np.array([self._box(plant) for plant in plants]),
            "delays": np.array(delays, dtype=np.float64),
            "loop": np.array(kappas),
            "guards": np.array(guards),
        }
        return {name: arrays[name] for name in AdaptiveArrays.names()}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class VaryingController(SteppedMixin, ReprMixin):
    """A controller of all outputs whose gains follow its estimates.

    Attributes:
        sample_time: [s].
        arrays: by name, in the runtime's order.
        limits: of the set-points.
        order: of the loop it is for.
        lines: for `summary`.
        design: JSON values: settings and what was found.
    """

    sample_time: float
    arrays: Mapping[str, Matrix]
    limits: ControllerLimits
    order: str
    lines: tuple[str, ...]
    design: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """Its name in the table of kinds."""
        return "adaptive"

    @property
    def robot(self) -> Robot:
        """Whose controller it is."""
        return self.limits.robot

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return Block(
            kind=self.kind,
            role="controller",
            runtime=sized_name(_RUNTIME_MODULE, len(self.robot.motors.names), len(self.robot.outputs.names)),
            sample_time=self.sample_time,
            arrays=tuple(self.arrays.values()),
            inputs=controller_inputs(self.robot),
            outputs=controller_outputs(self.robot),
            parameters=(*self.limits.ports(), _ADAPT),
        )

    def summary(self) -> str:
        """Return some lines for people."""
        head = (
            f"{self.kind} controller, {self.sample_time * 1e3:g} ms, {self.order} order, "
            f"{self.design.get('extra_delay', 0)} samples of delay added to the plant for it"
        )
        return "\n".join([head, *self.limits.lines(self.sample_time), *self.lines])

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller to one `.npz` file."""
        header = {
            **self.block().in_header(),
            "limits": self.limits.header(),
            "order": self.order,
            "names": list(self.arrays),
            # Files of format 1 do not say these: none is an integer or tunable.
            "parameters": [{k: v for k, v in asdict(_ADAPT).items() if k not in _UNSAID}],
            "lines": list(self.lines),
            "design": dict(self.design),
            **self.robot.in_header(),
        }
        write_archive(path, header, self.arrays, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> VaryingController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        return cls(
            sample_time=float(header["sample_time"]),
            arrays=AdaptiveArrays.read(arrays),
            limits=ControllerLimits.from_header(header["limits"], robot_in(header)),
            order=str(header["order"]),
            lines=tuple(str(line) for line in header["lines"]),
            design=dict(header["design"]),
        )


def _pole(plant: AxisPlant) -> float:
    return -math.log(-float(plant.denominator[1])) / plant.sample_time


def _line(axis: str, found: dict[str, float], robot: Robot) -> str:
    per, unit = robot.shown_gain
    gain = per * found["static_gain"]
    return (
        f"  {axis}: starts from {gain:.3g} {unit}, pole {found['pole']:.3g} 1/s, dead time "
        f"{1e3 * found['dead_time_s']:g} ms; kappa {found['kappa']:.3g}; largest Ms of the nominal gains in the box "
        f"{found['largest_ms_nominal']:.3g}"
    )
