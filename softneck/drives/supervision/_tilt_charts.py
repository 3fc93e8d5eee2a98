"""Charts of the tilt: residuals against the motors' positions and the gyro, and the fault that explains them."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

from ._baseline import Baseline
from ._detection import Charts, Filter, Whitening, shift_score
from ._motor_charts import RUNTIME

# Sizes of the faults to detect: a gear of another stage, a filter with a delay of 0.2 s, 1.5 deg of drift (half of the
# 3 deg by which a fault may move the neck), a fifth or five times the noise.
_GEAR_RATIOS = (2.0, 0.5)
_FILTER_DELAY_S = 0.2
_OFFSET = math.radians(1.5)
_VARIANCE_RATIOS = (1.0 / 25.0, 25.0)
# The difference of angles and gyro decays with the first time constant; its rate, the gyro's bias, is averaged over the
# second [s].
_FORGET, _BIAS = 6.0, 15.0
# Time in which a drift must be detected: the bias is estimated from older samples [s].
_DRIFT_TIME_S = 4.0
# Waiting time until the model is valid, in multiples of its memory.
_SETTLING_MEMORIES = 2
# Time constant of the evidence for faults [s].
_EVIDENCE_TIME_S = 0.5
# Number of samples at rest for the initial offset of tilt and model.
_REST_SAMPLES = 25
# Faults that change the residual of the model; and those among them that a gyro without motion confirms. A gyro that
# agrees with the angles does not exclude them: in a frozen unit the gyro is frozen too.
_OF_MODEL = frozenset(
    {"gear_wrong", "sensor_stuck", "sensor_reversed", "sensor_swapped", "sensor_late", "tilt_unexplained"}
)
_OF_SENSOR = frozenset({"sensor_stuck", "sensor_late", "tilt_unexplained"})


def tilt_names(motors: int, outputs: int, *, gyro: bool) -> list[tuple[str, int, float]]:
    """Return (event, motor or output from 0, size) of each chart; motor -1: all of them."""
    names: list[tuple[str, int, float]] = [("gear_wrong", i, g) for g in _GEAR_RATIOS for i in (*range(motors), -1)]
    names += [("sensor_stuck", a, 0.0) for a in range(outputs)] + [("sensor_reversed", a, 0.0) for a in range(outputs)]
    names += [("sensor_swapped", a, 0.0) for a in range(outputs - 1)] + [("sensor_late", -1, _FILTER_DELAY_S)]
    names += [("tilt_unexplained", a, sign * _OFFSET) for a in range(outputs) for sign in (1.0, -1.0)]
    names += [("sensor_noise", a, ratio) for a in range(outputs) for ratio in _VARIANCE_RATIOS]
    if gyro:
        names += [("sensor_drift", a, sign * _OFFSET) for a in range(outputs) for sign in (1.0, -1.0)]
    return names


class TiltModel:
    """Simulation of the tilt from the motors' positions, with the part of each motor."""

    def __init__(self, tilt: Matrix, lags: tuple[int, ...], motors: int) -> None:
        """Start without positions; `tilt` is (outputs, lags x motors)."""
        self._gains = tilt.reshape(len(tilt), len(lags), motors).copy()
        self._lags = np.array(lags)
        self._past = np.zeros((max(lags) + 1, motors))
        self._begun = False
        self._functions: Any = load_functions(RUNTIME)

    def step(self, positions: Vector) -> Matrix:
        """Return each motor's part of the tilt (motors, outputs) [rad], without the offset."""
        if not self._begun:
            # The motors are at rest before the first sample.
            self._past[:] = positions
            self._begun = True
        parts = np.empty((len(positions), len(self._gains)))
        self._functions.supervised_angle(self._gains, self._lags, self._past, positions, parts)
        return parts


