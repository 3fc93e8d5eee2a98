"""Output error: transfer functions with dead time, fitted by their simulation error, by variable projection.

`y(k) = B(q) / F(q) u(k - d) + c(q) / F(q) pulse(k) + e(k)`: only the poles are searched; B and c, the start of each
run, are projected out (Golub and Pereyra 2003; Ljung 1999, sec. 10.2). Derivatives are exact, by filters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    compute_once,
    one_blas_thread,
    require_one_of,
    require_whole,
    silent,
)
from softneck.signals import Recording, assess_quality

from ..models._drive import fit_drive
from ..models._fitting import MAX_DELAY, ScaledData, best_delay, delay_samples, free_run_fit, training_recording
from ..models._linear_systems import axes_system, lss_arrays
from ..models._model import Model
from ._regression import (
    arx_rows,
    axis_arrays,
    check_delays,
    functions_found,
    linear_in_si,
    require_excitation,
    with_offset,
)
from ._srivc_fit import Runs, SrivcFitOptions, deviations

# Time constants are at most a third of the longest run; slower poles only fit a drift.
_RUNS_PER_TIME_CONSTANT = 3.0
# Turns within the longest run from which a pole is a mode, and its smallest decay within that run [log].
_FEW_TURNS, _RINGING_DECAY = 3.0, 0.01
_MAX_ITERATIONS = 50
# Relative decrease of the sum of squares at which the search ends: far below the noise.
_COST_TOLERANCE = 1e-10
# Starts of the search beside least squares [scaled s]: a neck's time constant and values around it.
_START_TIME_CONSTANTS_S = (0.05, 0.2, 0.8)
# Two poles are taken where they leave at most so much of the error of one, and more where they oscillate, unless one
# fits so well [%]. On linear robots of second order they leave 0.01 to 0.07, on oscillating ones with hysteresis 0.37
# to 0.53; on others they leave 0.75 and more where they oscillate, else 0.46 and more.
_LEFT_OVER, _LEFT_OVER_OSCILLATING, _GOOD_FIT = 1.0 / 3.0, 2.0 / 3.0, 99.0
# -log of the rounding of a double.
_LOG_PRECISION = 36.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OutputErrorFit:
    """One axis at one dead time: f (nf,) without its leading one, b (nb,), the sum of squared errors `cost`.

    covariance: (nf + nb, nf + nb) of (f, b), if the output noise is white; constant: of the output.
    """

    f: Vector
    b: Vector
    cost: float
    covariance: Matrix
    constant: float


def fit_output_error(
    runs: Runs, nf: int, nb: int, d: int, starts: Sequence[Vector], *, constant: bool = False
) -> OutputErrorFit | None:
    """Fit one axis at dead time `d` from all `starts` (nf,); None where no fit is stable.

    `constant`: outputs are off by a constant. A mean is not that constant where a run starts away from equilibrium.
    """
    best: tuple[float, Vector] | None = None
    radius = largest_radius(runs)
    for start in starts:
        found = _search(runs, nb, d, limit_poles(start, radius), radius, constant)
        if best is None or found[0] < best[0]:
            best = found
    if best is None or not np.isfinite(best[0]):
        return None
    f = best[1]
    b, J, r = _at_poles(runs, f, nb, d, constant)
    cost = float(r @ r)
    covariance = cost / max(r.size - nf - nb - nf * len(runs), 1) * np.linalg.pinv(J.T @ J, hermitian=True)
    covariance = covariance[: nf + nb, : nf + nb]
    return OutputErrorFit(f=f, b=b[:nb], cost=cost, covariance=covariance, constant=float(b[nb:].sum()))


def prediction_slopes(runs: Runs, fit: OutputErrorFit, d: int, *, constant: bool) -> tuple[Matrix, Vector]:
    """Return the derivatives of the outputs by (f, b, constant), (rows, n), and the errors (rows,), without starts."""
    return _at_poles(runs, fit.f, fit.b.size, d, constant)[1:]


def _at_poles(runs: Runs, f: Vector, nb: int, d: int, constant: bool) -> tuple[Vector, Matrix, Vector]:
    """Return the best b and constant, the derivatives of the outputs by f and these, and the errors."""
    X, y, parts = _columns(runs, f, nb, d, constant)
    b = np.linalg.lstsq(X, y)[0]
    return b, np.column_stack([_pole_columns(runs, f, b, parts), X]), y - X @ b


def default_starts(nf: int, sample_time: float, least_squares: Vector | None) -> list[Vector]:
    """Return denominators to start from: that of least squares, and those of typical time constants."""
    starts = [] if least_squares is None else [least_squares]
    for tau in _START_TIME_CONSTANTS_S:
        poles = np.exp(-sample_time / (tau * np.geomspace(1.0, 0.3, nf)))
        starts.append(np.poly(poles)[1:])
    return starts


def largest_radius(runs: Runs) -> float:
    """Return the bound on the size of the poles, which must settle within a run."""
    return float(np.exp(-_RUNS_PER_TIME_CONSTANT / max(u.size for u, _ in runs)))


def _exceeds(f: Vector, radius: float) -> bool:
    """Return whether a pole is larger than its bound; one that turns several times in a run may decay hardly at all."""
    poles = _poles(f)
    return bool((np.abs(poles) > _bounds(poles, radius)).any())


def _bounds(poles: np.ndarray, radius: float) -> Vector:
    """Return the bound on the size of each pole: `radius`, and of a mode nearly one."""
    decay = -np.log(radius)
    turns = np.abs(np.angle(poles)) * _RUNS_PER_TIME_CONSTANT > 2.0 * np.pi * _FEW_TURNS * decay
    # A negative real pole alternates with each sample: it is no mode.
    return np.where(turns & (np.imag(poles) != 0.0), radius ** (_RINGING_DECAY / _RUNS_PER_TIME_CONSTANT), radius)


def _search(runs: Runs, nb: int, d: int, f: Vector, radius: float, constant: bool) -> tuple[float, Vector]:
    """Minimise the projected cost over f by Levenberg and Marquardt, with Kaufman's derivative."""
    cost, r, J = _project_linear(runs, f, nb, d, constant)
    damping = 1e-3
    for _ in range(_MAX_ITERATIONS):
        H, g = J.T @ J, J.T @ r
        gained = 0.0
        while damping < 1e8:
            step = np.linalg.solve(H + damping * np.diag(np.maximum(np.diag(H), 1e-300)), g)
            trial = f + step
            if not _exceeds(trial, radius):
                new = _project_linear(runs, trial, nb, d, constant)
                if new[0] < cost:
                    gained = cost - new[0]
                    f, (cost, r, J) = trial, new
                    damping = max(damping / 10.0, 1e-12)
                    break
            damping *= 10.0
        if gained <= _COST_TOLERANCE * cost:
            break
    return cost, f


