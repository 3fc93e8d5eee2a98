"""A family against its recordings: measured responses, the weight that covers them, their band, and invalidation.

`y = G0 (1 + D W) u + v` with `|D| <= d` and a bound on the noise v: a record whose transforms leave over more than d
allows invalidates it (Smith and Doyle 1992, IEEE Trans. Automatic Control 37:942; Poolla et al. 1994, ibid. 39:951).
The energies over a band are compared, so d is a lower bound: what is not invalidated is not thereby explained.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix, Vector
from softneck.signals import Recording

from ..linear._srivc_fit import Continuous, Runs, SrivcFit, SrivcFitOptions
from ..models._directions import Directions
from ..models._scores import no_worse
from ._frf_fit import SUPPORTED, FrequencyResponse, frequency_response
from ._local_models import axis_inputs
from ._local_polynomial import ComplexArray

ORDERS = (1, 2, 3)
# The last part of each run is held out, as `softneck identify --train 0.7` does.
_TRAIN_SHARE = 0.7
# Segments of what is held out of each run: their scatter is the standard error of a difference.
_SEGMENTS_PER_RUN = 5


def choose_order(search: SrivcFitOptions, runs: Runs, near: Continuous) -> tuple[Continuous | None, Vector]:
    """Return the model of the chosen order, fitted to all rows, and rms errors (3,) of each order on held-out rows.

    The lowest order whose error is within one standard error of the least is taken (Breiman et al. 1984, 3.4.3); None
    and NaN where none can be fitted. `near`: one pole and dead time to start from.
    """
    squares = {n: found for n in ORDERS if (found := _held_out(replace(search, order=n), runs, near)) is not None}
    errors = {n: error for n, (_, error) in squares.items()}
    rms = np.array([np.sqrt(errors[n].mean()) if n in errors else np.nan for n in ORDERS])
    if not errors:
        return None, rms
    best = min(errors, key=lambda n: float(errors[n].mean()))
    order = next(n for n in sorted(errors) if n == best or no_worse(errors[n], errors[best]))
    start = squares[order][0]
    fit = replace(search, order=order).improve(runs, start.model, start.starts)
    return (start if fit is None else fit).model, rms


def _held_out(search: SrivcFitOptions, runs: Runs, near: Continuous) -> tuple[SrivcFit, Vector] | None:
    """Return a fit and its mean squared errors in simulation over segments that it did not see; None without a fit."""
    trained = []
    for u, y in runs:
        seen = y.copy()
        seen[round(_TRAIN_SHARE * y.size) :] = np.nan
        trained.append((u, seen))
    # As many poles of n times the speed lag as much as one; others leave valleys where dead time is a pole.
    speeds = (1.0, 0.3, 3.0) if search.order > 1 else (1.0,)
    tried = [search.start(trained, search.order * k * float(near.a[0]), near.delay) for k in speeds]
    there = [fit for fit in tried if fit is not None and fit.model.a[-1] * fit.model.b[0] > 0.0]
    if not there:
        return None
    fit = min(there, key=lambda fit: fit.cost)
    squares = []
    for (_, y), simulated in zip(runs, fit.simulated, strict=True):
        late = slice(round(_TRAIN_SHARE * y.size), None)
        squares += [float(np.nanmean(part)) for part in np.array_split((y - simulated)[late] ** 2, _SEGMENTS_PER_RUN)
                    if np.isfinite(part).any()]  # fmt: skip
    return fit, np.array(squares)


# Time constants after which a run's start is forgotten: exp(-5) is below 1 %.
_SETTLING_TIME_CONSTANTS = 5.0
# The noise is white, and seen above this part of the Nyquist frequency, where nothing else is.
_NOISE_ABOVE = 0.7


def least_uncertainty(
    runs: Sequence[tuple[Vector, Vector]],
    model: Continuous,
    frequency: Vector,
    weight: Vector,
    band: tuple[float, float],
    sample_time: float,
) -> float:
    """Return the smallest norm of the uncertainty, relative to the weight (m,), that explains a record in a band.

    Missing outputs are filled by straight lines. NaN where no run has three frequencies in the band [rad/s].
    """
    left, noise, allowed, lines = 0.0, 0.0, 0.0, 0
    for u, y in runs:
        w, E, Y0, floor = _transform_errors(u, y, model, sample_time)
        there = (w >= band[0]) & (w <= band[1])
        W = np.interp(np.log(np.maximum(w[there], 1e-9)), np.log(frequency), weight)
        left += float(np.sum(np.abs(E[there]) ** 2))
        allowed += float(np.sum((W * np.abs(Y0[there])) ** 2))
        noise += floor * int(there.sum())
        lines += int(there.sum())
    if lines < 3 or allowed <= 0.0:
        return float("nan")
    return max(0.0, float(np.sqrt(left) - np.sqrt(noise))) / float(np.sqrt(allowed))


def _transform_errors(
    u: Vector, y: Vector, model: Continuous, sample_time: float
) -> tuple[Vector, ComplexArray, ComplexArray, float]:
    """Return frequencies [rad/s], transforms of the nominal model's error and output, and the noise power."""
    from scipy.signal import detrend

    y0 = nominal_output(model, u, sample_time)
    there = np.isfinite(y)
    y = np.interp(np.arange(y.size), np.flatnonzero(there), y[there])
    slowest = float(-np.roots(np.concatenate([[1.0], model.a])).real.max())
    first = min(round((_SETTLING_TIME_CONSTANTS / slowest + model.delay) / sample_time), u.size // 3)
    window = np.hanning(u.size - first)
    E, Y0, Y = (np.fft.rfft(window * detrend(part[first:], type="constant")) for part in (y - y0, y0, y))
    w = 2.0 * np.pi * np.fft.rfftfreq(window.size, sample_time)
    return w, E, Y0, float(np.median(np.abs(Y[w > _NOISE_ABOVE * w[-1]]) ** 2)) / np.log(2.0)


def nominal_output(model: Continuous, u: Vector, sample_time: float) -> Vector:
    """Return the model's response to `u` (time,), constant before its start."""
    from scipy.signal import lfilter

    a, b, d = model.discretize(sample_time)
    late = np.concatenate([np.zeros(d + 1), u - u[0]])[: u.size]
    below = np.concatenate([[1.0], a])
    return np.asarray(lfilter(b, below, late)) + u[0] * model.b[-1] / model.a[-1]


# Frequencies of the weight, and the ratio of the ends of each band that whole records are judged in; by definition.
_FREQUENCIES, _BAND_RATIO = 60, 1.5
_ARRAY_NAMES = ("a", "b", "delay", "held_out", "points", "frequency", "weight", "borders", "needed")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisMeasured:
    """Measured responses of one axis; gains in SI of output over its own input.

    model: nominal of one, two or three poles behind a dead time; held_out: (3,) rms error [SI] of each order in free
    run on rows held out, NaN without a fit; points: (p, 5) recording, frequency [rad/s], real and imaginary part of the
    response, radius of its circle; frequency: (m,) [rad/s] of the band that the data support; weight: (m,) `|G/G0 - 1|
    <= weight` for all circles; borders: (b + 1,) of the bands in which whole records are judged [rad/s]; needed:
    (recordings, b) times the weight that each needs, NaN where it does not excite.
    """

    model: Continuous
    held_out: Vector
    points: Matrix
    frequency: Vector
    weight: Vector
    borders: Vector
    needed: Matrix

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency that the data support [rad/s]."""
        return float(self.frequency[0]), float(self.frequency[-1])

    def weight_at(self, frequency: Vector) -> Vector:
        """Return the weight at frequencies of the band [rad/s]."""
        return np.interp(np.log(frequency), np.log(self.frequency), self.weight)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file."""
        model = {"a": self.model.a, "b": self.model.b, "delay": np.array([self.model.delay])}
        return {name: model[name] if name in model else getattr(self, name) for name in _ARRAY_NAMES}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], recordings: int) -> AxisMeasured:
        """Return the object of `arrays`; FileFormatError for shapes that do not fit, or numbers that are none."""
        m, b = arrays["frequency"].size, max(arrays["borders"].size - 1, 0)
        shapes = {"delay": (1,), "held_out": (3,), "points": (len(arrays["points"]), 5), "frequency": (m,),
                  "weight": (m,), "needed": (recordings, b)}  # fmt: skip
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise FileFormatError(f"its measured `{name}` has shape {arrays[name].shape}; {shape} is needed.")
        for name in ("a", "b", "delay", "points", "frequency", "weight", "borders"):
            if not np.isfinite(arrays[name]).all():
                raise FileFormatError(f"its measured `{name}` is not finite.")
        w, model = arrays["frequency"], Continuous(a=arrays["a"], b=arrays["b"], delay=float(arrays["delay"][0]))
        if (
            m < 2 or (np.diff(w) <= 0.0).any() or w[0] <= 0.0 or (arrays["weight"] < 0.0).any()
            or not 1 <= model.a.size <= 3 or model.b.size != 1 or not 0.0 <= model.delay < np.inf
            or np.roots(np.concatenate([[1.0], model.a])).real.max() >= 0.0
        ):  # fmt: skip
            raise FileFormatError("its measured band, weight or nominal model is none of ours.")
        return cls(model=model, **{name: arrays[name] for name in _ARRAY_NAMES if name not in ("a", "b", "delay")})