class GyroLevel:
    """Difference of angles and integrated rates, without slow parts: bias of the gyro and initial angle.

    `level`: [rad] (outputs,). `known`: whether the bias was averaged for long enough.
    """

    def __init__(self, outputs: int, step: float) -> None:
        """Start at zero."""
        self._step = step
        self.level = np.zeros(outputs)
        self._bias = np.zeros(outputs)
        self._last: tuple[Vector, Vector] | None = None
        self._late: deque[Vector] = deque()
        self._samples = self._averaged = 0

    @property
    def known(self) -> bool:
        """Whether the bias was averaged for a tenth of its memory."""
        return self._averaged * self._step > _BIAS / 10.0

    def take(self, values: Vector | None, rates: Vector) -> bool:
        """Process a sample; return whether the level was updated."""
        last, self._last = self._last, None
        if values is None or not np.isfinite(rates).all():
            return False
        self._last = (values, rates)
        if last is None:
            return False
        change = values - last[0] - 0.5 * self._step * (rates + last[1])
        self._samples += 1
        self._late.append(change)
        # The bias is estimated from the older half of the samples, or from those older than a drift to detect.
        while len(self._late) > min(self._samples // 2, round(_DRIFT_TIME_S / self._step)):
            self._averaged += 1
            share = max(self._step / _BIAS, 1.0 / self._averaged)
            self._bias = self._bias + share * (self._late.popleft() - self._bias)
        self.level = (1.0 - self._step / _FORGET) * self.level + change - self._bias
        return self.known


class TiltCharts:
    """The charts of all outputs.

    Attributes:
        scores: of the last sample, in the order of `tilt_names`.
        charts: their sums.
        valid: whether the model is valid; off: the reason if it is not valid in this sample, else "".
        residual: tilt minus model [rad]; gyro: tilt against its rates.
        bend: second difference of the residual [rad].
    """

    def __init__(self, baseline: Baseline, thresholds: Vector | None = None) -> None:
        """Start at zero; `thresholds` other than the baseline's are for the calibration."""
        b = self._b = baseline
        n, m = b.motors, b.outputs
        self.names = tilt_names(n, m, gyro=bool(b.gyro_spread))
        self._model = TiltModel(np.array(b.tilt), b.lags, n)
        self._step = b.cycle * b.sample_cycles
        self._hypotheses = 2 * (n + 1) + 2 * m + (m - 1) + 1 + 2 * m
        self._filter = Filter([Whitening(row) for row in b.tilt_whitening], 1 + self._hypotheses)
        self._turned = Filter([Whitening(row) for row in b.gyro_whitening], 1 + 2 * m) if b.gyro_spread else None
        self._functions: Any = load_functions(RUNTIME)
        self._gears, self._noises = np.array(_GEAR_RATIOS), np.array(_VARIANCE_RATIOS)
        self._raw = np.zeros((1 + self._hypotheses, m))
        # Difference of angles and gyro, and its mean for an offset of each output, to either side.
        self._levels = np.vstack([np.zeros(m), np.kron(np.eye(m), np.array([[_OFFSET], [-_OFFSET]]))])
        self.gyro = GyroLevel(m, self._step)
        self._spread, self._gyro_spread = np.array(b.tilt_spread), np.array(b.gyro_spread)
        self._noise = np.array(b.noise)
        # A slow model error also passes through the whitening, and resembles any fault a little.
        passes = np.array([1.0 - sum(row) for row in b.tilt_whitening])
        self._bias_allowed = np.abs(passes) * np.array(b.tilt_bias)
        self._slack = np.array(b.slack)
        self._low, self._high = np.array(b.reach).T
        self.scores = np.zeros(len(self.names))
        self.charts = Charts(np.array(b.tilt_thresholds) if thresholds is None else thresholds)
        late = max(1, round(_FILTER_DELAY_S / self._step))
        self._angles: deque[Vector] = deque(maxlen=late + 1)
        self._residuals: deque[Vector] = deque(maxlen=3)
        self._rest: deque[Vector] = deque(maxlen=_REST_SAMPLES)
        self._began: Matrix | None = None
        self._offset = np.zeros(m)
        self._stuck = np.zeros(m)
        self._explained, self._information = np.zeros(self._hypotheses), np.zeros(self._hypotheses)
        self._running, self._wait = False, _SETTLING_MEMORIES * b.lags[-1]
        self.residual = self.bend = np.zeros(m)
        self.valid, self.off = False, ""

    def begin(self) -> None:
        """Take the mean of the last samples at rest as the offset of tilt and model."""
        self._running = True
        self._align()
        # The motion before the rest is not a bias of the gyro.
        self.gyro = GyroLevel(self._b.outputs, self._step)
        self.charts.sums[:] = 0.0

    def likeliest(self) -> tuple[int, float]:
        """Return the most likely recent fault, and its lead over the next fault of another name.

        -1 if no chart is beyond its threshold.

        Likelihoods over the last half second, with the best size of each fault within 0.7 and 1.4 of its nominal size.
        A gyro that agrees with the angles shows that the neck moved, one that does not that the sensor is wrong.
        """
        beyond = self.charts.sums > self.charts.thresholds
        names = [name for name, _, _ in self.names]
        told = {name for name, over in zip(names, beyond, strict=True) if over}
        if not told & _OF_MODEL:
            # Noise and gyro have charts that no other fault raises.
            return (int(np.argmax(np.where(beyond, self.charts.sums, -np.inf))), math.inf) if told else (-1, 0.0)
        h = self._hypotheses
        size = np.clip(self._explained / np.maximum(self._information, 1e-12), 0.7, 1.4)
        gain = size * self._explained - 0.5 * size**2 * self._information
        alone = 0.0
        if self._turned is not None and self.gyro.known:
            # Log likelihood ratio of angles that differ from the gyro by the whole residual against a moving neck.
            r = self.residual
            alone = max(0.0, float(np.sum(r * (self.gyro.level - 0.5 * r) / np.array(self._b.gyro_wander))))
            gain = gain + alone * np.array([name in _OF_SENSOR for name in names[:h]])
        found = int(np.argmax(gain))
        other = np.array([name != names[found] for name in names[:h]])
        lead = float(gain[found] - np.max(gain[other]))
        if alone > 0.0 and names[found] == "tilt_unexplained":
            found = names.index("sensor_drift") + 2 * self.names[found][1] + int(self.names[found][2] < 0.0)
        return found, lead

    def step(
        self, positions: Vector, taut: Vector, values: Vector | None, rates: Vector, *, known_load: bool = True
    ) -> int:
        """Process one sample; return the number of a chart beyond its threshold, -1 for none.

        `positions`: of the motors (motors,) [rad]. `taut`: tensions of the tendons without friction (motors,) [N].
        `values`: of the tilt (outputs,) [rad]; None if missing. `rates`: of its gyro (outputs,) [rad/s]; NaN without
        one. `known_load`: whether the load of the tendons is within the experiments.
        """
        parts = self._model.step(positions)
        angle = parts.sum(axis=0)
        self._angles.append(angle)
        self._ground(positions, taut, known_load)
        turned = self.gyro.take(values, rates)
        if values is None:
            return -1
        free = values - angle
        self._rest.append(free)
        if self._began is None:
            self._began = parts
        self.residual = free - self._offset
        self._residuals.append(free)
        if len(self._residuals) == 3:
            self.bend = self._residuals[0] - 2.0 * self._residuals[1] + self._residuals[2]
        self._score(parts, angle, turned)
        return self.charts.step(self.scores) if self._running else -1

    # -- parts --------------------------------------------------------------------------------------------------

    def _ground(self, positions: Vector, taut: Vector, known_load: bool) -> None:
        """Mark the model as invalid for slack tendons, larger loads, and motors beyond their calibrated range."""
        self.off = ""
        if not known_load:
            self.off = "more is carried than in the experiments: tilt, tracking and currents rest"
        elif (taut < self._slack).any():
            self.off = "a tendon may hang: tilt and tracking rest"
        elif (positions < self._low).any() or (positions > self._high).any():
            self.off = "a motor is beyond its range in the experiments: tilt and tracking rest"
        out = bool(self.off)
        # Also for the memory of the model afterwards, and once more to average the new offset.
        self._wait = _SETTLING_MEMORIES * self._b.lags[-1] if out else max(0, self._wait - 1)
        before, self.valid = self.valid, self._wait == 0
        if self.valid and not before:
            self._align()

    def _score(self, parts: Matrix, angle: Vector, turned: bool) -> None:
        m, h, run = self._b.outputs, self._hypotheses, self._functions
        began = parts if self._began is None else self._began
        seen = (self.residual, parts, began, self._angles[0], self._stuck)
        run.supervised_faults(self._gears, _OFFSET, seen, self._raw)
        change = self._angles[-1] - self._angles[-min(3, len(self._angles))]
        squares = (change**2, (angle - began.sum(axis=0)) ** 2)
        # Offsets and stuck sensors are hypotheses from now on, not for past samples.
        f = self._filter
        f.seen += 1
        good = self.valid and f.settled
        run.supervised_tilt(
            self._spread, self._bias_allowed, squares, (f.coefficients, f.past, self._raw),
            (self._explained, self._information), math.exp(-self._step / _EVIDENCE_TIME_S), good, self.scores,
        )  # fmt: skip
        run.supervised_noise(self.bend, self._noise, self._noises, good, self.scores[h : h + 2 * m])
        if self._turned is not None:
            self._levels[0] = self.gyro.level
            white = self._turned.step(self._levels)
            told = turned and self._turned.settled
            self.scores[h + 2 * m :] = shift_score(white[0], white[1:], self._gyro_spread) if told else 0.0
        if not good:
            self.charts.sums[: h + 2 * m] = 0.0
        # If a chart is at zero, its fault starts now: a stuck sensor stays at the present angle of the model.
        stuck = 1 + 2 * (self._b.motors + 1)
        for a in range(m):
            if self.charts.sums[stuck - 1 + a] <= 0.0:
                self._stuck[a] = angle[a]
                f.past[:, stuck + a] = 0.0

    def _align(self) -> None:
        """Take the present difference of tilt and model as the offset."""
        if self._rest:
            self._offset = np.mean(self._rest, axis=0)
        self._began = None
        self._filter.reset()