def _project_linear(runs: Runs, f: Vector, nb: int, d: int, constant: bool) -> tuple[float, Vector, Matrix]:
    """Return cost, residual and derivative of the prediction by f, with b, constant and starts eliminated."""
    X, y, parts = _columns(runs, f, nb, d, constant)
    Q, to_b = _orthonormal_basis(X)
    along = Q.T @ y
    r = y - Q @ along
    S = _pole_columns(runs, f, to_b @ along, parts)
    return float(r @ r), r, S - Q @ (Q.T @ S)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Of one run: its inputs through 1/F, and the responses to its start.

    forced: (time, nb); response, basis: (up to time, nf), and orthonormal; there: (time,) whether its output was
    measured.
    """

    forced: Matrix
    response: Matrix
    basis: Matrix
    there: np.ndarray


def _columns(runs: Runs, f: Vector, nb: int, d: int, constant: bool) -> tuple[Matrix, Vector, list[_Part]]:
    """Return regressors of b and constant (rows, nb or nb + 1), outputs (rows,), and the parts of each run."""
    columns, targets, parts = [], [], []
    for u, y in runs:
        there = np.isfinite(y)
        response = _start_responses(f, u.size)
        Q, _ = _orthonormal_basis(response[there[: len(response)]])
        forced = _input_columns(u, f, nb, d)
        X = np.column_stack([forced, np.ones(len(forced))]) if constant else forced
        columns.append(_project_off(Q, X[there]))
        targets.append(_project_off(Q, y[there]))
        parts.append(_Part(forced, response, Q, there))
    return np.concatenate(columns), np.concatenate(targets), parts


def _pole_columns(runs: Runs, f: Vector, b: Vector, parts: list[_Part]) -> Matrix:
    """Return the derivative of the output by f, `-q^-i / F y`, without the starts' part; b (nb,), then a constant."""
    F = np.concatenate([[1.0], f])
    found = []
    for (_, y), part in zip(runs, parts, strict=True):
        there, nb = part.there, part.forced.shape[1]
        output = part.forced @ b[:nb]
        # F filters the whole output but its constant, with its own start.
        n = len(part.response)
        seen = there[:n]
        left = y[:n][seen] - output[:n][seen] - b[nb:].sum()
        output[:n] += part.response @ np.linalg.lstsq(part.response[seen], left)[0]
        S = np.column_stack([_delay(-_filter_all_pole(F, output), i) for i in range(1, f.size + 1)])[there]
        found.append(_project_off(part.basis, S))
    return np.concatenate(found)


