"""The bake-off: one axis, a step and a load on every plant of an uncertain family, for controllers of any kind."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import control
import numpy as np

from softneck.core import Block, DataError, Matrix, SettingsError, Vector, require_one_of, require_positive
from softneck.estimation import AXES, AxisPlant, LinearNeck
from softneck.signals import TENDON_ANGLES, redefinition_matrix

# Reference and angle [rad] in, redefined input theta_i [rad] out; called once a sample.
Step = Callable[[float, float], float]
# A controller at rest, new for every plant.
StepFactory = Callable[[], Step]

_NUMERATOR = math.radians(27.691)  # Eq. 31 [rad/s per rad]
_POLE = 5.293  # Eq. 31 [1/s]
_SCALES = (0.6, 0.8, 1.0, 1.2, 1.4)
_DELAYS = (3, 4, 5)


@dataclass(frozen=True, slots=True, kw_only=True)
class BakeOff:
    """What is asked of a controller on every plant.

    Attributes:
        reference: the step at t = 0 [rad].
        position_limit: of `|u|` [rad].
        slew_limit: of u, per sample [rad].
        load: added to the plant's input [rad].
        load_at: from when on [s].
        duration: [s].
        sample_time: [s].
    """

    reference: float = math.radians(10.0)
    position_limit: float = 6.0
    slew_limit: float = 0.25
    load: float = -0.5
    load_at: float = 3.5
    duration: float = 6.0
    sample_time: float = 0.02

    def __post_init__(self) -> None:
        for name in ("reference", "position_limit", "slew_limit", "load_at", "sample_time"):
            require_positive(name, getattr(self, name))
        if not self.load_at < self.duration < math.inf:
            raise SettingsError(f"`duration` must be beyond `load_at` {self.load_at:g} s; got {self.duration:g} s.")

    @property
    def rows(self) -> int:
        """Samples of a run."""
        return round(self.duration / self.sample_time) + 1

    @property
    def load_row(self) -> int:
        """The first sample with the load."""
        return round(self.load_at / self.sample_time)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BakeOffResult:
    """What a controller did on every plant.

    Attributes:
        settling: (plants,) time after which the angle stays within 5 % of the step, until the load [s]; inf if never.
        overshoot: (plants,) beyond the step, until the load [%].
        load_rms: (plants,) rms of the error from the load on [deg].
        angles: (plants, time) [rad].
        inputs: (plants, time) within their limits [rad].
        nominal: index of the nominal plant.
    """

    settling: Vector
    overshoot: Vector
    load_rms: Vector
    angles: Matrix
    inputs: Matrix
    nominal: int

    @property
    def row(self) -> dict[str, float]:
        """The three figures that controllers are compared by."""
        return {
            "nominal_settling_s": float(self.settling[self.nominal]),
            "worst_overshoot_pct": float(self.overshoot.max()),
            "worst_load_rms_deg": float(self.load_rms.max()),
        }


def bake_off_plant(
    numerator: float = 1.0, pole: float = 1.0, delay: int = 4, *, sample_time: float = 0.02
) -> AxisPlant:
    """Return Eq. 31's pitch, `exp(-0.08 s) 27.691/(s + 5.293)` deg/rad, with factors on its numerator and pole.

    Args:
        numerator, pole: factors.
        delay: whole samples, besides the one that the held input costs.
        sample_time: [s].
    """
    p = pole * _POLE
    a = math.exp(-p * sample_time)
    return AxisPlant(np.array([numerator * _NUMERATOR / p * (1.0 - a)]), np.array([1.0, -a]), delay, sample_time)


def bake_off_plants() -> tuple[AxisPlant, ...]:
    """Return the 75 plants: numerator and pole x {0.6 .. 1.4}, delay {3, 4, 5} samples; the 38th is nominal."""
    return tuple(bake_off_plant(k, p, d) for d in _DELAYS for k in _SCALES for p in _SCALES)


def bake_off_samples() -> dict[str, list[control.TransferFunction]]:
    """Return those plants as samples of both axes, the nominal one first: what a design takes."""
    plants = bake_off_plants()
    ordered = [plants[len(plants) // 2], *plants[: len(plants) // 2], *plants[len(plants) // 2 + 1 :]]
    return {axis: [plant.tf() for plant in ordered] for axis in ("pitch", "roll")}


def bake_off_neck() -> LinearNeck:
    """Return the nominal plant as both axes of a neck."""
    nominal = bake_off_plant().tf()
    return LinearNeck(pitch=nominal, roll=nominal)


def run_bake_off(
    factory: StepFactory, plants: Sequence[AxisPlant] | None = None, test: BakeOff | None = None
) -> BakeOffResult:
    """Run a controller on every plant, from rest; the true angle is fed back without noise or further delay.

    Args:
        factory: returns a controller at rest, `step(reference, angle) -> theta_i`.
        plants: of the test's sample time; by default the 75.
        test: by default a step of 10 deg.
    """
    asked = test or BakeOff()
    chosen = tuple(plants) if plants is not None else bake_off_plants()
    if not chosen:
        raise DataError("the bake-off needs at least one plant.")
    runs = [_run(factory(), plant, asked) for plant in chosen]
    angles, inputs = (np.array(part) for part in zip(*runs, strict=True))
    return judge(angles, inputs, asked, len(chosen) // 2 if plants is None else 0)


def judge(angles: Matrix, inputs: Matrix, test: BakeOff, nominal: int) -> BakeOffResult:
    """Return the figures of runs, `angles` and `inputs` (plants, time)."""
    before, after = angles[:, : test.load_row], angles[:, test.load_row :]
    # 1e-12: the border itself belongs to the band, whatever rounding says.
    outside = np.abs(before - test.reference) > (0.05 + 1e-12) * test.reference
    last = before.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    settled = np.where(outside[:, -1], math.inf, last * test.sample_time)
    return BakeOffResult(
        settling=np.where(outside.any(axis=1), settled, 0.0),
        overshoot=100.0 * np.maximum(before.max(axis=1) / test.reference - 1.0, 0.0),
        load_rms=np.degrees(np.sqrt(np.mean((after - test.reference) ** 2, axis=1))),
        angles=angles,
        inputs=inputs,
        nominal=nominal,
    )


def block_stepper(block: Block, test: BakeOff | None = None, *, axis: str = "pitch") -> StepFactory:
    """Return how the bake-off steps a controller's block: its motors follow at once, its limits are the test's.

    A controller limits its motors; the redefined input is limited alike where the motor that moves most reaches its
    own limit: 2/3 of theta_i, 0.577 of phi_i (Eq. 9 and 10). Blocks whose limits are no parameters keep theirs.
    """
    asked = test or BakeOff()
    T = redefinition_matrix(TENDON_ANGLES)
    require_one_of("axis", axis, AXES)
    i = AXES.index(axis)
    share = float(np.abs(np.linalg.inv(T)[:, i]).max())
    names = [port.name for port in block.inputs]
    limits = {
        "position_limit": share * asked.position_limit,
        "slew_limit": share * asked.slew_limit / asked.sample_time,
    }
    if not math.isclose(block.sample_time, asked.sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the controller runs every {block.sample_time:g} s, the bake-off every {asked.sample_time:g} s; "
            "design it on a model of that sample time."
        )
    known = {port.name for port in block.parameters}
    i_reference, i_angle = names.index(f"{axis}_reference"), names.index(axis)
    i_motor = names.index("motor_position_1")

    def factory() -> Step:
        state = block.initial_state(**{key: value for key, value in limits.items() if key in known})
        inputs = np.array([port.start for port in block.inputs])

        def step(reference: float, angle: float) -> float:
            nonlocal state
            inputs[i_reference], inputs[i_angle] = reference, angle
            state, motors = block.step(state, inputs)
            inputs[i_motor : i_motor + 3] = motors
            return float(T[i] @ motors)

        return step

    return factory


def _run(step: Step, plant: AxisPlant, test: BakeOff) -> tuple[Vector, Vector]:
    """Return angles and limited inputs (time,) of one run."""
    if not math.isclose(plant.sample_time, test.sample_time, rel_tol=1e-9):
        raise SettingsError(f"a plant's sample time is {plant.sample_time:g} s; the test's is {test.sample_time:g} s.")
    A, B, _ = plant.observable_form()
    first = plant.order == 1
    a, b = float(A[0, 0]), float(B[0])
    x, line = np.zeros(plant.order), deque([0.0] * plant.delay)
    angles, inputs = np.zeros(test.rows), np.zeros(test.rows)
    y, held = 0.0, 0.0
    for k in range(test.rows):
        wanted = min(max(step(test.reference, y), held - test.slew_limit), held + test.slew_limit)
        held = min(max(wanted, -test.position_limit), test.position_limit)
        angles[k], inputs[k] = y, held
        line.append(held + (test.load if k >= test.load_row else 0.0))
        if first:
            y = a * y + b * line.popleft()
        else:
            x = A @ x + B * line.popleft()
            y = float(x[0])
    return angles, inputs
