"""Play operators, low-pass filters and a polynomial of them: a plant without feedback, by one ridge regression."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product

import numpy as np

from softneck.core import DataError, Matrix, Progress, Vector, one_blas_thread, require_positive, require_whole, silent
from softneck.robot import Scaling
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._arrays import memory_array, within
from ..models._drive import FUNCTIONS, NEW_MOTION_FACTOR, NO_LOAD, LoadedDrive, drive_start, fit_noise_model, load_in_si
from ..models._fitting import SAME_EXCITATION, ScaledData, training_recording
from ..models._linear_systems import history_array
from ..models._model import WARM_UP, Model
from ..models._scores import nrmse_fit

HOLD_OUT = 0.2
# Rows held out that say something of a simulation, where there are that many.
_LEAST_HELD = 50
# From so many runs on, a run is held out as a whole.
_MANY_RUNS = 4


@dataclass(frozen=True, slots=True)
class PlayStructure:
    """Which terms there are, of polynomials of `degree`.

    rate: of the low-pass filters [1/s], `order` in a chain; widths: half-widths of the play operators [rad]; tilts: the
    redefined inputs that stand in cubes.
    """

    rate: float
    order: int
    widths: tuple[float, ...]
    degree: int
    inputs: int = 3
    tilts: int = 2

    @property
    def table(self) -> Matrix:
        """(n, 3) signals whose product is each term, with -1 for 1; the constant comes first."""
        chains = 1 + len(self.widths)
        rows = [[-1, -1, -1]] + [[i, -1, -1] for i in range(self.inputs * chains * self.order)]
        # Behind the widest play, the last filter but one: late enough for the statics, whose curvature this is.
        late = [(c + 1) * chains * self.order - 2 for c in range(self.inputs)]
        if self.degree >= 2:
            rows += [[*pair, -1] for pair in combinations_with_replacement(late, 2)]
        if self.degree >= 3:
            rows += [list(three) for three in combinations_with_replacement(late[: self.tilts], 3)]
        return np.array(rows, dtype=np.float64)

    @property
    def chains(self) -> np.ndarray:
        """Masks (inputs, chains, n) of the linear terms of each chain; that without a play is first."""
        chains = self.inputs * (1 + len(self.widths))
        places = np.arange(len(self.table)) - 1
        of = np.where((places >= 0) & (places < chains * self.order), places // self.order, -1)
        return (of == np.arange(chains)[:, None]).reshape(self.inputs, -1, places.size)

    def chain(self, sample_time: float) -> Vector:
        """(2,) pole and order, as the runtime reads them."""
        return np.array([np.exp(-self.rate * sample_time), float(self.order)])


@dataclass(frozen=True, slots=True, eq=False)
class Data:
    """Simulated motors and measured outputs of all runs, rows in which the start shows marked.

    motors, measured: one (time, motors) a run, simulated, and logged where it was; outputs: (time, outputs) of all
    runs; settled: (time,) rows to learn from and to judge; groups: masks (time,) of rows to hold out in turn;
    sample_time: [s]; redefinition: (inputs, motors) T of Eq. 9-11.
    """

    motors: list[Matrix]
    measured: list[Matrix]
    outputs: Matrix
    settled: np.ndarray
    groups: list[np.ndarray]
    sample_time: float
    redefinition: Matrix

    @classmethod
    def of(cls, recording: Recording, drive: LoadedDrive, redefinition: Matrix) -> Data:
        """Simulate the motors of a recording."""
        runs = recording.runs()
        outputs = recording.outputs
        # The unknown past of a run shows in its first rows, which `validate` does not score either.
        settled = np.concatenate([np.arange(len(run)) >= WARM_UP for run in runs]) & np.isfinite(outputs).all(axis=1)
        if settled.sum() < 2:
            raise DataError(f"every run is shorter than the {WARM_UP} samples in which its start is forgotten.")
        motors = [drive.simulate(run.set_points, drive_start(run)) for run in runs]
        logged = [run.motor_positions if run.has_motor_positions else m for run, m in zip(runs, motors, strict=True)]
        return cls(
            motors=motors,
            measured=[np.where(np.isfinite(there), there, m) for there, m in zip(logged, motors, strict=True)],
            outputs=outputs,
            settled=settled,
            groups=_groups([len(run) for run in runs]),
            sample_time=recording.sample_time,
            redefinition=redefinition,
        )

    def terms(self, form: PlayStructure, *, measured: bool = False) -> Matrix:
        """Return the terms (time, n) of all runs, along the simulated or the logged motors."""
        run = load_functions(FUNCTIONS).bank_run
        widths, chain, table = np.array(form.widths), form.chain(self.sample_time), form.table.astype(int)
        parts = []
        for motors in self.measured if measured else self.motors:
            signals = np.empty((len(motors), len(self.redefinition) * (1 + len(widths)) * form.order))
            motors = np.ascontiguousarray(motors)
            run(self.redefinition, widths, chain, motors, signals)
            parts.append(np.column_stack([signals, np.ones(len(signals))]))  # -1 is the column of ones
        signals = np.concatenate(parts)
        return signals[:, table[:, 0]] * signals[:, table[:, 1]] * signals[:, table[:, 2]]


def _groups(lengths: list[int]) -> list[np.ndarray]:
    if len(lengths) >= _MANY_RUNS:
        number = np.repeat(3 * np.arange(len(lengths)) // len(lengths), lengths)
        return [number == group for group in range(3)]
    return [np.concatenate([np.arange(n) >= (1.0 - HOLD_OUT) * n for n in lengths])]


def ridge(X: Matrix, Y: Matrix, weight: float, chains: np.ndarray | None = None) -> Matrix:
    """Return W (outputs, n) that minimises `|Y - X W'|^2 / rows + weight |w|^2`, w of standardised terms.

    `chains` (inputs, chains, n): none has a static gain of another sign than all of its input; see `rising`.
    """
    mean, scale, A = _normal(X, weight)
    W = np.linalg.solve(A, ((X - mean) / scale).T @ Y) / scale[:, None]
    W[0] -= mean @ W
    return W.T if chains is None else rising(W.T, spread_of(X, weight), chains)


def _normal(X: Matrix, weight: float) -> tuple[Vector, Vector, Matrix]:
    """Return mean and scale (n,) of the terms, and the matrix (n, n) of the ridge's normal equations."""
    mean, scale = X.mean(axis=0), X.std(axis=0)
    mean[0], scale[0] = 0.0, 1.0
    scale = np.where(scale > 1e-9, scale, 1.0)
    Z = (X - mean) / scale
    penalty = weight * len(Z) * np.ones(Z.shape[1])
    penalty[0] = 0.0
    return mean, scale, Z.T @ Z + np.diag(penalty) + 1e-12 * len(Z) * np.eye(Z.shape[1])