def _input_columns(u: Vector, f: Vector, nb: int, d: int) -> Matrix:
    """Return `u(k - d - j) / F` for j = 1..nb as (time, nb), with u(0) before the recording."""
    from scipy.signal import lfilter

    F = np.concatenate([[1.0], f])
    gain = u[0] / F.sum()
    # The filter starts in equilibrium; the start of the run accounts for the difference.
    z0 = np.zeros(f.size)
    for i in range(f.size - 1, -1, -1):
        z0[i] = -f[i] * gain + (z0[i + 1] if i + 1 < f.size else 0.0)
    columns = []
    for j in range(1, nb + 1):
        late = min(d + j, u.size)
        delayed = np.concatenate([np.full(late, u[0]), u[: u.size - late]])
        columns.append(lfilter([1.0], F, delayed, zi=z0)[0])
    return np.column_stack(columns)


def _start_responses(f: Vector, size: int) -> Matrix:
    """Return `q^-i / F` of a pulse at the first sample, (up to size, nf), a basis of all starts."""
    # The responses end where they are below rounding, after a second or two.
    pulse = np.zeros(min(size, int(_LOG_PRECISION / -np.log(max(pole_radius(f), 0.1))) + f.size + 1))
    pulse[0] = 1.0
    first = _filter_all_pole(np.concatenate([[1.0], f]), pulse)
    return np.column_stack([_delay(first, i) for i in range(f.size)])


def _project_off(Q: Matrix, X: Matrix) -> Matrix:
    """Return `X` with its first rows projected off the basis `Q` of a start."""
    rest = X.copy()
    n = len(Q)
    rest[:n] -= Q @ (Q.T @ X[:n])
    return rest


def _filter_all_pole(F: Vector, x: Vector) -> Vector:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], F, x))


def _orthonormal_basis(X: Matrix) -> tuple[Matrix, Matrix]:
    """Return an orthonormal basis Q of the columns' span, and M with `X M = Q` of the least norm."""
    U, s, Vt = np.linalg.svd(X, full_matrices=False)
    kept = s > 1e-12 * max(float(s.max(initial=0.0)), 1e-300)
    return U[:, kept], Vt[kept].T / s[kept]


def _delay(x: Vector, samples: int) -> Vector:
    return np.concatenate([np.zeros(samples), x[: x.size - samples]]) if samples else x


