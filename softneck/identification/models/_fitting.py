"""Steps that all estimators share: check and scale the training data, try dead times, build the model.

All is scaled and rounded before anything is learned, so that neither units nor pace change a bit of the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, to_si
from softneck.robot import Robot
from softneck.signals import Recording, check_channel, concatenate, independent_motions

from ._arrays import MOST_PAYLOAD, trained_set_points
from ._model import WARM_UP, Model
from ._scores import nrmse_fit
from ._validity import with_validity_region

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from softneck.robot import Scaling
from softneck.signals import scale_recording

from ._directions import NECK_SECONDS, Directions, directions_of
from ._drive import LoadedDrive, drive_delays, fit_loaded_drive

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# 2 s at 20 ms, ten time constants of a neck (0.2 s); less does not determine a model.
MIN_ROWS = 100


def check_training(recording: Recording) -> None:
    """Raise DataError for a recording too short, without excitation, or with an output that never moves."""
    if len(recording) < MIN_ROWS:
        raise DataError(
            f"{len(recording)} rows are too few to identify from; at least {MIN_ROWS} are needed. Record longer."
        )
    span = np.ptp(recording.set_points, axis=0)
    if span.max() < 1e-6:
        raise DataError(
            "the motor set-points are constant; nothing can be identified. Record with an excitation such as `eq22`."
        )
    outputs = recording.outputs
    for axis, name in enumerate(recording.robot.outputs.names):
        values = outputs[np.isfinite(outputs[:, axis]), axis]
        if values.size < MIN_ROWS:
            raise DataError(f"`{name}` has only {values.size} samples that were not missed; {MIN_ROWS} are needed.")
        if np.ptp(values) < 1e-9:
            raise DataError(f"`{name}` is constant; is its sensor connected?")


# Each hash covers a row and the 4 before it: at rest, logged rows repeat to the last digit.
_HASHED_ROWS = 5
# Files round angles to degrees and back; nine digits of a radian survive that.
_HASHED_DIGITS = 9


def row_hashes(recording: Recording) -> np.ndarray:
    """Return one uint64 hash per row (time,), of the set-points and outputs of it and the 4 rows before it."""
    return np.concatenate([_run_hashes(run) for run in recording.runs()])


def known_rows(recording: Recording, hashes: np.ndarray) -> np.ndarray:
    """Return a mask (time,) of the rows whose hash is in `hashes`."""
    return np.isin(row_hashes(recording), hashes)


def _run_hashes(run: Recording) -> np.ndarray:
    values = np.round(np.column_stack([run.set_points, run.outputs]), _HASHED_DIGITS) + 0.0  # no -0.0
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    single = np.zeros(len(run), dtype=np.uint64)
    for column in range(bits.shape[1]):
        single = _mix(single ^ bits[:, column])
    combined = np.zeros_like(single)
    for back in range(min(_HASHED_ROWS, len(run))):
        shifted = np.zeros_like(single)
        shifted[back:] = single[: single.size - back]
        combined = _mix(combined ^ shifted)
    return combined


def _mix(x: np.ndarray) -> np.ndarray:
    """Mix bits by the finaliser of splitmix64 (Steele, Lea and Flood 2014); integers overflow on purpose."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


# Default end of the search for the dead time [scaled s]: one and a half time constants.
MAX_DELAY = 0.3
# Dead times that are all tried; of more a grid of as many, and finer ones.
_MOST_DELAYS = 32


def delay_samples(
    delay: float | None, max_delay: float, sample_time: float, runs: Sequence[tuple[Matrix, Matrix]]
) -> list[int]:
    """Return the dead times to try, in samples; raise DataError for a given one longer than every run."""
    longest = max(len(Y) for Y, _ in runs)
    if delay is None:
        return list(range(max(min(round(max_delay / sample_time), longest - 3), 0) + 1))
    samples = round(delay / sample_time)
    if samples >= longest:
        raise DataError(
            f"a dead time of {delay:g} s is longer than the longest run, {longest * sample_time:g} s; "
            "lower `delay` or record longer."
        )
    return [samples]