def response_of(model: Continuous, frequency: Vector, sample_time: float) -> np.ndarray:
    """Return the response of a model at `frequency` [rad/s], its input held between samples."""
    a, b, d = model.discretize(sample_time)
    z = np.exp(1j * frequency * sample_time)
    return np.polyval(b, z) / np.polyval(np.concatenate([[1.0], a]), z) * z ** (a.size - b.size - d)


def measured_responses(
    recordings: Sequence[Recording], source: str
) -> tuple[list[FrequencyResponse | None], list[str]]:
    """Return the response of every recording, None where it shows none, and why."""
    found: list[FrequencyResponse | None] = []
    why: list[str] = []
    for number, recording in enumerate(recordings):
        try:
            found.append(frequency_response(recording, source=source))
        except DataError as error:
            found.append(None)
            why.append(f"recording {number + 1}: {error}")
    return found, why


def axis_runs(
    recordings: Sequence[Recording], directions: Directions, source: str, axis: int
) -> list[list[tuple[Vector, Vector]]]:
    """Return of each recording the input and the output (time,) of an axis in every run."""
    return [
        [(axis_inputs(run, directions, source)[:, axis], run.outputs[:, axis]) for run in part.runs()]
        for part in recordings
    ]


def axis_points(
    responses: Sequence[FrequencyResponse | None], axis: int, directions: Directions, confidence: float
) -> Matrix:
    """Return the supported points (p, 5) of the responses of one axis."""
    rows = []
    for number, found in enumerate(responses):
        seen = None if found is None else _own_response(found, axis, directions, confidence)
        if found is None or seen is None:
            continue
        G, radius = seen
        with np.errstate(invalid="ignore"):
            good = radius <= SUPPORTED * np.abs(G)
        # Two in a row: one circle in twenty is smaller than it should be.
        pairs = np.flatnonzero(good[1:] & good[:-1])
        if pairs.size:
            part = slice(pairs[0], pairs[-1] + 2)
            table = np.column_stack([np.full(G.size, float(number)), found.frequency, G.real, G.imag, radius])
            # A wider circle between them says nothing of the plant; the whole record is judged in time besides.
            rows.append(table[part][good[part]])
    return np.concatenate(rows) if rows else np.zeros((0, 5))


