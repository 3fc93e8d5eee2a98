"""The unscented filter over a nonlinear model: filterpy's sigma points through the model's own one-step prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, SettingsError, Vector, require_whole
from softneck.identification import WARM_UP, Model
from softneck.runtime import Block, State, load_functions
from softneck.runtime._layout import Arrays
from softneck.signals import Recording

from ._kalman_parts_runtime import KALMAN_GATE, KALMAN_LEAD, KalmanCounters
from ._offline import Estimates, measured_angles
from ._settings import KalmanSettings
from ._ukf_memory import LONGEST, angle_memory

# What the model's angle may be off at the start, and what its output may: the second does not pass the model, so that
# it may be large without sending sigma points to where no neck ever was.
_START_MODEL = math.radians(5.0)
_START_OUTPUT = math.radians(40.0)
_COUNTERS = KalmanCounters.parts(Arrays(()))


@dataclass(frozen=True, slots=True, eq=False)
class UkfStep:
    """What one step made: numbers of the next state, outputs, and the entries of `Estimates`."""

    values: Vector
    outputs: Vector
    judged: bool
    accepted: bool
    log_det: float
    aligned: Vector
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class UkfObserver:
    """An unscented Kalman filter over an identified model of any kind; `ukf` makes it.

    States, by pairs of pitch and roll: the model's angle now and at `memory` - 1 samples before, and a disturbance of
    the angle that walks. What else the model remembers (inputs, drives, plays, older angles) follows from what was
    estimated. A state is a `State`: plain numbers that can be stored.

    Attributes:
        model: the model that sigma points pass.
        settings: noise levels, gate, sensor and order; of form "model".
        memory: angles, the newest first, whose uncertainty passes the model.
    """

    model: Model
    settings: KalmanSettings
    memory: int

    @property
    def sample_time(self) -> float:
        """Of the model and of the loop [s]."""
        return self.model.sample_time

    @property
    def lead(self) -> float:
        """How far the estimate runs ahead of the measurement [s]: the sensor's delay."""
        return self._lead * self.sample_time

    def summary(self) -> str:
        """Return some lines for people."""
        levels = zip(("measurement", "model", "disturbance"), self.settings.noise, strict=True)
        return "\n".join(
            (
                f"unscented Kalman observer over {self.model.kind}, {self.sample_time * 1e3:g} ms",
                f"  {2 * self.memory + 2} states: {self.memory} angles and a disturbance of pitch and roll",
                f"  noise: {', '.join(f'{name} {math.degrees(value):.3g} deg' for name, value in levels)}",
            )
        )

    def block(self) -> NoReturn:
        """Raise SettingsError: there is no runtime, hence no FMU."""
        raise SettingsError(
            "an unscented filter is a Python object with `step`, not a block: there is no FMU of it. For an FMU design "
            "`KalmanSettings` over a linear model, or with form gyro."
        )

    def initial_state(self) -> State:
        """Return the state before the first row, when nothing is known."""
        values = np.zeros(self._places[-1])
        self._rules.kalman_clear(self._constants, values)
        return State(values, np.zeros(0), np.zeros(6))

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now.

        Args:
            state: of before.
            inputs: (6,) motor_setpoint_1..3, pitch_measured, roll_measured [rad], measurement_valid; angles may be NaN.

        Returns:
            The state, and pitch, roll, pitch_rate, roll_rate, innovation, healthy, as `KalmanObserver` gives them.

        Raises:
            DataError: another number of inputs, or set-points that are not finite.
        """
        row = self.advance(state.values, inputs)
        return State(row.values, state.parameters, row.outputs), row.outputs

    def estimate(self, recording: Recording) -> Estimates:
        """Filter a recording; each of its runs starts anew. Missing samples are predicted over.

        Raises:
            DataError: another sample time.
        """
        return estimate_recording(self, recording)

    def advance(self, values: Vector, inputs: ArrayLike) -> UkfStep:
        """Do what `step` does on the numbers of a state, and tell more of it."""
        given = np.asarray(inputs, dtype=np.float64).ravel()
        if given.size != 6 or not np.isfinite(given[:3]).all():
            raise DataError(
                "an unscented filter takes 6 inputs (three set-points [rad], which must be finite, pitch_measured, "
                f"roll_measured, measurement_valid); got {given.tolist()}."
            )
        rules, c, noise = self._rules, self._constants, self.settings.noise[0]
        counters, base, x, P, past = self._parts(values)
        samples = counters[_COUNTERS["samples"]]
        if samples == 0.0:
            base, x, P, past = self._first(given)
        past = np.vstack([past[1:], given[:3]])
        usable = rules.kalman_usable(c, counters, given, noise)
        forced = rules.kalman_forced(c, counters)
        kf = self._predicted(base, x, P, past, widen=bool(samples < WARM_UP or forced))
        # The oldest angle leaves the states: with the last estimate of it the model moves on.
        base, _ = self._moved(base, past[:1], x[None, -4:-2])
        innovation, accepted, log_det = self._corrected(kf, given[3:5], usable, forced=forced)
        rules.kalman_count(c, counters, usable, accepted)
        samples += 1.0
        healthy = rules.kalman_healthy(c, counters, noise)
        angle, rate = self._told(base, kf.x, past)
        H = self._H
        return UkfStep(
            values=np.concatenate([counters, base, kf.x, kf.P.ravel(), past.ravel()]),
            outputs=np.array([*angle, *rate, innovation, float(healthy)]),
            judged=usable,
            accepted=accepted,
            log_det=log_det,
            aligned=H @ kf.x,
            covariance=H @ kf.P @ H.T,
        )

    def _first(self, given: Vector) -> tuple[Vector, Vector, Matrix, Matrix]:
        """Return model, states, covariance and past inputs as if the neck had stood at the first row for ever."""
        y = np.nan_to_num(given[3:5]) if given[5] > 0.5 else np.zeros(2)
        names = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "pitch", "roll")
        held: dict[str, Vector] = dict(zip(names, np.tile(np.concatenate([given[:3], y]), (2, 1)).T, strict=True))
        start = self.model.initial_state(Recording(np.arange(2) * self.sample_time, self.sample_time, held))
        x = np.concatenate([np.tile(y, self.memory), np.zeros(2)])
        return start.values, x, self._doubt, np.tile(given[:3], (self._kept, 1))

    def _predicted(self, base: Vector, x: Vector, P: Matrix, past: Matrix, *, widen: bool) -> Any:
        """Return filterpy's filter one sample on."""
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        n, L = x.size, self.memory
        # Weights of 1/2n on every point and none on the middle one: no covariance can become indefinite.
        points = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
        kf: Any = UnscentedKalmanFilter(n, 2, self.sample_time, hx=self._H.dot, fx=None, points=points)
        first, second = self.settings.noise[1:]
        kf.R = self.settings.noise[0] ** 2 * np.eye(2)
        kf.Q = np.zeros((n, n))
        kf.Q[[0, 1], [0, 1]], kf.Q[[-1, -2], [-1, -2]] = first**2, second**2
        kf.x, kf.P = x.copy(), P.copy()

        def ahead(point: Vector, _: Any) -> Vector:
            angles = point[:-2].reshape(L, 2)[::-1]
            _, outputs = self._moved(base, past[:L], angles)
            return np.concatenate([outputs[-1, :2], point[: 2 * L - 2], point[-2:]])

        kf.predict(fx=ahead)
        kf.P = 0.5 * (kf.P + kf.P.T) + (self._doubt if widen else 0.0)
        kf.sigmas_f = points.sigma_points(kf.x, kf.P)
        return kf

    def _corrected(self, kf: Any, z: Vector, usable: bool, *, forced: bool) -> tuple[float, bool, float]:
        """Take the measurement in unless the gate refuses; return e' S^-1 e, whether it was taken in, and log det S."""
        if not usable:
            return 0.0, False, 0.0
        # The measurement is linear in the states: so S needs no sigma points.
        S = self._H @ kf.P @ self._H.T + kf.R
        e = z - self._H @ kf.x
        innovation = float(e @ np.linalg.solve(S, e))
        accepted = forced or innovation <= self._constants[KALMAN_GATE]
        kf.update(z if accepted else None)
        kf.P = 0.5 * (kf.P + kf.P.T)
        return innovation, accepted, float(np.linalg.slogdet(S)[1])

    def _told(self, base: Vector, x: Vector, past: Matrix) -> tuple[Vector, Vector]:
        """Return angles and rates of now: the mean carried ahead by the sensor's delay, and by one sample more."""
        L, lead = self.memory, self._lead
        # `base` is L - 1 samples before the filter's time; of inputs not yet known the newest stands for all. A model
        # of measured angles has the sensor's delay in its dead time: what it says `lead` samples on is true now.
        rows = past[np.minimum(np.arange(1, L + lead + 1), self._kept - 1)]
        angles = np.full((L + lead, 2), np.nan)
        angles[:L] = x[:-2].reshape(L, 2)[::-1]
        outputs = self._moved(base, rows, angles)[1][:, :2]
        now = outputs[-2] if lead > 0 else x[:2]
        return now + x[-2:], (outputs[-1] - now) / self.sample_time

    def _moved(self, base: Vector, setpoints: Matrix, angles: Matrix) -> tuple[Vector, Matrix]:
        """Return the model some samples on from `base`, told its `angles` in each of them, and its outputs."""
        rows = np.full((len(setpoints), 8), np.nan)
        rows[:, :3], rows[:, 3:5] = setpoints, angles
        state, outputs = self._plant.run(State(base, self._parameters, np.zeros(0)), rows)
        return state.values, outputs

    def _parts(self, values: Vector) -> tuple[Vector, Vector, Vector, Matrix, Matrix]:
        """Return copies of the counters, the model's numbers, states, covariance and past set-points."""
        if values.size != self._places[-1]:
            raise DataError(f"the state has {values.size} numbers, this filter's {self._places[-1]}; start it anew.")
        counters, base, x, P, past = np.split(values.copy(), self._places[:-1])
        return counters, base, x, P.reshape(x.size, x.size), past.reshape(-1, 3)

    @cached_property
    def _rules(self) -> Any:
        """The functions of the counters, which are those of the Kalman runtimes."""
        return load_functions("softneck.estimation._kalman_parts_runtime", compiled=False)

    @cached_property
    def _plant(self) -> Block:
        return self.model.block()

    @cached_property
    def _parameters(self) -> Vector:
        return self._plant.initial_state(use_measurement=1.0).parameters

    @cached_property
    def _constants(self) -> Vector:
        return self.settings.constants((0, 0), self.sample_time)

    @property
    def _lead(self) -> int:
        return int(self._constants[KALMAN_LEAD])

    @cached_property
    def _kept(self) -> int:
        """Set-points that are remembered: those that lead to the angles in the states, and one that comes late."""
        return self.memory + (self.settings.order == "jacobi")

    @cached_property
    def _H(self) -> Matrix:
        H = np.zeros((2, 2 * self.memory + 2))
        H[[0, 1], [0, 1]] = H[[0, 1], [-2, -1]] = 1.0
        return H

    @cached_property
    def _doubt(self) -> Matrix:
        """The covariance when nothing is known, and what is added where the measurement must have its way."""
        return np.diag([_START_MODEL**2] * (2 * self.memory) + [_START_OUTPUT**2] * 2)

    @cached_property
    def _places(self) -> list[int]:
        """Where the parts of a state end."""
        n = 2 * self.memory + 2
        counters = max(part.stop for part in _COUNTERS.values())
        sizes = [counters, self._plant.initial_state().values.size, n, n * n, 3 * self._kept]
        return [int(end) for end in np.cumsum(sizes)]


