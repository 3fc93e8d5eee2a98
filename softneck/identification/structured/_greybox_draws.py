"""Draws from the confidence region of a fitted grey box: other numbers that explain its recordings too."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from softneck.core import Matrix, Progress, Vector, silent
from softneck.signals import Recording

from ..models._fitting import ScaledData, training_recording
from ..models._model import Model
from ._greybox import GreyBox
from ._output_error import DECIMATION, FitProblem, SearchProgress, correlation_time, slopes
from ._parameters import PARTS

# Length of a segment [s of a neck's time]: ten of its time constants.
_SEGMENT_S = 2.0
# A draw whose squared error on the recordings is more than this multiple of the least does not explain them.
# With 3 held-out motions score better by 4 % on one of four test necks, and single draws beyond 2 decided certificates.
_MOST_COST = 2.0
# Steps of Gauss-Newton at a neighbouring dead time, from the numbers of the best one.
_EVALUATIONS = 6
# Quantile 0.95 of chi-squared with one degree of freedom.
_CHI_SQUARED = 3.84
_HALVINGS = 4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GreyBoxDraws:
    """Numbers of a grey box, drawn around the fitted ones.

    Segments of the recordings disagree on the numbers, as no model is exact. The draws have the covariance
    `H^-1 (sum g g') H^-1` of a misspecified model (White 1982, Econometrica 50:1), g the gradient of each segment; the
    prior of the fit holds what the recordings do not tell. The sensor's dead time is one that fits nearly as well.

    Attributes:
        model: fitted; a draw replaces its arrays.
        problem: of the fit.
        centres: dead time [samples] -> search variables (n,), and what its squared error exceeds the least by.
        hessian, push, prior: (n, n) J'J, sum g g', and the inverse covariance of the prior.
        variance: of an independent error.
        least: squared error of the fitted numbers.
    """

    model: Model
    problem: FitProblem
    centres: dict[int, tuple[Vector, float]]
    hessian: Matrix
    push: Matrix
    prior: Matrix
    variance: float
    least: float
    _factors: dict[float, Matrix] = field(default_factory=dict)

    @classmethod
    def fit(cls, recording: Recording, *, body: str = "rigid", progress: Progress = silent) -> GreyBoxDraws:
        """Fit the grey box with a body to a recording, and what draws need."""
        model = GreyBox(body=body).fit(recording, progress=lambda done, text: progress(0.9 * done, text))
        scaled = ScaledData.of(training_recording(recording), amplitudes=False)
        second = scaled.scaling.second
        table = {row["name"]: float(row["value"]) for row in model.findings["numbers"]}
        kept = [part for part, numbers in PARTS.items() if numbers[0].name in table]
        problem = FitProblem.of(scaled).with_parts(*kept)
        x = np.array([n.encode(table[n.name] * (second if n.is_rate else 1.0)) for n in problem.numbers])
        delay, count = int(model.findings["sensor_delay"]), x.size
        e, J = problem.errors(x, delay)[count:], slopes(problem, x, delay)[:, count:]
        variance = float(e @ e) / e.size * correlation_time(problem.misses(x, delay))
        least, centres = float(e @ e), {delay: (x, 0.0)}
        for other in (delay - 1, delay + 1):
            if other >= 0:
                progress(0.95, f"dead time {other}")
                tell = SearchProgress(silent, 1)
                found = problem.search(x, other, _EVALUATIONS, tell).x
                cost = problem.errors(found, other)[count:]
                centres[other] = (found, float(cost @ cost) - least)
        groups = _segments(problem, e.size)
        G = np.zeros((groups.max() + 1, count))
        np.add.at(G, groups, J.T * e[:, None])
        prior = np.diag(np.array([n.spread for n in problem.numbers]) ** -2.0)
        return cls(
            model=model, problem=problem, centres=centres, hessian=J @ J.T, push=G.T @ G, prior=prior,
            variance=variance, least=least,
        )  # fmt: skip

    def draw(self, rng: np.random.Generator) -> Vector:
        """Return a draw: a standard normal number for each of the grey box's, and one for the dead time."""
        return rng.standard_normal(len(self.problem.numbers) + 1)

    def smoother(self) -> list[GreyBoxDraws]:
        """Return this alone: its prior holds what the recordings do not tell."""
        return [self]

    def arrays(self, draw: Vector, factor: float) -> dict[str, Matrix]:
        """Return the arrays of a draw whose deviations are `factor` times those of the fitted numbers."""
        delay, x = self._centre(float(draw[-1]), factor)
        away = self._factor(factor) @ draw[:-1]
        low, high = (np.array([n.encode(end) for n, end in zip(self.problem.numbers, ends, strict=True)])
                     for ends in zip(*((n.low, n.high) for n in self.problem.numbers), strict=True))  # fmt: skip
        for _ in range(_HALVINGS):
            tried = np.clip(x + away, low, high)
            e = self.problem.errors(tried, delay)[x.size :]
            if float(e @ e) <= _MOST_COST * self.least:
                return self._as_arrays(tried, delay)
            away = 0.5 * away
        return self._as_arrays(np.clip(x + away, low, high), delay)

    def _centre(self, normal: float, factor: float) -> tuple[int, Vector]:
        """Return a dead time that the recordings do not exclude, and its numbers."""
        most = factor**2 * self.variance * _CHI_SQUARED
        allowed = [(delay, x) for delay, (x, more) in sorted(self.centres.items()) if more <= most]
        share = 0.5 * (1.0 + np.tanh(0.8 * normal))  # close to the normal distribution: uniform over the dead times
        return allowed[min(int(share * len(allowed)), len(allowed) - 1)]

    def _factor(self, factor: float) -> Matrix:
        if factor not in self._factors:
            inverse = np.linalg.inv(self.hessian / factor + factor * self.variance * self.prior)
            values, vectors = np.linalg.eigh(inverse @ self.push @ inverse)
            self._factors[factor] = vectors * np.sqrt(np.maximum(values, 0.0))
        return self._factors[factor]

    def _as_arrays(self, x: Vector, delay: int) -> dict[str, Matrix]:
        problem, numbers, load = self.problem, self.problem.decode(x), self.problem.load(x)
        pole = np.exp(-numbers[0] * problem.sample_time)
        drive = np.column_stack([np.full(len(problem.drive_delays), pole), problem.drive_delays])
        found = {"neck": numbers, "drive": drive, "sensor": np.array([float(delay), problem.sample_time])}
        body = {"body": problem.body(x)} if "body" in self.model.arrays else {}
        return found | body | ({"payload": load} if load.size else {})


def _segments(problem: FitProblem, size: int) -> np.ndarray:
    """Return the segment (size,) of every error that the fit minimises."""
    length = max(1, round(_SEGMENT_S / problem.sample_time / DECIMATION))
    parts, first = [], 0
    for _, _, motors, outputs in problem.runs:
        number = first + np.arange(len(outputs[problem.rows])) // length
        parts.append(np.repeat(number, outputs.shape[1]))
        if problem.logged:
            parts.append(np.repeat(number, motors.shape[1]))
        first = int(number.max(initial=first)) + 1
    found = np.concatenate(parts)
    if found.size != size:
        raise ValueError(f"{found.size} errors in segments, {size} in the fit.")
    return found
