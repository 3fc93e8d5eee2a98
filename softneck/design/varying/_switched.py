"""A controller for each of several payloads, of which the estimated payload chooses one as the loop runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, require_between
from softneck.estimation import AxisPlant
from softneck.estimation._axis import HasTransferFunctions
from softneck.identification import Family
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.runtime import Port
from softneck.signals.recording._recording import require_same_robot

from ..linear._loop_settings import LoopSettings
from ..linear._margins import LOWEST, frequencies
from ..linear._tuning import Gains, tune_pi
from ..plants._uncertain import UncertainPlant, uncertain_plant
from ._operating_points import OperatingPoint
from ._scheduled import ScheduledSettings
from ._varying import RUNTIMES, VaryingController

# A dwell time longer than this [s of a neck] is not looked for: payloads come and go sooner.
_LONGEST_DWELL = 30.0
#: What the estimator says, behind the inputs of every controller.
INPUTS = (
    Port(name="payload", unit="kg", description="estimated payload: which controller acts"),
    Port(name="changed", description="no payload explains the neck: the reference is slowed", boolean=True),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchedSettings(LoopSettings):
    """PI at each of several payloads, chosen by the estimated payload, without bumps and no sooner than a dwell time.

    Limits, the order of the loop and what is doubted of the plant are those of `LoopSettings`.

    Attributes:
        payloads: [kg] of the models or families, one each.
        max_sensitivity: bound on Ms of the gains of each payload, on every plant there and at the next payloads.
        phase_margin: least phase margin [rad] there.
        dwell_time: between two switches [s], at the least; longer where the design needs it.
        margin: by which the estimate must be past the middle between two payloads, as a part of their distance.
        slow_rate: of the reference [rad/s] while the neck is one that no payload explains.
        reference_time: time constant of the reference filter [s].
        leak_time: over which the integral gives up what is beyond a limit [s].
    """

    payloads: tuple[float, ...] | list[float] = ()
    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    dwell_time: float = NeckDefault(1.0)
    margin: float = 0.1
    # A tenth of what the paper's rotation asks for.
    slow_rate: float = math.radians(2.0)
    reference_time: float = NeckDefault(0.06)
    leak_time: float = NeckDefault(3.0)
    lead_limit: float = NeckDefault(0.8)

    def __post_init__(self) -> None:
        LoopSettings.__post_init__(self)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")
        require_between("dwell_time", self.dwell_time, 0.0, 1e6, "s")
        require_between("margin", self.margin, 0.0, 0.4)
        require_between("slow_rate", self.slow_rate, 1e-6, 1e6, "rad/s")
        require_between("reference_time", self.reference_time, 0.0, 1e6, "s")
        require_between("leak_time", self.leak_time, 0.1, 1e6, "s")
        for payload in self.payloads:
            require_between("payloads", payload, 0.0, 1e6, "kg")

    def design(self, plant: Sequence[HasTransferFunctions | Family]) -> VaryingController:
        """Return the controller for linear models or families of `payloads`.

        Raises:
            SettingsError: fewer than two payloads, no gains that keep the robustness, or gains that do not stand
                another payload until the estimate has followed.
        """
        plants = [uncertain_plant(item) for item in (plant if isinstance(plant, Sequence) else [plant])]
        if len(plants) != len(self.payloads) or len(plants) < 2 or len(set(self.payloads)) < len(plants):
            raise SettingsError(
                "a switched controller needs at least two models or families, with one of `payloads` each, no two "
                f"alike; got {len(plants)} and {len(self.payloads)} payload(s)."
            )
        for item in plants[1:]:
            require_same_robot(item.robot, plants[0].robot, "models")
            if not math.isclose(item.sample_time, plants[0].sample_time, rel_tol=1e-9):
                raise SettingsError("models of different sample times; identify them at one.")
        asked = self if plants[0].robot.is_neck else self.of_robot(plants[0])
        return asked._designed(plants, plants[0].robot, asked.redefinition(plants[0]))

    def _others(self, plant: UncertainPlant) -> dict[str, Any]:
        stretch = max(axis.nominal.stretch for axis in plant.axes.values())
        times = ("dwell_time", "reference_time", "leak_time")
        return {**LoopSettings._others(self, plant), **{name: stretch * float(getattr(self, name)) for name in times}}

    def _designed(
        self, plants: Sequence[UncertainPlant], robot: Robot, redefinition: tuple[Matrix, Matrix]
    ) -> VaryingController:
        names, Ts = robot.outputs.names, plants[0].sample_time
        points = sorted(
            (OperatingPoint(float(payload), tuple(self._axis(item, name) for name in names))
             for payload, item in zip(self.payloads, plants, strict=True)),
            key=lambda point: point.inclination,
        )  # fmt: skip
        gains = [
            tuple(self._tune(points, i, axis, name) for axis, name in enumerate(names)) for i in range(len(points))
        ]
        found = self._elsewhere(points, gains, names)
        longest = _LONGEST_DWELL * max(axis.nominal.stretch for axis in plants[0].axes.values())
        needed = max(
            _least_dwell([pair[axis] for pair in gains], item, self.extra_delay, round(longest / Ts))
            for axis in range(len(names))
            for point in points
            for item in point.plants[axis]
        )
        shown = needed * Ts <= longest
        dwell = max(round(self.dwell_time / Ts), needed if shown else 0)
        limits = self.limits(robot)
        arrays = self._inner()._arrays(points, gains, redefinition, limits.constants(Ts)) | {
            "payloads": np.array([point.inclination for point in points]),
            "switching": np.array([dwell, self.margin, self.slow_rate * Ts]),
        }
        return VaryingController(
            kind="switched",
            runtime=RUNTIMES["switched"],
            sample_time=Ts,
            arrays=arrays,
            limits=limits,
            order=self.order,
            inputs=INPUTS,
            lines=tuple(_lines(points, gains, found, names, (dwell * Ts, needed * Ts if shown else None))),
            design={
                "settings": asdict(self),
                "extra_delay": self.extra_delay,
                "payloads_kg": [point.inclination for point in points],
                "gains": [[asdict(axis) for axis in pair] for pair in gains],
                "largest_ms": found,
                "dwell_s": dwell * Ts,
                "dwell_needed_s": needed * Ts if shown else None,
            },
        )

    def _axis(self, plant: UncertainPlant, name: str) -> tuple[AxisPlant, ...]:
        """Return what an axis may be under one payload, the nominal plant first."""
        return plant.axes[name].prepared(self.least_delay, self.small_move_pole).samples

    def _inner(self) -> ScheduledSettings:
        """Return the settings of the kind that has the same arrays, over the inclination."""
        shared = {field.name for field in fields(ScheduledSettings)} & {field.name for field in fields(self)}
        return ScheduledSettings(**{name: getattr(self, name) for name in shared})

    def _tune(self, points: Sequence[OperatingPoint], i: int, axis: int, name: str) -> Gains:
        """Return the gains of one payload; they keep the bounds at the next ones too, to which it may be on the way."""
        plants = points[i].plants[axis]
        for other in (*points[max(i - 1, 0) : i], *points[i + 1 : i + 2]):
            plants += other.plants[axis]
        try:
            return tune_pi(plants, self.extra_delay, self.max_sensitivity, self.phase_margin)
        except SettingsError as error:
            raise SettingsError(f"{name} at {points[i].inclination:g} kg: {error}") from error

    def _elsewhere(
        self, points: Sequence[OperatingPoint], gains: Sequence[Sequence[Gains]], names: tuple[str, ...]
    ) -> float:
        """Return the largest Ms of all gains on the plants of all payloads; refuse an unstable loop.

        After a payload was put on, the gains of the old one act until the estimate has followed.
        """
        worst = 0.0
        for axis, name in enumerate(names):
            for (there, pair), point in itertools.product(zip(points, gains, strict=True), points):
                for plant in point.plants[axis]:
                    loop = _closed(pair[axis], plant, self.extra_delay)
                    radius = float(np.abs(np.linalg.eigvals(loop)).max())
                    if radius >= 1.0:
                        raise SettingsError(
                            f"{name}: the gains of {there.inclination:g} kg are not stable at {point.inclination:g} kg "
                            f"(spectral radius {radius:.4f}), where they act until the estimate has followed; give "
                            "payloads nearer to each other or a lower `max_sensitivity`."
                        )
                    worst = max(worst, _sensitivity(pair[axis], plant, self.extra_delay))
        return worst


def _sensitivity(gains: Gains, plant: AxisPlant, extra_delay: int) -> float:
    """Return Ms of a frozen loop."""
    w = frequencies(plant.sample_time, lowest=LOWEST / plant.stretch)
    pi = gains.gain * (1.0 + plant.sample_time / gains.integral_time / (np.exp(1j * w * plant.sample_time) - 1.0))
    return float(np.max(1.0 / np.abs(1.0 + pi * plant.response(w, extra_delay=extra_delay))))


def _closed(gains: Gains, plant: AxisPlant, extra_delay: int) -> Matrix:
    """Return the closed loop of a PI on a plant at rest: states are the integral s, the plant's and its delay line.

    v = s - K y, s+ = s - K Ts/Ti y; the model that is followed has no feedback and dies out by itself.
    """
    A, B, C = plant.observable_form()
    n, delay = plant.order, plant.delay + extra_delay
    v = np.concatenate([[1.0], -gains.gain * C, np.zeros(delay)])
    loop = np.zeros((1 + n + delay, 1 + n + delay))
    loop[0, 0] = 1.0
    loop[0, 1 : 1 + n] = -gains.gain * plant.sample_time / gains.integral_time * C
    loop[1 : 1 + n, 1 : 1 + n] = A
    if delay == 0:
        loop[1 : 1 + n] += np.outer(B, v)
        return loop
    loop[1 : 1 + n, -1] = B
    loop[1 + n] = v
    for i in range(1, delay):
        loop[1 + n + i, n + i] = 1.0
    return loop


def _least_dwell(gains: Sequence[Gains], plant: AxisPlant, extra_delay: int, most: int) -> int:
    """Return the samples between switches for which none of their sequences drives the loop on one plant off.

    `most + 1` where none up to `most` is found: a slow pole that no controller moves takes that long to die out.

    Each controller's loop has V = x' P x that falls on its own. If after so many samples under one controller, and the
    reset of the integral at the switch, the other's V is below what the first one's was, V falls from switch to switch
    (Geromel and Colaneri 2006, SIAM J. Control Optim. 45:1915, theorem 1).
    """
    from scipy.linalg import solve_discrete_lyapunov

    loops = [_closed(item, plant, extra_delay) for item in gains]
    P = [solve_discrete_lyapunov(loop.T, np.eye(len(loop))) for loop in loops]
    longest = 0
    for here, there in itertools.permutations(range(len(gains)), 2):
        reset = np.eye(len(loops[here]))
        # v is the same before and after: s' = s + (K' - K) y.
        reset[0, 1] += gains[there].gain - gains[here].gain
        root = np.linalg.inv(np.linalg.cholesky(P[here]).T)
        moved, samples = reset.copy(), 0
        while float(np.linalg.eigvalsh(root.T @ moved.T @ P[there] @ moved @ root).max()) >= 1.0:
            moved, samples = moved @ loops[here], samples + 1
            if samples > most:
                return samples
        longest = max(longest, samples)
    return longest


def _lines(
    points: Sequence[OperatingPoint], gains: Sequence[Sequence[Gains]], worst: float, names: tuple[str, ...],
    dwell: tuple[float, float | None],
) -> list[str]:  # fmt: skip
    lines = [
        f"  at {point.inclination:5.3g} kg: "
        + "; ".join(f"{name} K {g.gain:.4g}, Ti {g.integral_time:.3g} s" for name, g in zip(names, pair, strict=True))
        for point, pair in zip(points, gains, strict=True)
    ]
    shown = "that this is enough for any sequence of them is not shown"
    if dwell[1] is not None:
        shown = f"{dwell[1]:.3g} s are shown to be enough for any sequence"
    return [
        *lines,
        f"  largest Ms of the gains of each payload at every other: {worst:.3g}",
        f"  {dwell[0]:.3g} s between switches at the least; {shown}",
    ]
