"""Continuous-time transfer functions with dead time, as the paper's Eq. 31 has them, with confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._fitting import delay_samples, fitted_model, training_recording
from ..models._model import Model
from ._oe import SOURCES, axis_arrays, axis_runs
from ._operating_point import about, operating_point, with_offset
from ._regression import arx_rows, require_excitation
from ._srivc_fit import Continuous, Runs, SrivcFit, SrivcFitOptions, with_delay

# A second of residuals stays together, so that what is correlated within a second counts as one.
_BLOCK = 1.0
# From the fit itself two steps reach what more would: the third moves the parameters by less than 1e-3 of their spread.
_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Intervals:
    """What the bootstrap says.

    Attributes:
        level: nominal part of records whose interval holds the truth.
        names: of the quantities: K, pole or coefficients, delay_s, static_gain.
        value, low, high: (names,) estimates and bounds, in SI (rad, s).
        covariance: (p, p) of theta = (a, b, L).
        samples: (count, p) theta of each resample.
    """

    level: float
    names: tuple[str, ...]
    value: Vector
    low: Vector
    high: Vector
    covariance: Matrix
    samples: Matrix

    def as_dict(self) -> dict[str, list[float]]:
        """Return name -> [low, high]."""
        bounds = zip(self.names, self.low, self.high, strict=True)
        return {name: [float(low), float(high)] for name, low, high in bounds}


def bootstrap(
    search: SrivcFitOptions,
    runs: Runs,
    fit: SrivcFit,
    *,
    count: int,
    generator: np.random.Generator,
    level: float = 0.95,
    tell: Callable[[float], None] | None = None,
) -> Intervals:
    """Fit again to the simulation with moving blocks of its own residuals on it (Kuensch 1989), `count` times.

    The bounds are the estimate and its bootstrap standard deviation times the normal quantile: with a few hundred
    resamples that is steadier than their percentiles.
    """
    from scipy.stats import norm

    block = max(round(_BLOCK / search.sample_time), 1)
    residuals = [y - simulated for (_, y), simulated in zip(runs, fit.simulated, strict=True)]
    drawn = [_draw(residuals, block, generator) for _ in range(count)]
    thetas = []
    for number, errors in enumerate(drawn):
        resampled = [(u, s + e) for (u, _), s, e in zip(runs, fit.simulated, errors, strict=True)]
        again = search.improve(resampled, fit.model, fit.starts, iterations=_STEPS)
        if again is not None:
            thetas.append(again.model.theta)
        if tell is not None and number % 20 == 0:
            tell(number / count)
    samples = np.array(thetas)
    names = quantity_names(fit.model)
    value = quantities(fit.model)
    n = fit.model.a.size
    spread = np.array([quantities(_model(theta, n)) for theta in samples]).std(axis=0, ddof=1)
    reach = float(norm.ppf(0.5 + 0.5 * level))
    return Intervals(
        level=level,
        names=names,
        value=value,
        low=np.where(np.array(names) == "delay_s", np.maximum(value - reach * spread, 0.0), value - reach * spread),
        high=value + reach * spread,
        covariance=np.cov(samples.T),
        samples=samples,
    )


def quantity_names(model: Continuous) -> tuple[str, ...]:
    """Return what `quantities` returns: K and the pole of Eq. 31, or the coefficients of higher orders."""
    if model.a.size == 1:
        return ("K", "pole", "delay_s", "static_gain")
    a = tuple(f"a{i + 1}" for i in range(model.a.size))
    b = tuple(f"b{i}" for i in range(model.b.size))
    return (*b, *a, "delay_s", "static_gain")


def quantities(model: Continuous) -> Vector:
    """Return numerator, denominator, dead time and static gain."""
    return np.concatenate([model.b, model.a, [model.delay, model.b[-1] / model.a[-1]]])


def _model(theta: Vector, n: int) -> Continuous:
    return Continuous(a=theta[:n], b=theta[n:-1], delay=float(theta[-1]))


def _draw(residuals: Sequence[Vector], block: int, generator: np.random.Generator) -> list[Vector]:
    """Return residuals in blocks drawn from all runs, missing where they were missing."""
    pool = np.concatenate([e[np.isfinite(e)] for e in residuals])
    pool = pool - pool.mean()
    block = min(block, max(pool.size // 4, 1))
    drawn = []
    for e in residuals:
        starts = generator.integers(0, pool.size - block + 1, size=e.size // block + 1)
        values = np.concatenate([pool[s : s + block] for s in starts])[: e.size]
        drawn.append(np.where(np.isfinite(e), values, np.nan))
    return drawn


# Poles [1/s] to start from: the neck's 5, and a third and three times that.
_POLES = (5.0, 1.7, 15.0)
_CAUTION = (
    "intervals say how far noise moves the estimate of one linear system; on a neck that is nonlinear they do not "
    "hold its gain, pole and dead time elsewhere in its range: take a `family` for that"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Srivc:
    """`K exp(-L s)/(s + p)`, or more poles and zeros, by simplified refined instrumental variables (Garnier 2015).

    Set-points are held between samples, so the sampled model is exact, with any dead time between samples.

    Attributes:
        order: poles.
        zeros: zeros, below `order`.
        delay: dead time [s]; None estimates it, also between samples.
        max_delay: bound on it [s], of another robot by its time constant over the neck's 0.2 s.
        source: "set_points", or "positions" of the motors, see `OutputError`.
        resamples: of the bootstrap; 0 for no intervals.
        level: of the intervals.
        seed: of the bootstrap.
    """

    order: int = 1
    zeros: int = 0
    delay: float | None = None
    max_delay: float = 0.3
    source: str = "set_points"
    resamples: int = 200
    level: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        require_whole("order", self.order, 1, 6)
        require_whole("zeros", self.zeros, 0, 5)
        if self.zeros >= self.order:
            raise SettingsError(f"`zeros` must be below `order` {self.order}; got {self.zeros}.")
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_positive("max_delay", self.max_delay, "s")
        require_one_of("source", self.source, SOURCES)
        require_whole("resamples", self.resamples, 0, 100_000)
        require_between("level", self.level, 0.5, 0.9999)
        require_whole("seed", self.seed, 0, 2**31 - 1)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify both axes; runs are never joined and each has its own start, missed samples are not judged.

        Raises:
            DataError: too short, constant, not enough excitation, or no stable model.
        """
        recording = training_recording(recordings, any_robot=True)
        point = operating_point(recording)
        generator = np.random.default_rng(self.seed)
        sampled, continuous, curves, intervals = [], {}, {}, {}
        directions, inputs = axis_runs(about(recording, point), self.source)
        settings = self if directions.stretch == 1.0 else replace(self, max_delay=self.max_delay * directions.stretch)
        for axis, (name, runs) in enumerate(zip(directions.names, inputs, strict=True)):
            progress(axis / len(inputs), name)
            fit, curves[name] = settings.fit_axis(runs, recording.sample_time, name, stretch=directions.stretch)
            model = fit.model
            sampled.append(model.sampled(recording.sample_time))
            continuous[name] = {"b": model.b.tolist(), "a": [1.0, *model.a.tolist()], "delay_s": model.delay}
            if self.resamples > 0:
                search = settings.search(recording.sample_time, stretch=directions.stretch)
                found = bootstrap(search, runs, fit, count=self.resamples, generator=generator, level=self.level)
                intervals[name] = found.as_dict()
        progress(1.0, "done")
        a, b, d = ([entry[i] for entry in sampled] for i in range(3))
        arrays, functions = axis_arrays(recording, directions, a, b, [float(samples) for samples in d], self.source)
        arrays = with_offset("srivc", arrays, recording, point)
        said = {"intervals": intervals, "level": self.level, "caution": _CAUTION} if intervals else {}
        return fitted_model(
            "srivc",
            self,
            recording,
            arrays=arrays,
            findings={
                **functions,
                "continuous": continuous,
                "delay_criterion": "output_error",
                "delay_curve": curves,
                **said,
            },
        )

    def fit_axis(
        self, runs: Runs, sample_time: float, name: str, *, stretch: float = 1.0
    ) -> tuple[SrivcFit, list[list[float]]]:
        """Return the fit and the cost curve: rows of (delay [s], fit [%], one-step rms) at whole samples.

        Args:
            runs: input and output of each run, (time,) each.
            sample_time: [s].
            name: of the axis, for messages.
            stretch: by how much slower than a neck it is.
        """
        columns = [(y[:, None], u[:, None]) for u, y in runs]
        measured = np.concatenate([y[np.isfinite(y)] for _, y in runs])
        spread = float(np.sum((measured - measured.mean()) ** 2))
        search = self.search(sample_time, stretch=stretch)
        fixed = SrivcFitOptions(**{**asdict(search), "free_delay": False})
        best, fits, curve = None, {}, []
        last: SrivcFit | None = None
        for d in delay_samples(self.delay, self.max_delay, sample_time, columns):
            Phi, _ = arx_rows(columns, self.order, self.order, d)
            require_excitation(name, Phi)
            L = d * sample_time if self.delay is None else self.delay
            fit = fixed.improve(runs, with_delay(last.model, L), last.starts) if last is not None else None
            fit = fit or _best([fixed.start(runs, pole, L) for pole in np.array(_POLES) / stretch])
            if fit is None:
                continue
            last = fits[d] = fit
            curve.append([L, 100.0 * (1.0 - float(np.sqrt(fit.cost / spread))), _one_step(columns, fit, sample_time)])
            if best is None or fit.cost < fits[best].cost:
                best = d
        if best is None:
            raise DataError(f"no dead time gives a stable model of {name}; record with more excitation.")
        if self.delay is not None:
            return fits[best], curve
        # The derivative by the dead time has a step at each sample: try from both sides.
        nearby = [fits[d] for d in (best - 1, best, best + 1) if d in fits]
        middle = [
            search.improve(runs, with_delay(f.model, f.model.delay + 0.5 * sample_time), f.starts) for f in nearby
        ]
        free = _best([*middle, *(search.improve(runs, f.model, f.starts) for f in nearby)])
        return (free if free is not None and free.cost < fits[best].cost else fits[best]), curve

    def search(self, sample_time: float, *, stretch: float = 1.0) -> SrivcFitOptions:
        """Return how one axis is fitted, that of a robot that is `stretch` times slower than a neck."""
        options = SrivcFitOptions(
            sample_time=sample_time,
            order=self.order,
            zeros=self.zeros,
            max_delay=self.max_delay,
            free_delay=self.delay is None,
        )
        return replace(options, fastest=options.fastest / stretch)

    def intervals(self, runs: Runs, sample_time: float, fit: SrivcFit, generator: np.random.Generator) -> Intervals:
        """Return the bootstrap's intervals of one axis."""
        return bootstrap(
            self.search(sample_time), runs, fit, count=self.resamples, generator=generator, level=self.level
        )


def _best(fits: list[SrivcFit | None]) -> SrivcFit | None:
    there = [fit for fit in fits if fit is not None]
    return min(there, key=lambda fit: fit.cost) if there else None


def _one_step(columns: list, fit: SrivcFit, sample_time: float) -> float:
    """Return the rms error [rad] of the sampled model one step ahead."""
    a, b, d = fit.model.sampled(sample_time)
    errors = []
    for Y, U in columns:
        y: Vector = Y[:, 0]
        lag = max(a.size, b.size + d)
        predicted = sum(-a[i] * y[lag - i - 1 : y.size - i - 1] for i in range(a.size)) + sum(
            b[j] * U[lag - d - j - 1 : y.size - d - j - 1, 0] for j in range(b.size)
        )
        errors.append(y[lag:] - predicted)
    return float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2)))