def spread_of(X: Matrix, weight: float) -> Matrix:
    """Return the covariance (n, n) of a ridge's weights for errors of variance 1."""
    mean, scale, A = _normal(X, weight)
    T = np.diag(1.0 / scale)
    T[0] -= mean / scale
    return T @ np.linalg.solve(A, T.T)


def rising(W: Matrix, spread: Matrix, chains: np.ndarray) -> Matrix:
    """Return the weights (outputs, n) nearest to W with no chain of negative share; `spread` (n, n): their covariance.

    The share of a chain is its static gain over that of all chains of its input. Plays of positive shares dissipate;
    with a negative one small motions would go the wrong way, and a loop with an integrator oscillate (Kuhnen 2003,
    Eur. J. Control 9:407). `chains`: as for `ridge`.
    """
    found = W.copy()
    for output, w in enumerate(W):
        held = np.zeros(chains.shape[:2], dtype=bool)
        while True:
            sums = chains @ found[output]
            share = np.where(held, 0.0, sums * np.sign(sums.sum(axis=1, keepdims=True)))
            if not (share < 0.0).any() or held.all():
                break
            held[np.unravel_index(np.argmin(share), share.shape)] = True
            C = chains[held].astype(float)
            found[output] = w - spread @ C.T @ np.linalg.solve(C @ spread @ C.T, C @ w)
    return found