def best_delay(delays: Sequence[int], cost: Callable[[int], float]) -> int:
    """Return the dead time of the least cost, the first of equal ones.

    Of more than `_MOST_DELAYS` a grid is tried, then a finer one around its best: the cost of a motion that is sampled
    so fast turns slowly from one sample of dead time to the next.
    """
    known: dict[int, float] = {}
    while True:
        stride = -(-len(delays) // _MOST_DELAYS)
        known |= {d: cost(d) for d in delays[::stride] if d not in known}
        best = min(sorted(known), key=lambda d: (math.isnan(known[d]), known[d]))
        if stride == 1:
            return best
        at = delays.index(best)
        delays = delays[max(0, at - stride + 1) : at + stride]


def free_run_fit(runs: Sequence[tuple[Matrix, Matrix]], a: Vector, B: Matrix, d: int) -> float:
    """Return the simulation fit [%] of the first output over all runs; -inf where the model is unstable.

    Runs are y (time, ny) and u (time, nu); a (na,) is the denominator without its leading one, B (nu, nb).
    """
    from scipy.signal import lfilter, lfiltic

    denominator = np.concatenate([[1.0], a])
    if np.abs(np.roots(denominator)).max(initial=0.0) >= 1.0:
        return -np.inf
    measured, simulated = [], []
    for Y, U in runs:
        y = Y[:, 0]
        there = np.isfinite(y)
        total = np.zeros(len(U))
        # The first input's filter starts from the first measured output, the others from rest at the first input.
        for j, b in enumerate(B):
            numerator = np.concatenate([np.zeros(1 + d), b])
            y0 = y[np.argmax(there)] if j == 0 and there.any() else 0.0
            zi = lfiltic(numerator, denominator, np.full(a.size, y0), np.full(numerator.size, U[0, j]))
            total += lfilter(numerator, denominator, U[:, j], zi=zi)[0]
        measured.append(y[WARM_UP:])
        simulated.append(total[WARM_UP:])
    return nrmse_fit(np.concatenate(measured), np.concatenate(simulated))


SAME_EXCITATION = "chosen on rows of the excitation it was trained on; a hold-out of another one chooses better"


def training_recording(recordings: Recording | list[Recording], *, all_motors: bool = False) -> Recording:
    """Return all runs, which stay separate, as one recording to identify from.

    `all_motors`: motors must move independently. DataError: too short, no excitation, or an output that never moves.
    """
    recording = concatenate(recordings if isinstance(recordings, list) else [recordings])
    check_training(recording)
    outputs, motions = len(recording.robot.outputs.names), independent_motions(recording)
    if all_motors and motions < min(outputs, len(recording.robot.motors.names)):
        raise DataError(
            f"the motors move along {motions} direction(s) for {outputs} outputs, too few for a kind that learns "
            "the effect of each motor. Record with all motors moving independently (`eq22`, `mixed`), or take `oe`."
        )
    return recording


def in_display_unit(robot: Robot, values: Vector) -> Vector:
    """Convert values of the outputs from SI to their display unit."""
    unit = robot.outputs.display_unit
    return np.degrees(values) if unit == "deg" else values / to_si(unit)[0]


def sensor_noise(recording: Recording) -> list[float]:
    """Return the standard deviation of the noise of each output, as the recording shows it [SI]."""
    found = []
    for name in recording.robot.outputs.names:
        channel = check_channel(recording, name)
        # Rounded values are as uncertain as their steps are wide.
        found.append(max(float(np.nan_to_num(channel.noise)), (channel.quantum or 0.0) / math.sqrt(12.0)))
    return found


def robot_at_rest(recording: Recording) -> Robot:
    """Return the robot of a recording; where it gives no `rest`, that is the mean of set-points and outputs.

    Steps and loops of tests start there. What tendons bend rests at zero; so does a robot whose set-points have both
    signs.
    """
    robot, P = recording.robot, recording.set_points
    if robot.tendon_angles is not None or P.min() < 0.0 < P.max():
        return robot
    means = (P.mean(axis=0), robot.motors.unit), (np.nanmean(recording.outputs, axis=0), robot.outputs.unit)
    return robot.with_rest(*([float(f"{x:.6g}") for x in mean / to_si(unit)[0]] for mean, unit in means))


def fitted_model(
    kind: str,
    settings: DataclassInstance,
    recording: Recording,
    *,
    arrays: Mapping[str, Matrix],
    findings: Mapping[str, Any],
) -> Model:
    """Build the model that `settings` fitted to `recording`, with its training range, row hashes and validity."""
    model = Model(
        kind=kind,
        sample_time=recording.sample_time,
        arrays=arrays,
        settings=asdict(settings),
        findings={**findings, **trained_set_points(recording), "sensor": {"noise_std": sensor_noise(recording)}},
        training_rows=row_hashes(recording),
        robot=robot_at_rest(recording),
    )
    return with_validity_region(model, recording)


def payload_of(run: Recording) -> float:
    """Return the payload of a run [kg], 0 where none was logged."""
    payload = run.channels.get("payload", np.zeros(1))
    low, high = float(np.nanmin(payload)), float(np.nanmax(payload))
    if low != high:
        raise DataError(f"the payload changes within a run, from {low:g} to {high:g} kg; cut the recording there.")
    if not 0.0 <= low <= MOST_PAYLOAD:
        raise DataError(f"a run's payload is {low:g} kg and must be 0 to {MOST_PAYLOAD:g}; is its column in grams?")
    return low


NamedArrays = Mapping[str, Matrix]
Convert = Callable[[NamedArrays, Scaling], dict[str, Matrix]]


@dataclass(frozen=True, slots=True, eq=False)
class ScaledData:
    """A training recording in SI, the same scaled (`data`), and the directions of `data`."""

    recording: Recording
    data: Recording
    scaling: Scaling
    directions: Directions

    @classmethod
    def of(cls, recording: Recording, *, amplitudes: bool = True, alike: bool = False) -> ScaledData:
        """Scale a recording; without `amplitudes` time alone, for equations in SI; `alike` gives outputs one unit."""
        robot = recording.robot
        scaling = Scaling.of(robot, set_points=recording.set_points, outputs=recording.outputs)
        if not amplitudes:
            zero, one = np.zeros_like(scaling.motor_rest), np.ones_like(scaling.output_unit)
            scaling = replace(scaling, motor_unit=1.0, motor_rest=zero, output_unit=one, output_rest=0.0 * one)
        if alike:
            scaling = replace(scaling, output_unit=np.full_like(scaling.output_unit, scaling.output_unit.max()))
        plain = scale_recording(recording, replace(scaling, second=1.0))
        found = directions_of(plain, [run.set_points for run in plain.runs()], robot)
        scaling = replace(scaling, second=found.time_constant / NECK_SECONDS)
        directions = replace(found, seconds=found.seconds / scaling.second, dead_time=found.dead_time / scaling.second)
        return cls(recording, scale_recording(recording, scaling), scaling, directions)

    @property
    def has_time_constant(self) -> bool:
        """Whether the robot file gives the time constant, so that the paper's lags and training suit the robot."""
        return self.recording.robot.time_constant_s is not None

    @property
    def has_offset(self) -> bool:
        """Whether set-points or outputs at rest are not zero in SI."""
        return bool(self.scaling.motor_rest.any() or self.scaling.output_rest.any())

    @property
    def drive(self) -> LoadedDrive:
        """The motors' lag, and the load limit of tendon robots that rest at zero."""
        return fit_loaded_drive(self.data, limited=self._has_load_limit)

    @property
    def drive_delays(self) -> Vector:
        """The dead times of `drive` [samples], (motors,)."""
        return drive_delays(self.data, limited=self._has_load_limit)

    @property
    def _has_load_limit(self) -> bool:
        return self.recording.robot.tendon_angles is not None and not self.scaling.motor_rest.any()

    @property
    def gains(self) -> Vector:
        """(outputs,) factors from scaled gains over a motor to SI."""
        return self.scaling.output_unit / self.scaling.motor_unit

    def seconds(self, setting: float | None, default: float | None = None) -> float | None:
        """Return a setting [s] in scaled seconds; the default where it is None."""
        return default if setting is None else self.scaling.scale_seconds(setting)

    def longest_delay(self, setting: float | None) -> float:
        """Return the end of a search for the dead time in scaled seconds; of a long one half as much again."""
        if setting is not None:
            return self.scaling.scale_seconds(setting)
        # What lasts longer than a third of the longest run is a drift.
        longest = max(map(len, self.data.runs())) * self.data.sample_time / 3.0
        return min(max(MAX_DELAY, 1.5 * self.directions.dead_time), longest)

    def findings(self) -> dict[str, object]:
        """Return the directions and time constants in SI where they were learned."""
        robot = self.recording.robot
        if robot.weights() is not None and robot.time_constant_s is not None:
            return {}
        return replace(self.directions, seconds=self.scaling.second * self.directions.seconds).findings()

    def in_display_unit(self, values: Matrix) -> Matrix:
        """Convert scaled differences (.., outputs) of outputs to their display unit."""
        return in_display_unit(self.recording.robot, self.scaling.output_unit * values)

    def scale(self, recording: Recording) -> Recording:
        """Scale another recording of the robot by the same units."""
        return scale_recording(recording, self.scaling)

    def model(
        self,
        kind: str,
        settings: DataclassInstance,
        in_si: Convert,
        *,
        arrays: NamedArrays,
        findings: Mapping[str, Any],
    ) -> Model:
        """Build the model in SI from scaled `arrays`, which `in_si` converts, and `findings` in SI."""
        findings = {**findings, **self.findings()}
        arrays = arrays if self.scaling.is_identity else in_si(arrays, self.scaling)
        return fitted_model(kind, settings, self.recording, arrays=arrays, findings=findings)