def ukf(model: Model, settings: KalmanSettings | None = None, *, memory: int | None = None) -> UkfObserver:
    """Return an unscented Kalman filter over `model`, as a rule a nonlinear one (`play`, `nn`).

    Sigma points of the scaled unscented transform (Julier and Uhlmann 1997; van der Merwe 2004) pass the model's own
    prediction one sample ahead. A step costs 0.5 to 3 ms in Python, by the memory: for offline use and 50 Hz loops.

    Args:
        model: identified, of any kind.
        settings: of form "model"; None for the defaults. Its `tendon_angles` have no meaning here.
        memory: angles whose uncertainty passes the model; None asks the model how many it depends on (at most 12).
            With fewer the filter is too sure of itself and may diverge.

    Raises:
        SettingsError: no identified model, settings of another form or with constant gains, another sample time than
            the model's, or a sensor delay of parts of a sample.
    """
    chosen = KalmanSettings() if settings is None else settings
    if not isinstance(model, Model):
        raise SettingsError(
            f"an unscented filter needs an identified model, as `Play().fit(...)` gives; got {type(model).__name__}."
        )
    model.robot.require_neck("an unscented filter")
    if chosen.form != "model" or chosen.steady:
        what = "constant gains" if chosen.form == "model" else f"form {chosen.form}"
        raise SettingsError(f"an unscented filter is over a model; {what} has no meaning with it. Use form=model.")
    if chosen.sample_time is not None and not math.isclose(chosen.sample_time, model.sample_time, rel_tol=1e-6):
        raise SettingsError(
            f"`sample_time` {chosen.sample_time:g} s must be the model's, {model.sample_time:g} s: a nonlinear model "
            "cannot be taken to another. Resample the recording and identify again."
        )
    if memory is not None:
        require_whole("memory", memory, 1, LONGEST)
    lead = float(chosen.constants((0, 0), model.sample_time)[KALMAN_LEAD])
    if lead != int(lead):
        raise SettingsError(
            f"`sensor_delay` {chosen.sensor_delay:g} s must be whole samples of {model.sample_time:g} s in an "
            "unscented filter; take the nearest."
        )
    return UkfObserver(model=model, settings=chosen, memory=angle_memory(model) if memory is None else memory)