def scores(data: Data, hold_out: Data | None, form: PlayStructure, weights: tuple[float, ...]) -> list[float]:
    """Return, for each ridge weight, the mean simulation fit [%] of all outputs on rows that were not learnt from.

    Without `hold_out` parts of the data are held out in turn, and what is furthest from the rest (extrapolation).
    """
    X, good = data.terms(form), data.settled
    if hold_out is None:
        far = _far(X[:, 1:], good)
        # Of a few seconds a tenth must do: the last fifth is always more.
        least = min(_LEAST_HELD, int(good.sum()) // 10)
        folds = [(X[good & ~held], data.outputs[good & ~held], X[good & held], data.outputs[good & held])
                 for held in (*data.groups, far) if (good & held).sum() > least]  # fmt: skip
    else:
        folds = [(X[good], data.outputs[good], hold_out.terms(form)[hold_out.settled],
                  hold_out.outputs[hold_out.settled])]  # fmt: skip
    return [float(np.mean([_fold_score(fold, weight, form.chains) for fold in folds])) for weight in weights]


def _fold_score(fold: tuple[Matrix, Matrix, Matrix, Matrix], weight: float, chains: np.ndarray) -> float:
    X, Y, held, y = fold
    free = held @ ridge(X, Y, weight, chains).T
    return float(np.mean([nrmse_fit(y[:, axis], free[:, axis]) for axis in range(y.shape[1])]))


def _far(signals: Matrix, good: np.ndarray) -> np.ndarray:
    """Return a mask of the fifth of the good rows whose signals are furthest from their mean (Mahalanobis)."""
    Z = (signals - signals[good].mean(axis=0)) / np.maximum(signals[good].std(axis=0), 1e-9)
    values, vectors = np.linalg.eigh(Z[good].T @ Z[good] / good.sum())
    # Directions that hardly occur are noise: 1e-3 of the largest is a thirtieth of its spread.
    kept = values > 1e-3 * values[-1]
    distance = np.linalg.norm(Z @ vectors[:, kept] / np.sqrt(values[kept]), axis=1)
    return distance > np.quantile(distance[good], 1.0 - HOLD_OUT)


# What the hold-out chooses from, scaled: filters about as fast as the robot, 5, and three times that; plays up to a
# seventh of the motors' range of 6.
_FILTER_RATES = (6.0, 15.0)
# Of robots whose time constant is found from data, only roughly.
_ALL_FILTER_RATES = (4.0, 6.0, 10.0, 15.0, 25.0)
_PLAY_WIDTHS = ((), (0.3,), (0.1, 0.3, 0.9))
_POLYNOMIAL_DEGREES = (1, 2, 3)
RIDGE_WEIGHTS = (1e-6, 1e-4, 1e-2)
# Of forms whose fits on the hold-out differ by less than this [points], that with the fewest terms is taken.
_FIT_TOLERANCE_PCT = 0.1
# Valves are taken that leave at most so much of the misfit on the hold-out. Starts of their search: rates of filling
# and of venting, scaled, of chambers some times quicker than the robot.
_VALVE_MISFIT, _VALVE_STARTS, _VALVE_EVALUATIONS = 0.8, ((20.0, 10.0), (10.0, 20.0)), 40
# Form, ridge, its fit on the hold-out [%], and how many were tried.
_Chosen = tuple[PlayStructure, float, float, int]
# A held input is forgotten after this: the slowest filter by far is that of the load, some 1.
_MEMORY_S = 15.0
# f is kept within the range of the training outputs, widened by half of it to either side.
_OUTPUT_MARGIN = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Play:
    """Output-error model without feedback: polynomial of play operators and low-pass filters of the inputs.

    theta_i, phi_i and delta_i of the simulated motors (drives that stall under load; where no positions are logged,
    valves whose chambers fill and vent at different speeds, if they predict better) pass play operators and chains of
    low-pass filters; pitch and roll are ridge regressions on all of these and on products of one stage.
    What is None is chosen by the simulation over rows held out: the last fifth of each run and the fifth furthest
    from all others, or `hold_out`.

    Attributes:
        rate: of the low-pass filters [1/s].
        order: filters in a chain; the polynomial is of the last but one.
        widths: half-widths of the play operators [rad].
        degree: of the polynomial: 1, 2, or 3 (cubes of the tilt only).
        ridge: weight of the squared coefficients of standardised terms.
        echo: past errors that correct a prediction where outputs are measured.
    """

    rate: float | None = None
    order: int = 5
    widths: tuple[float, ...] | None = None
    degree: int | None = None
    ridge: float | None = None
    echo: int = 8

    def __post_init__(self) -> None:
        if self.rate is not None:
            require_positive("rate", self.rate, "1/s")
        require_whole("order", self.order, 2, 50)
        require_whole("echo", self.echo, 1, 100)
        if self.widths is not None:
            object.__setattr__(self, "widths", tuple(self.widths))
            for width in self.widths:
                require_positive("widths", width, "rad")
        if self.degree is not None:
            require_whole("degree", self.degree, 1, 3)
        if self.ridge is not None:
            require_positive("ridge", self.ridge)

    @one_blas_thread
    def fit(
        self,
        recordings: Recording | list[Recording],
        *,
        hold_out: Recording | None = None,
        progress: Progress = silent,
    ) -> Model:
        """Identify both axes.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            hold_out: another excitation, on whose simulation to choose what is None.
            progress: called with the part done and a word on it.

        Raises:
            DataError: too short, constant, or fewer rows than terms.
        """
        scaled = ScaledData.of(training_recording(recordings, all_motors=True))
        progress(0.0, "drives")
        drive, T = scaled.drive, scaled.directions.all_inputs(scaled.data.set_points)
        settings = self._scale_settings(scaled.scaling)
        rates = _ALL_FILTER_RATES if scaled.recording.robot.time_constant_s is None else _FILTER_RATES

        def simulated(drive: LoadedDrive) -> tuple[Data, Data | None]:
            other = None if hold_out is None else Data.of(scaled.scale(hold_out), drive, T)
            return Data.of(scaled.data, drive, T), other

        chosen = settings._choose(*simulated(drive), rates, progress)
        if not scaled.data.has_motor_positions:
            progress(0.9, "valves")
            drive, chosen = settings._try_valves(drive, simulated, chosen, rates)
        data, (form, weight, fit, tried) = simulated(drive)[0], chosen
        progress(0.95, "all rows")
        arrays = _arrays(data, drive, form, weight, self.echo)
        findings = {
            "rate": form.rate / scaled.scaling.second,
            "widths": [scaled.scaling.motor_unit * width for width in form.widths],
            "degree": form.degree,
            "ridge": weight,
            "terms": len(form.table),
            "hold_out_fit": fit,
            "tried": tried,
        }
        if drive.load.size > NO_LOAD.size:
            filling, venting = -scaled.recording.sample_time / np.log(drive.load[NO_LOAD.size :])
            findings |= {"filling_s": float(filling), "venting_s": float(venting)}
        if hold_out is None and tried > 1:
            findings["remark"] = SAME_EXCITATION
        progress(1.0, "done")
        return scaled.model("play", self, _in_si, arrays=arrays, findings=findings)

    def _scale_settings(self, scaling: Scaling) -> Play:
        """Return these settings in scaled quantities."""
        widths = None if self.widths is None else tuple(width / scaling.motor_unit for width in self.widths)
        return replace(self, rate=None if self.rate is None else self.rate * scaling.second, widths=widths)

    def _try_valves(
        self, drive: LoadedDrive, simulated: Callable[[LoadedDrive], tuple[Data, Data | None]], chosen: _Chosen,
        rates: tuple[float, ...],
    ) -> tuple[LoadedDrive, _Chosen]:  # fmt: skip
        """Return the drive with the valves that predict best, and what is chosen behind it, if that is clearly better.

        Their two poles are found by simplex searches (Nelder and Mead 1965), with the form that was chosen without.
        """
        from scipy.optimize import minimize

        form, weight, fit, _ = chosen
        Ts = simulated(drive)[0].sample_time

        def valves(x: Vector) -> LoadedDrive:
            return drive.with_valves(np.exp(-np.exp(np.clip(x, -3.0, 7.0)) * Ts))

        options = {"maxfev": _VALVE_EVALUATIONS, "xatol": 0.02, "fatol": 0.02}
        loss = lambda x: -scores(*simulated(valves(x)), form, (weight,))[0]  # noqa: E731
        found = [minimize(loss, np.log(start), method="Nelder-Mead", options=options) for start in _VALVE_STARTS]
        best = min(found, key=lambda one: one.fun)
        if not -best.fun > fit:
            return drive, chosen
        again = self._choose(*simulated(valves(best.x)), rates, silent)
        better = 100.0 - again[2] < _VALVE_MISFIT * (100.0 - fit)
        return (valves(best.x), again) if better else (drive, chosen)

    def _choose(self, data: Data, extra: Data | None, rates: tuple[float, ...], progress: Progress) -> _Chosen:
        """Return form and ridge of the best simulation on the hold-out, its fit [%], and how many were tried."""
        inputs, tilts = len(data.redefinition), min(len(data.redefinition), data.outputs.shape[1])
        forms = [
            PlayStructure(rate, self.order, widths, degree, inputs, tilts)
            for rate in (rates if self.rate is None else (self.rate,))
            for widths in (_PLAY_WIDTHS if self.widths is None else (self.widths,))
            for degree in (_POLYNOMIAL_DEGREES if self.degree is None else (self.degree,))
        ]
        # Two thirds of the rows at least must say something that the terms do not already.
        rows = int(data.settled.sum())
        fitting = [form for form in forms if 3 * len(form.table) < rows]
        if not fitting:
            least = min(len(form.table) for form in forms)
            raise DataError(f"{rows} settled rows are too few for {least} terms; record longer or lower `order`.")
        ridges = RIDGE_WEIGHTS if self.ridge is None else (self.ridge,)
        scored: list[tuple[float, PlayStructure, float]] = []
        for number, form in enumerate(fitting):
            best = f"best fit {max(score for score, _, _ in scored):.1f} %" if scored else "forms"
            progress(0.1 + 0.85 * number / len(fitting), best)
            values = scores(data, extra, form, ridges)
            scored += [(score, form, w) for score, w in zip(values, ridges, strict=True)]
        top = max(score for score, _, _ in scored)
        if not np.isfinite(top):
            raise DataError("no form has a finite error on the hold-out; does it move at all?")
        alike = [entry for entry in scored if entry[0] > top - _FIT_TOLERANCE_PCT]
        fit, form, weight = max(alike, key=lambda entry: (-len(entry[1].table), entry[0]))
        return form, weight, fit, len(scored)


def _arrays(data: Data, drive: LoadedDrive, form: PlayStructure, weight: float, order: int) -> dict[str, Matrix]:
    good = data.settled
    # Along the simulated motors, as in simulation, and along the logged ones, as in a prediction: one f serves both.
    both = np.concatenate([data.terms(form)[good], data.terms(form, measured=True)[good]])
    W = ridge(both, np.tile(data.outputs[good], (2, 1)), weight, form.chains)
    lowest, highest = data.outputs[good].min(axis=0), data.outputs[good].max(axis=0)
    wider = _OUTPUT_MARGIN * (highest - lowest)
    limits = np.column_stack([lowest - wider, highest + wider])
    # What is measured beside the outputs are the motors: the errors of one step are those along them.
    errors = data.outputs - np.clip(data.terms(form, measured=True) @ W.T, limits[:, 0], limits[:, 1])
    errors[~good] = np.nan
    edges = np.cumsum([len(motors) for motors in data.motors])[:-1]
    parts: list[Matrix] = np.split(errors, edges)
    echo = np.array(
        [fit_noise_model([part[:, axis] for part in parts], order, beyond=NEW_MOTION_FACTOR) for axis in range(len(W))]
    )
    history = int(max(order, drive.drive[:, 1].max(), 1))
    return {
        "history": history_array(history, len(W)),
        "drive": drive.drive,
        "load": drive.load,
        "redefinition": data.redefinition,
        "widths": np.array(form.widths, dtype=np.float64),
        "chain": form.chain(data.sample_time),
        "table": form.table,
        "weights": W,
        "range": limits,
        "echo": echo,
        "memory": memory_array(_MEMORY_S, data.sample_time),
    }


def _in_si(arrays: Mapping[str, Matrix], scaling: Scaling) -> dict[str, Matrix]:
    """Return the arrays of a polynomial of scaled signals, which are zero at rest, as one of signals in SI."""
    table, per = arrays["table"].astype(int), 1.0 / scaling.motor_unit
    signals = (1 + arrays["widths"].size) * int(arrays["chain"][1])  # of each redefined input
    rests = np.repeat(arrays["redefinition"] @ scaling.motor_rest, signals)
    places = {tuple(sorted(row.tolist())): i for i, row in enumerate(table)}
    weights = np.zeros_like(arrays["weights"])
    # Each product of (signal - rest) is a sum over the factors that are kept: with each term its lower ones are there.
    for column, row in zip(arrays["weights"].T, table, strict=True):
        factors = [i for i in row.tolist() if i >= 0]
        for kept in product((False, True), repeat=len(factors)):
            others = [-per * rests[i] for i, keep in zip(factors, kept, strict=True) if not keep]
            own = [i for i, keep in zip(factors, kept, strict=True) if keep]
            term = tuple(sorted([*own, *[-1] * (3 - len(own))]))
            weights[:, places[term]] += column * per ** len(own) * np.prod(others)
    weights *= scaling.output_unit[:, None]
    weights[:, places[-1, -1, -1]] += scaling.output_rest
    return {
        **arrays,
        "load": load_in_si(arrays["load"], scaling),
        "widths": scaling.motor_unit * arrays["widths"],
        "weights": weights,
        "range": scaling.output_rest[:, None] + scaling.output_unit[:, None] * arrays["range"],
    }


def check_play(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["chain"][1:], 1, 1000, "the order of the filters")
    signals = sizes["c"] * (1 + sizes["w"]) * sizes["order"]
    within(arrays["table"], -1, signals - 1, "a term's signal")
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
