"""The unscented filter over a nonlinear model: filterpy's sigma points through the model's own one-step prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, SettingsError, Vector, require_whole, to_si
from softneck.identification import WARM_UP, Model
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.runtime import Block, State, load_functions
from softneck.signals import Recording
from softneck.signals.recording._recording import require_same_robot

from ._forms import Reach
from ._kalman_parts_runtime import KALMAN_GATE, KALMAN_LEAD, KalmanCounters
from ._offline import Estimates, measured_angles
from ._reach import simulated_reach
from ._settings import KalmanSettings
from ._ukf_memory import LONGEST, angle_memory

# What the model's angle may be off at the start, as a part of what its output may: 5 deg of a neck's 40. The second
# does not pass the model, so that it may be large without sending sigma points to where no neck ever was.
_START_MODEL = 0.125
# Places of the counters; the last begins the outputs that were measured last.
_COUNTERS = {name: place for place, name in enumerate(KalmanCounters.fields)}


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

    States, by pairs of pitch and roll, or by all outputs of another robot: the model's angle now and at `memory` - 1
    samples before, and a disturbance of the angle that walks. What else the model remembers (inputs, drives, plays,
    older angles) follows from what was estimated. A state is a `State`: plain numbers that can be stored.

    Attributes:
        model: the model that sigma points pass.
        settings: gate, sensor's timing and order; of form "model".
        memory: angles, the newest first, whose uncertainty passes the model.
        noise: of measurement, model and disturbance, in SI; () for those of the settings, which are a neck's.
        start: standard deviation of the outputs when nothing is known, in SI.
    """

    model: Model
    settings: KalmanSettings
    memory: int
    noise: tuple[float, ...] = ()
    start: float = Reach().start

    def __post_init__(self) -> None:
        if not self.noise:
            object.__setattr__(self, "noise", self.settings.noise)

    @property
    def robot(self) -> Robot:
        """Whose outputs it estimates."""
        return self.model.robot

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
        levels = zip(("measurement", "model", "disturbance"), self.noise, strict=True)
        shown = self.robot.outputs.display_unit
        per, names = to_si(shown)[0], " and ".join(self.robot.outputs.names)
        return "\n".join(
            (
                f"unscented Kalman observer over {self.model.kind}, {self.sample_time * 1e3:g} ms",
                f"  {self._m * (self.memory + 1)} states: {self.memory} angles and a disturbance of {names}",
                f"  noise: {', '.join(f'{name} {value / per:.3g} {shown}' for name, value in levels)}",
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
        return State(values, np.zeros(0), np.zeros(2 * self._m + 2))

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now.

        Args:
            state: of before.
            inputs: (motors + outputs + 1,) of a neck motor_setpoint_1..3, pitch_measured, roll_measured [rad],
                measurement_valid; angles may be NaN.

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
        n, m = self._n, self._m
        if given.size != n + m + 1 or not np.isfinite(given[:n]).all():
            names = ", ".join(f"{name}_measured" for name in self.robot.outputs.names)
            raise DataError(
                f"an unscented filter takes {n + m + 1} inputs ({n} set-points, which must be finite, {names}, "
                f"measurement_valid); got {given.tolist()}."
            )
        y, valid = given[n : n + m], given[n + m]
        rules, c, noise = self._rules, self._constants, self.noise[0]
        counters, base, x, P, past = self._parts(values)
        samples = float(counters[_COUNTERS["samples"]])
        if samples == 0.0:
            base, x, P, past = self._first(given[:n], y if valid > 0.5 else np.zeros(m))
        past = np.vstack([past[1:], given[:n]])
        usable = rules.kalman_usable(c, counters, y, valid, noise)
        forced = rules.kalman_forced(c, counters)
        kf = self._predicted(base, x, P, past, widen=bool(samples < WARM_UP or forced))
        # The oldest angle leaves the states: with the last estimate of it the model moves on.
        base, _ = self._moved(base, past[:1], x[None, -2 * m : -m])
        innovation, accepted, log_det = self._corrected(kf, y, usable, forced=forced)
        rules.kalman_count(c, counters, usable, accepted)
        counters[_COUNTERS["samples"]] = samples + 1.0
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

    def _first(self, setpoints: Vector, y: Vector) -> tuple[Vector, Vector, Matrix, Matrix]:
        """Return model, states, covariance and past inputs as if the neck had stood at the first row for ever."""
        y = np.nan_to_num(y)
        names = (*self.robot.set_points, *self.robot.outputs.names)
        held: dict[str, Vector] = dict(zip(names, np.tile(np.concatenate([setpoints, y]), (2, 1)).T, strict=True))
        still = Recording(np.arange(2) * self.sample_time, self.sample_time, held, robot=self.robot)
        x = np.concatenate([np.tile(y, self.memory), np.zeros(self._m)])
        return self.model.initial_state(still).values, x, self._doubt, np.tile(setpoints, (self._kept, 1))

    def _predicted(self, base: Vector, x: Vector, P: Matrix, past: Matrix, *, widen: bool) -> Any:
        """Return filterpy's filter one sample on."""
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        n, L, m = x.size, self.memory, self._m
        # Weights of 1/2n on every point and none on the middle one: no covariance can become indefinite.
        points = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
        kf: Any = UnscentedKalmanFilter(n, m, self.sample_time, hx=self._H.dot, fx=None, points=points)
        first, second = self.noise[1:]
        kf.R = self.noise[0] ** 2 * np.eye(m)
        kf.Q = np.diag(np.concatenate([np.full(m, first**2), np.zeros(n - 2 * m), np.full(m, second**2)]))
        kf.x, kf.P = x.copy(), P.copy()

        def ahead(point: Vector, _: Any) -> Vector:
            angles = point[:-m].reshape(L, m)[::-1]
            _, outputs = self._moved(base, past[:L], angles)
            return np.concatenate([outputs[-1, :m], point[: m * (L - 1)], point[-m:]])

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
        L, lead, m = self.memory, self._lead, self._m
        # `base` is L - 1 samples before the filter's time; of inputs not yet known the newest stands for all. A model
        # of measured angles has the sensor's delay in its dead time: what it says `lead` samples on is true now.
        rows = past[np.minimum(np.arange(1, L + lead + 1), self._kept - 1)]
        angles = np.full((L + lead, m), np.nan)
        angles[:L] = x[:-m].reshape(L, m)[::-1]
        outputs = self._moved(base, rows, angles)[1][:, :m]
        now = outputs[-2] if lead > 0 else x[:m]
        return now + x[-m:], (outputs[-1] - now) / self.sample_time

    def _moved(self, base: Vector, setpoints: Matrix, angles: Matrix) -> tuple[Vector, Matrix]:
        """Return the model some samples on from `base`, told its `angles` in each of them, and its outputs."""
        n = self._n
        rows = np.full((len(setpoints), 2 * n + self._m), np.nan)
        rows[:, :n], rows[:, n : n + self._m] = setpoints, angles
        state, outputs = self._plant.run(State(base, self._parameters, np.zeros(0)), rows)
        return state.values, outputs

    def _parts(self, values: Vector) -> tuple[Vector, Vector, Vector, Matrix, Matrix]:
        """Return copies of the counters, the model's numbers, states, covariance and past set-points."""
        if values.size != self._places[-1]:
            raise DataError(f"the state has {values.size} numbers, this filter's {self._places[-1]}; start it anew.")
        counters, base, x, P, past = np.split(values.copy(), self._places[:-1])
        return counters, base, x, P.reshape(x.size, x.size), past.reshape(-1, self._n)

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
        return self.settings.constants((0,) * self._m, self.sample_time)

    @property
    def _n(self) -> int:
        """Motors."""
        return len(self.robot.motors.names)

    @property
    def _m(self) -> int:
        """Outputs."""
        return len(self.robot.outputs.names)

    @property
    def _lead(self) -> int:
        return int(self._constants[KALMAN_LEAD])

    @cached_property
    def _kept(self) -> int:
        """Set-points that are remembered: those that lead to the angles in the states, and one that comes late."""
        return self.memory + (self.settings.order == "jacobi")

    @cached_property
    def _H(self) -> Matrix:
        one = np.eye(self._m)
        return np.hstack([one, np.zeros((self._m, self._m * (self.memory - 1))), one])

    @cached_property
    def _doubt(self) -> Matrix:
        """The covariance when nothing is known, and what is added where the measurement must have its way."""
        model = (_START_MODEL * self.start) ** 2
        return np.diag([model] * (self._m * self.memory) + [self.start**2] * self._m)

    @cached_property
    def _places(self) -> list[int]:
        """Where the parts of a state end."""
        n = self._m * (self.memory + 1)
        counters = _COUNTERS["measured"] + self._m
        sizes = [counters, self._plant.initial_state().values.size, n, n * n, self._n * self._kept]
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
    reach, noise = Reach(), chosen.noise
    if model.robot.is_neck:
        chosen.of_neck()
    else:
        reach = simulated_reach(model)
        timed = chosen.robot_timing(model.robot, model.sample_time)
        if isinstance(chosen.sensor_delay, NeckDefault):
            # The robot's own delay: to whole samples, as the filter's states are.
            timed = replace(timed, sensor_delay=round(timed.sensor_delay / model.sample_time) * model.sample_time)
        noise, chosen = chosen.robot_noise(model.robot, reach, 1.0, model.sample_time)[0], timed
    lead = float(chosen.constants((0,) * len(model.robot.outputs.names), model.sample_time)[KALMAN_LEAD])
    if lead != int(lead):
        raise SettingsError(
            f"`sensor_delay` {chosen.sensor_delay:g} s must be whole samples of {model.sample_time:g} s in an "
            "unscented filter; take the nearest."
        )
    kept = angle_memory(model) if memory is None else memory
    return UkfObserver(model=model, settings=chosen, memory=kept, noise=noise, start=reach.start)


def estimate_recording(observer: UkfObserver, recording: Recording) -> Estimates:
    """Return what the filter makes of each run."""
    if not math.isclose(recording.sample_time, observer.sample_time, rel_tol=1e-6):
        raise DataError(
            f"the recording has sample time {recording.sample_time:g} s, the model {observer.sample_time:g} s; "
            "resample it or identify the model at its sample time."
        )
    require_same_robot(recording.robot, observer.robot, "the recording and the observer")
    rows = [row for run in recording.runs() for row in _run(observer, run)]
    outputs, m = np.array([row.outputs for row in rows]), len(observer.robot.outputs.names)
    return Estimates(
        time=recording.time,
        outputs=outputs[:, :m].copy(),
        rates=outputs[:, m : 2 * m].copy(),
        innovation=outputs[:, 2 * m].copy(),
        accepted=np.array([row.accepted for row in rows]),
        healthy=outputs[:, 2 * m + 1] > 0.5,
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