def estimate_recording(observer: UkfObserver, recording: Recording) -> Estimates:
    """Return what the filter makes of each run."""
    if not math.isclose(recording.sample_time, observer.sample_time, rel_tol=1e-6):
        raise DataError(
            f"the recording has sample time {recording.sample_time:g} s, the model {observer.sample_time:g} s; "
            "resample it or identify the model at its sample time."
        )
    rows = [row for run in recording.runs() for row in _run(observer, run)]
    outputs = np.array([row.outputs for row in rows])
    return Estimates(
        time=recording.time,
        pitch=outputs[:, 0].copy(),
        roll=outputs[:, 1].copy(),
        pitch_rate=outputs[:, 2].copy(),
        roll_rate=outputs[:, 3].copy(),
        innovation=outputs[:, 4].copy(),
        accepted=np.array([row.accepted for row in rows]),
        healthy=outputs[:, 5] > 0.5,
        judged=np.array([row.judged for row in rows]),
        aligned=np.array([row.aligned for row in rows]),
        covariance=np.array([row.covariance for row in rows]),
        log_det=np.array([row.log_det for row in rows]),
    )


def _run(observer: UkfObserver, run: Recording) -> list[UkfStep]:
    z = measured_angles(run)
    # The set-points of t_k are commanded after the measurement of t_k: the filter knows those before. In a Jacobi loop
    # the observer sees them a sample younger.
    late = 0 if observer.settings.order == "jacobi" else 1
    setpoints = run.set_points[np.maximum(np.arange(len(run)) - late, 0)]
    values, rows = observer.initial_state().values, []
    for u, y in zip(setpoints, z, strict=True):
        rows.append(observer.advance(values, np.concatenate([u, y, [1.0]])))
        values = rows[-1].values
    return rows