def recordings_without_response(
    points: Matrix, runs: Sequence[Sequence[tuple[Vector, Vector]]], names: Sequence[str]
) -> list[str]:
    """Return the names of recordings that move an axis and show no response of it: no weight can speak for them.

    Friction, or tendons that a payload has made slack, hide what a loop that pulls them taut then meets.
    """
    heard = set(points[:, 0].astype(int).tolist())
    # Rounding moves nothing.
    moved = [any(np.ptp(u) > 1e-6 for u, _ in parts) for parts in runs]
    return [name for number, name in enumerate(names) if moved[number] and number not in heard]


def _own_response(
    found: FrequencyResponse, axis: int, directions: Directions, confidence: float
) -> tuple[ComplexArray, Vector] | None:
    """Return response (k,) and radius (k,) from an axis' own input to its output; None where that was not moved."""
    from scipy.stats import f

    output = directions.names[axis]
    own = found.robot.input_names[axis]
    share = np.array([float(name == own) for name in found.inputs])
    if own not in found.inputs and found.robot.weights() is None:
        # The inputs are the motors: of `G_j = G w_j` least squares gives G.
        weights = directions.weights[axis]
        motors = list(found.robot.set_points)
        if any(weight and name not in found.inputs for name, weight in zip(motors, weights, strict=True)):
            return None
        share = np.array([weights[motors.index(name)] if name in motors else 0.0 for name in found.inputs])
        share = share / float(weights @ weights)
    if not share.any():
        return None
    i, q = found.outputs.index(output), len(found.inputs)
    used = np.flatnonzero(share)
    C = found.covariance[:, i * q : (i + 1) * q, i * q : (i + 1) * q][:, used][:, :, used]
    variance = np.einsum("a,kab,b->k", share[used], C, share[used]).real
    factor = np.asarray(f.ppf(confidence, 2, 2.0 * np.maximum(found.freedom, 1e-9)))
    return found.response[:, i, used] @ share[used], np.sqrt(np.maximum(variance, 0.0) * factor)