def pole_radius(f: Vector) -> float:
    """Return the absolute value of the largest root of z^n + f_1 z^(n-1) + ..."""
    return float(np.abs(_poles(f)).max(initial=0.0))


def _poles(f: Vector) -> np.ndarray:
    """Return the roots of z^n + f_1 z^(n-1) + ...; of one pole without an eigenvalue problem."""
    return -f if f.size == 1 else np.roots(np.concatenate([[1.0], f]))


def limit_poles(f: Vector, radius: float) -> Vector:
    """Return `f` with its poles moved within `radius`."""
    poles = _poles(f)
    size = np.abs(poles)
    bounds = _bounds(poles, radius)
    if (size <= bounds).all():
        return f
    inside = np.where(bounds == radius, 0.99 * radius, bounds) * poles / np.maximum(size, 1e-300)
    return np.real(np.poly(np.where(size <= bounds, poles, inside)))[1:]


SOURCES = ("set_points", "positions")
# 97.5 % quantile of the standard normal distribution, for 95 % intervals.
_NORMAL_QUANTILE = 1.959964
_INTERVALS_CAUTION = (
    "the intervals cover noise on one linear system; the gain, pole and dead time of a nonlinear neck vary more over "
    "its range: use a `family` for that"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputError:
    """Transfer functions from redefined inputs (of a neck theta_i, phi_i) by output error (Ljung 1999, 4.2 and 10.2).

    Each output follows its direction, given or learned from the data. The fit is unbiased under output noise, where
    that of `rls` is biased. It has no noise model: a prediction some samples ahead is a simulation that starts from
    the measured outputs.

    Attributes:
        nf, nb: poles, and coefficients of the numerator. None: one pole, or two where the motors excite a lightly
            damped mode of an output (`assess_quality` finds it on held-out rows), or, with no dead time given, where
            two leave at most a third of the error, two thirds if they oscillate; as many coefficients as poles.
        delay: dead time [s]; None takes the one of the smallest cost.
        max_delay: end of that search [s]; None: one and a half time constants of the robot (of a neck 0.3 s).
        source: input of the model: "set_points", or "positions" of the motors, which the drive model simulates from
            the set-points.
        intervals: add 95 % intervals of K, pole, dead time and static gain to the findings (one pole only).
    """

    nf: int | None = None
    nb: int | None = None
    delay: float | None = None
    max_delay: float | None = None
    source: str = "set_points"
    intervals: bool = False

    def __post_init__(self) -> None:
        if self.nf is not None:
            require_whole("nf", self.nf, 1, 10)
        if self.nb is not None:
            require_whole("nb", self.nb, 1, 100)
        check_delays(self.delay, self.max_delay)
        require_one_of("source", self.source, SOURCES)
        if self.intervals and not {self.nf, self.nb} <= {None, 1}:
            raise SettingsError("`intervals` are those of one pole; set `nf` and `nb` to 1 with it.")

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify all axes; each run has its own start, and missed samples do not count.

        Raises:
            DataError: too short, constant, not enough excitation, or no stable model.
        """
        recording = training_recording(recordings)
        # Kinds that begin with it ask for it again.
        return compute_once(lambda: self._with_modes(recording, progress), self, recording)

    def _with_modes(self, recording: Recording, progress: Progress) -> Model:
        modes = {}
        if not self.intervals and self.nf != 1:
            found = assess_quality(recording, bandwidth=1.0).modes
            modes = {name: (mode.frequency, mode.damping) for name, mode in found.items()}
        nf = self.nf or (2 if modes else 1)
        model = replace(self, nf=nf, nb=self.nb or (nf if self.nf is None else 1))._fit(recording, modes, progress)
        asked = self.intervals or (self.nf, self.nb, self.delay) != (None, None, None)
        if nf > 1 or asked or not self._needs_two_poles(model, recording):
            return model
        return replace(self, nf=2, nb=2)._fit(recording, modes, progress)

    def _needs_two_poles(self, model: Model, recording: Recording) -> bool:
        """Return whether two poles leave much less of an output over than the model of one pole.

        One pole makes a dead time of the second: two are tried with less of it too.
        """
        scaled = ScaledData.of(recording)
        for name, runs in zip(scaled.directions.names, axis_runs(scaled, self.source), strict=True):
            late, fit, _ = max(model.findings["delay_curve"][name], key=lambda one: one[1])
            if fit >= _GOOD_FIT:
                continue
            d, spread = round(late / recording.sample_time), _spread(runs)
            columns = [(y[:, None], u[:, None]) for u, y in runs]
            for dead in (d, d // 2, 0):
                Phi, Y = arx_rows(columns, 2, 2, dead)
                start = np.linalg.lstsq(Phi, Y[:, 0])[0][:2]
                found = fit_output_error(runs, 2, 2, dead, [start], constant=scaled.has_offset)
                if found is None:
                    continue
                most = _LEFT_OVER_OSCILLATING if np.iscomplex(_poles(found.f)).any() else _LEFT_OVER
                if 100.0 - _percent(found.cost, spread) <= most * (100.0 - fit):
                    return True
        return False

    @property
    def _poles(self) -> int:
        return self.nf or 1

    @property
    def _numerator(self) -> int:
        return self.nb or 1

    def _fit(self, recording: Recording, modes: Mapping[str, tuple[float, float]], progress: Progress) -> Model:
        scaled = ScaledData.of(recording)
        settings = replace(self, delay=scaled.seconds(self.delay), max_delay=scaled.longest_delay(self.max_delay))
        names, Ts, inputs = scaled.directions.names, scaled.data.sample_time, axis_runs(scaled, self.source)
        found: list[OutputErrorFit] = []
        delays, curves, beside = [], {}, {}
        for axis, name in enumerate(names):
            progress(axis / len(inputs), name)
            start = _mode_start(modes.get(name), self._poles, recording.sample_time)
            fit, d, curves[name], beside[name] = settings._fit_axis(Ts, inputs[axis], name, start, scaled.has_offset)
            found.append(fit)
            delays.append(d)
        arrays, functions = self.arrays_of(scaled, found, delays)
        intervals = {}
        if self.intervals:
            each = [settings._intervals(Ts, *one) for one in zip(inputs, found, delays, strict=True)]
            intervals = {"intervals": dict(zip(names, each, strict=True)), "caution": _INTERVALS_CAUTION}
        text = "its slowest pole is at the bound of a third of the longest run, a drift; lower `nf` or record longer."
        warnings = [
            f"{name}: {text}"
            for name, bound, fit in zip(names, map(largest_radius, inputs), found, strict=True)
            if _exceeds(fit.f, bound - 1e-3 * (1.0 - bound))
        ]
        findings = {
            **functions,
            "delay_criterion": "output_error",
            "delay_curve": curves,
            "parameter_std": [np.sqrt(np.diag(fit.covariance)).tolist() for fit in found],
            "least_squares_beside": beside,
            **({"warnings": warnings} if warnings else {}),
            **intervals,
        }
        progress(1.0, "done")
        return scaled.model("oe", self, linear_in_si, arrays=arrays, findings=_in_si(findings, scaled, self._poles))

    def arrays_of(
        self, scaled: ScaledData, found: list[OutputErrorFit], delays: list[int]
    ) -> tuple[dict[str, Matrix], dict[str, Any]]:
        """Return the arrays of the runtime, and the findings that belong to them.

        A model of one pole starts from its last measured output. One of more poles or with an offset has a Kalman
        observer, as noise on the last outputs would determine its slow states.
        """
        drive = fit_drive(scaled.data)
        a, b = [fit.f for fit in found], [fit.b for fit in found]
        source = int(self.source == "positions")
        if self._poles == 1 and not scaled.has_offset:
            arrays = axis_arrays(scaled.directions.redefinition, drive, np.array(a), np.array(b), delays)
            return {**arrays, "source": np.array([float(source)])}, {}
        common = min(delays)
        late = [np.concatenate([np.zeros(d - common), part]) for d, part in zip(delays, b, strict=True)]
        system = axes_system(a, late, scaled.directions.weights)
        arrays = lss_arrays(system, delay=common, drive=drive.array, source=source)
        if scaled.has_offset:
            arrays = with_offset("oe", arrays, scaled.data)
        return arrays, functions_found(scaled, a, b, delays)

    def _fit_axis(
        self, sample_time: float, runs: list[tuple[Vector, Vector]], name: str, start: list[Vector], constant: bool
    ) -> tuple[OutputErrorFit, int, list[list[float]], dict[str, Any]]:
        """Return the best fit, its dead time, the cost curve (delay [s], fit [%], one-step rms) and ARX findings."""
        columns = [(y[:, None], u[:, None]) for u, y in runs]
        spread = _spread(runs)
        fits: dict[int, OutputErrorFit] = {}
        curve: list[list[float]] = []
        last: list[Vector] = []

        def cost(d: int) -> float:
            Phi, Y = arx_rows(columns, self._poles, self._numerator, d)
            require_excitation(name, Phi)
            arx = np.linalg.lstsq(Phi, Y[:, 0])[0]
            # The optimum of one dead time is a good start for the next.
            others = [*start, *default_starts(self._poles, sample_time, arx[: self._poles])]
            starts = [*last, arx[: self._poles]] if last else others
            fit = fit_output_error(runs, self._poles, self._numerator, d, starts, constant=constant)
            if fit is None:
                return math.inf
            fits[d], last[:] = fit, [fit.f]
            one_step = Y[:, 0] - Phi @ np.concatenate([fit.f, fit.b])
            curve.append([d * sample_time, _percent(fit.cost, spread), float(np.sqrt(np.mean(one_step**2)))])
            return fit.cost

        d = best_delay(delay_samples(self.delay, self.max_delay or MAX_DELAY, sample_time, columns), cost)
        if not fits:
            raise DataError(f"no dead time gives a stable model of {name}; record with more excitation.")
        starts = [fits[d].f, *start, *default_starts(self._poles, sample_time, None)]
        again = fit_output_error(runs, self._poles, self._numerator, d, starts, constant=constant)
        fit = again if again is not None and again.cost < fits[d].cost else fits[d]
        return fit, d, sorted(curve), _least_squares_findings(columns, self._poles, self._numerator, d, sample_time)

    def _intervals(
        self, sample_time: float, runs: list[tuple[Vector, Vector]], fit: OutputErrorFit, delay: int
    ) -> dict[str, list[float]]:
        """Return 95 % intervals [low, high] by name, from the best continuous-time fit near the discrete one."""
        if not -1.0 < fit.f[0] < 0.0:
            return {}
        search = SrivcFitOptions(
            sample_time=sample_time, max_delay=self.max_delay or MAX_DELAY, free_delay=self.delay is None
        )
        runs = [(u, y - fit.constant) for u, y in runs]
        pole, late = -float(np.log(-fit.f[0])) / sample_time, delay * sample_time
        # The cost has a kink at each whole sample of dead time, so the search also starts half a sample beside it.
        sides = (-0.5, 0.5) if self.delay is None else ()
        starts = [late, *(max(late + side * sample_time, 0.0) for side in sides)]
        fits = [near for start in starts if (near := search.start(runs, pole, start)) is not None]
        if not fits:
            return {}
        best = min(fits, key=lambda near: near.cost)
        K, p, L = float(best.model.b[0]), float(best.model.a[0]), best.model.delay
        gain, a, late, b = _NORMAL_QUANTILE * deviations(search, runs, best)[0]
        found = {"K": [K - b, K + b], "pole": [p - a, p + a], "static_gain": [K / p - gain, K / p + gain]}
        return found if self.delay is not None else {**found, "delay_s": [max(L - late, 0.0), L + late]}


def _spread(runs: list[tuple[Vector, Vector]]) -> float:
    """Return the sum of squares of the outputs around their mean."""
    outputs = np.concatenate([y[np.isfinite(y)] for _, y in runs])
    return float(np.sum((outputs - outputs.mean()) ** 2))


def _percent(cost: float, spread: float) -> float:
    """Return the fit [%]."""
    return 100.0 * (1.0 - math.sqrt(cost / spread))


def _mode_start(mode: tuple[float, float] | None, nf: int, sample_time: float) -> list[Vector]:
    """Return the denominator of a mode, further poles at zero, to start from; empty without a mode or for one pole."""
    if mode is None or nf < 2:
        return []
    frequency, damping = mode
    turn = frequency * sample_time * (-damping + 1j * np.sqrt(1.0 - damping**2))
    return [np.real(np.poly([np.exp(turn), np.exp(np.conj(turn)), *np.zeros(nf - 2)]))[1:]]


def axis_runs(scaled: ScaledData, source: str) -> list[list[tuple[Vector, Vector]]]:
    """Return (input, output) of each run for each output; raise DataError for positions that were not logged."""
    if source == "positions" and not scaled.data.has_motor_positions:
        raise DataError("no motor positions were logged; use `source=set_points`.")
    runs: list[list[tuple[Vector, Vector]]] = [[] for _ in scaled.directions.names]
    for run in scaled.data.runs():
        motors = run.motor_positions if source == "positions" else run.set_points
        if not np.isfinite(motors).all():
            raise DataError("some motor positions were missed; fill them or use `source=set_points`.")
        U = motors @ scaled.directions.redefinition.T
        for axis, pairs in enumerate(runs):
            y = run.outputs[:, axis]
            if np.isfinite(y).any():
                pairs.append((np.ascontiguousarray(U[:, axis]), y))
    return runs


def _in_si(findings: dict[str, Any], scaled: ScaledData, nf: int) -> dict[str, Any]:
    """Convert findings of scaled quantities to SI."""
    second, names = scaled.scaling.second, scaled.directions.names
    curves = findings["delay_curve"]
    for name, unit, gain, std in zip(
        names, scaled.scaling.output_unit, scaled.gains, findings["parameter_std"], strict=True
    ):
        curves[name] = [[second * d, fit, unit * rms] for d, fit, rms in curves[name]]
        std[nf:] = [gain * value for value in std[nf:]]
        units = {"K": gain / second, "static_gain": gain, "delay_s": second}
        units |= dict.fromkeys(("pole", "slowest_pole_1_per_s"), 1.0 / second)
        beside = findings["least_squares_beside"][name]
        for key in beside:
            beside[key] = None if beside[key] is None else units.get(key, 1.0) * beside[key]
        found = findings.get("intervals", {}).get(name, {})
        for key in found:
            found[key] = [units[key] * value for value in found[key]]
    return findings


def _least_squares_findings(
    columns: list[tuple[Matrix, Matrix]], na: int, nb: int, d: int, sample_time: float
) -> dict[str, Any]:
    """Fit ARX of the same orders and dead time by least squares, to compare with its bias under output noise."""
    Phi, Y = arx_rows(columns, na, nb, d)
    theta = np.linalg.lstsq(Phi, Y[:, 0])[0]
    slowest, fit = pole_radius(theta[:na]), free_run_fit(columns, theta[:na], theta[None, na:], d)
    return {
        "slowest_pole_1_per_s": float(-np.log(slowest)) / sample_time if slowest > 0.0 else None,
        "static_gain": float(theta[na:].sum() / (1.0 + theta[:na].sum())),
        "free_run_fit": fit if np.isfinite(fit) else None,
    }