def middle_model(start: Continuous, points: Matrix, sample_time: float, max_delay: float) -> Continuous:
    """Return the model of the start's order nearest to the measured responses, in parts of themselves.

    Least squares, each recording alike; a point whose circle is as large as what is called supported counts half.
    """
    from scipy.optimize import least_squares

    counts = np.bincount(points[:, 0].astype(int))
    G = points[:, 2] + 1j * points[:, 3]
    share = 1.0 / (np.abs(G) + points[:, 4] / SUPPORTED) / np.sqrt(counts[points[:, 0].astype(int)])

    def model_of(x: Vector) -> Continuous:
        # Coefficients by their logarithms; a polynomial of degree two or three of them may still be unstable.
        return Continuous(a=np.exp(x[: start.a.size]), b=np.exp(x[start.a.size : -1]) * np.sign(start.b), delay=x[-1])

    def errors(x: Vector) -> Vector:
        model = model_of(x)
        unstable = float(np.roots(np.concatenate([[1.0], model.a])).real.max()) >= 0.0
        if unstable:
            return np.full(2 * G.size, 1e3)
        e = share * (G - response_of(model, points[:, 1], sample_time))
        return np.concatenate([e.real, e.imag])

    if (start.a <= 0.0).any() or not np.any(start.b):
        return start
    x = np.concatenate([np.log(start.a), np.log(np.abs(start.b)), [min(start.delay, max_delay)]])
    # By a factor of e to each side of the fit in time: circles as wide as half a response leave far more open.
    low, high = np.append(x[:-1] - 1.0, -1e-9), np.append(x[:-1] + 1.0, max_delay + 1e-9)
    found = least_squares(errors, x, bounds=(low, high), x_scale=np.append(np.ones(x.size - 1), 0.02), max_nfev=200)
    best = found.x if np.sum(errors(found.x) ** 2) < np.sum(errors(x) ** 2) else x
    best[-1] = np.clip(best[-1], 0.0, max_delay)
    return model_of(best)


def covering_weight(model: Continuous, points: Matrix, sample_time: float) -> tuple[Vector, Vector]:
    """Return frequencies (m,) over the band, and the largest relative error of all circles between and at them (m,)."""
    w = np.geomspace(points[:, 1].min(), points[:, 1].max(), _FREQUENCIES)
    weight = np.zeros(w.size)
    for number in np.unique(points[:, 0]):
        own = points[points[:, 0] == number]
        G0 = response_of(model, own[:, 1], sample_time)
        error = np.abs((own[:, 2] + 1j * own[:, 3]) / G0 - 1.0) + own[:, 4] / np.abs(G0)
        # Between two points the larger of both; each point also counts at the frequency before and behind it.
        after = np.clip(np.searchsorted(own[:, 1], w), 0, len(own) - 1)
        there = (w >= own[0, 1] / 1.05) & (w <= own[-1, 1] * 1.05)
        weight = np.where(there, np.maximum(weight, np.maximum(error[after], error[np.maximum(after - 1, 0)])), weight)
        at = np.clip(np.searchsorted(w, own[:, 1]), 1, w.size - 1)
        np.maximum.at(weight, at, error)
        np.maximum.at(weight, at - 1, error)
    return w, weight


def band_borders(low: float, high: float) -> Vector:
    """Return borders [rad/s] of bands from end to end whose ends are at most a factor of 1.5 apart."""
    return np.geomspace(low, high, max(1, int(np.ceil(np.log(high / low) / np.log(_BAND_RATIO)))) + 1)


def judge_records(
    runs: Sequence[Sequence[tuple[Vector, Vector]]], measured: AxisMeasured, points: Matrix, sample_time: float
) -> Matrix:
    """Return (recordings, bands) how many times the weight each whole record needs; NaN where `points` excite none."""
    needed = np.full((len(runs), measured.borders.size - 1), np.nan)
    for number, parts in enumerate(runs):
        own = points[points[:, 0] == number, 1]
        if own.size == 0:
            continue
        for band, (low, high) in enumerate(pairwise(measured.borders)):
            # A band that the record excites in part is judged there.
            ends = max(low, float(own[0])), min(high, float(own[-1]))
            if ends[1] > 1.1 * ends[0]:
                needed[number, band] = least_uncertainty(
                    parts, measured.model, measured.frequency, measured.weight, ends, sample_time
                )
    return needed


def raise_weight(measured: AxisMeasured) -> AxisMeasured:
    """Return it with the weight raised where a whole record needs more than its response does.

    What a nonlinear robot adds is in the record and in no linear response of it.
    """
    known = np.where(np.isfinite(measured.needed), measured.needed, 0.0).max(axis=0, initial=0.0)
    band = np.clip(np.searchsorted(measured.borders, measured.frequency, side="right") - 1, 0, known.size - 1)
    # A border belongs to the bands on both its sides.
    factor = np.maximum(known[band], 1.0)
    wider = np.maximum(factor, np.maximum(np.append(factor[1:], 1.0), np.append(1.0, factor[:-1])))
    return replace(measured, weight=measured.weight * wider)


def digest(recording: Recording) -> str:
    """Return the SHA-256 of a recording's times, set-points and outputs."""
    parts = (recording.time, recording.set_points, recording.outputs, recording.run)
    return hashlib.sha256(b"".join(np.ascontiguousarray(part, dtype="<f8").tobytes() for part in parts)).hexdigest()


def needed_lines(measured: AxisMeasured, names: Sequence[str], axis: str) -> list[str]:
    """Return a line for each record that needs more than the weight: "steps.csv needs 1.7 times the weight ..."."""
    lines = []
    for name, row in zip(names, measured.needed, strict=True):
        known = np.where(np.isfinite(row), row, 0.0)
        band = int(np.argmax(known)) if known.size else 0
        if known.size and known[band] > 1.0:
            low, high = measured.borders[band], measured.borders[band + 1]
            lines.append(f"{axis}: {name} needs {known[band]:.4g} times the weight at {low:.2g} to {high:.2g} rad/s")
    return lines
