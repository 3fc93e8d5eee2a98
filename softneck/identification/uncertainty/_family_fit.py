"""From recordings to a family: local models, their box, and a weight over their envelope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    one_blas_thread,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.robot import Scaling
from softneck.signals import Recording, concatenate, conditions

from ..linear._oe import SOURCES
from ..linear._srivc_fit import Continuous, SrivcFitOptions
from ..models._directions import Directions
from ..models._fitting import MAX_DELAY, ScaledData, check_training, robot_at_rest
from ._family import SCOPES, AxisFamily, Family, one_pole, relative_errors
from ._local_models import Local, Window, axis_inputs, fit_compression, fit_local, unit_response, windows
from ._measured import (
    AxisMeasured,
    axis_points,
    axis_runs,
    band_borders,
    choose_order,
    covering_weight,
    digest,
    judge_records,
    measured_responses,
    middle_model,
    raise_weight,
    recordings_without_response,
)

# An envelope of 100 points is smooth; the cover is checked and mended on a grid this much finer.
_FINE_GRID_FACTOR = 8
_BISECTIONS = 28
# What lies below this part of the largest error is covered no more closely: it costs orders and buys nothing.
_MIN_ENVELOPE_RATIO = 0.02


def envelope_weight(frequency: Vector, envelope: Vector, order: int) -> tuple[Vector, Vector]:
    """Return numerator and denominator of W(s) with `|W(j w)| >= envelope` (m,), as close as its order 1 to 3 allows.

    `|W|^2 = N(w^2)/D(w^2)`: for a given closeness gamma, `e^2 D <= N <= gamma^2 e^2 D` is linear in the coefficients;
    the least gamma is found by bisection, W by spectral factorisation (Balas et al. 2007, `ucover`). `frequency` (m,)
    rises [rad/s]; SettingsError for an envelope that is not positive and finite.
    """
    e = np.asarray(envelope, dtype=np.float64)
    if not np.isfinite(e).all() or e.max() <= 0.0:
        raise SettingsError("the envelope must be finite and not zero; the family's samples are all alike.")
    e = np.maximum(e, _MIN_ENVELOPE_RATIO * e.max())
    middle = float(np.sqrt(frequency[0] * frequency[-1]))
    x = (frequency / middle) ** 2
    low, high, found = 0.0, np.log(e.max() / e.min()) + 1e-3, None
    for _ in range(_BISECTIONS):
        tried = 0.5 * (low + high)
        coefficients = _feasible(x, e, order, np.exp(tried))
        if coefficients is None:
            low = tried
        else:
            high, found = tried, coefficients
    if found is None:
        # The constant max(e) is always a cover.
        return np.array([e.max()]), np.array([1.0])
    above, below = (_factor(part, middle) for part in np.split(found, 2))
    size = np.sqrt(found[order] / found[2 * order + 1])
    fine = np.geomspace(frequency[0], frequency[-1], _FINE_GRID_FACTOR * frequency.size)
    wanted = np.exp(np.interp(np.log(fine), np.log(frequency), np.log(e)))
    covered = size * np.abs(np.polyval(above, 1j * fine) / np.polyval(below, 1j * fine))
    return size * max(1.0, float(np.max(wanted / covered))) * above, below


def _feasible(x: Vector, e: Vector, order: int, closeness: float) -> Vector | None:
    """Return the coefficients of N and D in rising powers of x, or None where none are that close."""
    from scipy.optimize import linprog

    powers = x[:, None] ** np.arange(order + 1) / (1.0 + x[:, None] ** order)
    e2 = e[:, None] ** 2
    # Rows by their own size: e spans decades.
    zeros = np.zeros_like(powers)
    rows = np.block([[-powers / e2, powers], [powers / e2, -(closeness**2) * powers], [zeros, -powers]])
    # Positive coefficients at both ends keep N and D positive beyond the grid; their scale is free, so D sums to one.
    ends = [(1e-7 if i in (0, order) else None, None) for i in range(order + 1)]
    total: Matrix = np.concatenate([np.zeros(order + 1), np.ones(order + 1)])[None, :]
    bound = np.concatenate([np.zeros(2 * x.size), np.full(x.size, -1e-9)])
    result = linprog(
        np.zeros(2 * order + 2),
        A_ub=rows,
        b_ub=bound,
        A_eq=total,
        b_eq=[1.0],
        bounds=[*ends, *ends],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10},
    )
    if result.status != 0 or not _positive(result.x, order):
        return None
    return np.asarray(result.x)


def _positive(coefficients: Vector, order: int) -> bool:
    """Return whether N and D are positive on a grid far beyond the data's: they have no imaginary roots."""
    x = np.geomspace(1e-8, 1e8, 2001)
    powers = x[:, None] ** np.arange(order + 1)
    return bool((powers @ coefficients[: order + 1] > 0).all() and (powers @ coefficients[order + 1 :] > 0).all())


def _factor(coefficients: Vector, middle: float) -> Vector:
    """Return the monic polynomial in s with roots in the left half plane whose |.|^2 is that in (w/middle)^2."""
    roots = np.roots(coefficients[::-1])
    left = -np.sqrt(-roots.astype(complex))
    return np.real(np.poly(middle * np.where(np.real(left) > 0, -left, left)))


_RUNS_NEEDED = 100


def cross_gains(
    recordings: Sequence[Recording], nominal: Sequence[Continuous], directions: Directions, source: str
) -> tuple[Matrix, Matrix]:
    """Return static gains (outputs, channels) from the inputs of all axes to each output, and their deviations.

    Every input is given the pole and the dead time of the output's own axis; gains and an offset for each run by least
    squares, so that only ratios of slow effects are told. `source` is "set_points" or "positions".
    """
    channels = axis_inputs(recordings[0].rows(0, 2), directions, source).shape[1]
    gains, stds = np.full((len(nominal), channels), np.nan), np.full((len(nominal), channels), np.nan)
    for axis in range(len(nominal)):
        parts, targets = [], []
        for recording in recordings:
            for run in recording.runs():
                y = run.outputs[:, axis]
                there = np.isfinite(y)
                if there.sum() < _RUNS_NEEDED:
                    continue
                U = axis_inputs(run, directions, source)
                X = np.column_stack([unit_response(nominal[axis], u, run.sample_time) for u in U.T])[there]
                parts.append(X - X.mean(axis=0))
                targets.append(y[there] - y[there].mean())
        if not parts:
            continue
        X, y = np.concatenate(parts), np.concatenate(targets)
        moved = X.std(axis=0) > 1e-6
        theta, *_ = np.linalg.lstsq(X[:, moved], y)
        e = y - X[:, moved] @ theta
        covariance = np.linalg.pinv(X[:, moved].T @ X[:, moved]) * float(e @ e) / max(y.size - channels, 1)
        gains[axis, moved], stds[axis, moved] = theta, np.sqrt(np.diag(covariance))
    return gains, stds


_FREQUENCY_COUNT = 100
# [s] of a window: Eq. 22 goes through several of its waves.
_WINDOW_S = 8.0
# Width of the operating points, of scaled outputs [rad], and the order of W.
_INCLINATION_STEP, _WEIGHT_ORDER = float(np.radians(7.5)), 2
# Of a window [scaled s]: 5 time constants hold a response, 5,000 several operating points.
_MIN_WINDOW_S, _MAX_WINDOW_S = 1.0, 1000.0
# From a tenth of the neck's slowest time constants.
_LOWEST_RAD_S = 0.05
# Local models faster than this are stopped, not found: 40 1/s are 25 ms.
_FASTEST_POLE = 40.0
_CAUTION_TEXT = (
    "each local model is linear and of one pole; what lies between them or beyond the recordings is not covered, "
    "and hysteresis shows as dead time and pole"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FamilySettings:
    """Local models `K exp(-L s)/(s + p)` by instrumental variables, and the uncertain plant over them.

    One for each output, from its redefined input; the fit sees scaled quantities. Every recording (payload) is cut into
    windows; windows of one inclination and direction make an operating point.

    Attributes:
        window: length of a window [s]; shorter runs are one window. None: 40 time constants, of a neck 8 s.
        directions: sectors of direction; 1 takes all together.
        max_delay: bound on dead times [s]; None: one and a half time constants, of a neck 0.3 s.
        source: "set_points", or "positions" of the motors.
        confidence: of each circle of the measured frequency responses that the weight of the data covers.
    """

    window: float | None = None
    directions: int = 4
    max_delay: float | None = None
    source: str = "set_points"
    confidence: float = 0.95

    def __post_init__(self) -> None:
        for name in ("window", "max_delay"):
            if (seconds := getattr(self, name)) is not None:
                require_positive(name, seconds, "s")
        require_whole("directions", self.directions, 1, 72)
        require_one_of("source", self.source, SOURCES)
        require_between("confidence", self.confidence, 0.5, 0.9999)

    @one_blas_thread
    def fit(
        self,
        recordings: Recording | list[Recording],
        *,
        names: Sequence[str] | None = None,
        progress: Progress = silent,
    ) -> Family:
        """Return the family of one or several recordings of one sample time.

        Args:
            recordings: of one robot.
            names: of the recordings, for messages; "recording 1" and so on if not given.
            progress: called now and then.

        Raises:
            DataError: too short, other sample times, or too few local models that say enough.
        """
        parts = recordings if isinstance(recordings, list) else [recordings]
        whole = concatenate(parts)
        for part in parts:
            check_training(part)
        data = ScaledData.of(whole)
        scaling = data.scaling
        if self.window is not None:
            ends = scaling.unscale_seconds(_MIN_WINDOW_S), scaling.unscale_seconds(_MAX_WINDOW_S)
            require_between("window", self.window, *ends, "s")
        times = {"window": data.seconds(self.window, _WINDOW_S), "max_delay": data.longest_delay(self.max_delay)}
        named = list(names) if names is not None else [f"recording {k + 1}" for k in range(len(parts))]
        if len(named) != len(parts):
            raise DataError(f"{len(named)} names were given for {len(parts)} recordings; give one for each.")
        scaled = replace(self, **times)
        found = in_si(scaled._scaled_family([data.scale(part) for part in parts], data, named, progress), scaling)
        tested = {
            **found.findings["tested"],
            "sha256": [digest(part) for part in parts],
            "conditions": [conditions(part) for part in parts],
        }
        progress(1.0, "done")
        return replace(
            found,
            sample_time=whole.sample_time,
            robot=robot_at_rest(whole),
            settings=asdict(self) | {key: scaling.second * (value or 0.0) for key, value in times.items()},
            findings={**found.findings, "tested": tested, **data.findings()},
        )

    def _scaled_family(self, parts: list[Recording], data: ScaledData, names: list[str], progress: Progress) -> Family:
        """Return the family in scaled quantities."""
        directions, Ts, source = data.directions, parts[0].sample_time, self.source
        length, lead = self.window or _WINDOW_S, self.max_delay or MAX_DELAY
        upright = data.recording.robot.outputs.rest is not None and len(directions.names) <= 2
        frequency = np.geomspace(_LOWEST_RAD_S, np.pi / Ts, _FREQUENCY_COUNT)
        search = SrivcFitOptions(sample_time=Ts, offset=True, max_delay=lead, fastest=_FASTEST_POLE)
        cut = [
            window
            for number, part in enumerate(parts)
            for window in windows(part, number, directions, length=length, lead=lead, source=source, upright=upright)
        ]
        axes, dropped = {}, {}
        for axis, name in enumerate(directions.names):
            progress(0.8 * axis / len(directions.names), f"local models of {name}")
            found, dropped[name] = self._local_models(search, cut, axis, len(parts))
            axes[name] = self._axis(name, found, frequency, Ts, dropped[name])
        progress(0.8, "cross gains")
        nominal = [one_pole(axes[name].nominal) for name in directions.names]
        cross, cross_std = cross_gains(parts, nominal, directions, self.source)
        squeezed = fit_compression(parts, SrivcFitOptions(sample_time=Ts, offset=True), directions, self.source)
        progress(0.9, "frequency responses")
        measured, tested = self._measure_responses(search, parts, directions, nominal, names)
        return Family(
            sample_time=Ts,
            axes=axes,
            frequency=frequency,
            cross=cross,
            cross_std=cross_std,
            compression=_numbers(squeezed),
            settings=asdict(self),
            findings={
                "recordings": len(parts),
                "windows": len(cut),
                "windows_that_said_too_little": dropped,
                "caution": _CAUTION_TEXT,
                "tested": tested,
            },
            robot=parts[0].robot,
            directions=directions.weights,
            measured=measured,
        )

    def _measure_responses(
        self,
        search: SrivcFitOptions,
        parts: list[Recording],
        directions: Directions,
        nominal: Sequence[Continuous],
        named: list[str],
    ) -> tuple[dict[str, AxisMeasured], dict[str, Any]]:
        """Return the measured responses of each axis, and how they were tested, for the findings."""
        responses, why = measured_responses(parts, self.source)
        found, silent_ones = {}, {}
        for axis, name in enumerate(directions.names):
            points = axis_points(responses, axis, directions, self.confidence)
            silent_ones[name] = recordings_without_response(
                points, axis_runs(parts, directions, self.source, axis), named
            )
            # One frequency is no band.
            if points.size and points[:, 1].max() > 1.1 * points[:, 1].min():
                found[name] = self._measured_axis(search, parts, directions, axis, points, nominal[axis])
            else:
                why.append(f"{name}: no band of its response is known within 30 %; record `multisine --band 0.5,25`")
        amplitudes = [[] if response is None else response.amplitude.tolist() for response in responses]
        tested = {
            "confidence": self.confidence, "names": named, "sha256": [], "why": why,
            "amplitude": [max(sizes, default=0.0) for sizes in amplitudes], "unheard": silent_ones, "conditions": [],
        }  # fmt: skip
        return found, tested

    def _measured_axis(
        self,
        search: SrivcFitOptions,
        parts: list[Recording],
        directions: Directions,
        axis: int,
        points: Matrix,
        near: Continuous,
    ) -> AxisMeasured:
        Ts = search.sample_time
        runs = axis_runs(parts, directions, self.source, axis)
        model, held_out = choose_order(search, [run for part in runs for run in part], near)
        if model is None:
            raise DataError(f"{directions.names[axis]}: no model of one to three poles fits; record with more motion.")
        model = middle_model(model, points, Ts, search.max_delay)
        frequency, weight = covering_weight(model, points, Ts)
        borders = band_borders(float(frequency[0]), float(frequency[-1]))
        first = AxisMeasured(
            model=model, held_out=held_out, points=points, frequency=frequency, weight=weight, borders=borders,
            needed=np.zeros((0, borders.size - 1)),
        )  # fmt: skip
        cover = raise_weight(replace(first, needed=judge_records(runs, first, points, Ts)))
        return replace(cover, needed=judge_records(runs, cover, points, Ts))

    def _local_models(
        self, search: SrivcFitOptions, cut: Sequence[Window], axis: int, recordings: int
    ) -> tuple[list[Local], int]:
        """Return the local models of an axis: windows, operating points, recordings; and how many windows gave none."""
        single = [fit_local(search, [window], axis, scope="window") for window in cut]
        there = [local for local in single if local is not None]
        near = one_pole(np.median([local.numbers for local in there], axis=0)) if there else None
        # A point is made of windows that said something alone; one that stood still adds nothing.
        useful = [window for window, local in zip(cut, single, strict=True) if local is not None]
        points: dict[tuple[int, int, int], list[Window]] = {}
        for window in useful:
            sector = round(window.direction / (2 * np.pi) * self.directions) % self.directions
            key = (window.recording, int(window.inclination / _INCLINATION_STEP), sector)
            points.setdefault(key, []).append(window)
        found = [*there]
        found += [fit_local(search, group, axis, scope="point", near=near) for _, group in sorted(points.items())]
        for number in range(recordings):
            group = [window for window in useful if window.recording == number]
            found.append(fit_local(search, group, axis, scope="recording", near=near))
        return [local for local in found if local is not None], len(cut) - len(there)

    def _axis(self, name: str, found: list[Local], frequency: Vector, sample_time: float, lost: int) -> AxisFamily:
        used = np.array([local.scope != "window" for local in found], dtype=float)
        if used.sum() < 2:
            raise DataError(
                f"{name}: only {int(used.sum())} local models say enough ({lost} windows do not) where a family needs "
                "2; record with more motion of it, or set `window` longer."
            )
        samples = np.array([local.numbers for local in found])
        std = np.array([local.std for local in found])
        plants = samples[used > 0.5]
        box = np.array([plants.min(axis=0), plants.max(axis=0)])
        nominal = 0.5 * (box[0] + box[1])
        # Whole samples: a dead time between two puts a zero beside z = -1, where no relative error is finite.
        nominal[2] = round(nominal[2] / sample_time) * sample_time
        errors = relative_errors(plants, nominal, frequency, sample_time)
        envelope = errors.max(axis=0)
        above, below = self._weight(frequency, envelope, plants, nominal, sample_time)
        size = max(above.size, below.size)
        weight = np.array([np.concatenate([np.zeros(size - part.size), part]) for part in (above, below)])
        where = [
            [SCOPES.index(x.scope), x.recording, x.time if np.isfinite(x.time) else -1.0, x.inclination, x.direction]
            for x in found
        ]
        return AxisFamily(
            samples=samples,
            std=std,
            where=np.array(where, dtype=float),
            used=used,
            nominal=nominal,
            box=box,
            weight=weight,
            envelope=envelope,
        )

    def _weight(
        self, frequency: Vector, envelope: Vector, plants: np.ndarray, nominal: Vector, sample_time: float
    ) -> tuple[Vector, Vector]:
        above, below = envelope_weight(frequency, envelope, _WEIGHT_ORDER)
        # Between the grid's points the samples may stand a little higher than its lines.
        w = np.geomspace(frequency[0], frequency[-1], 5 * frequency.size)
        W = np.abs(np.polyval(above, 1j * w) / np.polyval(below, 1j * w))
        excess = float(np.max(relative_errors(plants, nominal, w, sample_time) / W))
        return above * max(1.0, excess), below


def in_si(family: Family, scaling: Scaling) -> Family:
    """Return the family in SI: gains, poles, dead times, frequencies and weights."""
    if scaling.is_identity:
        return family
    second, motor = scaling.second, scaling.motor_unit
    gains = scaling.output_unit / motor
    axes, measured = {}, {}
    for (name, axis), gain in zip(family.axes.items(), gains, strict=True):
        numbers = np.array([gain, 1.0 / second, second])
        powers = second ** np.arange(axis.weight.shape[1])[::-1]
        axes[name] = replace(
            axis, samples=numbers * axis.samples, std=np.append(numbers, gain / second) * axis.std,
            where=np.where([False, False, True, False, False] & (axis.where >= 0.0), second, 1.0) * axis.where,
            nominal=numbers * axis.nominal, box=numbers * axis.box, weight=powers * axis.weight,
        )  # fmt: skip
    for name, found in family.measured.items():
        gain, model = float(gains[list(family.axes).index(name)]), found.model
        order = second ** -np.arange(1.0, model.a.size + 1.0)
        b = gain * order[-model.b.size :] * model.b
        measured[name] = replace(
            found, model=Continuous(a=order * model.a, b=b, delay=second * model.delay),
            held_out=gain * motor * found.held_out, points=found.points * [1.0, 1.0 / second, gain, gain, gain],
            frequency=found.frequency / second, borders=found.borders / second,
        )  # fmt: skip
    tested = family.findings["tested"]
    amplitude = [size if size is None else motor * size for size in tested["amplitude"]]
    return replace(
        family, axes=axes, measured=measured, frequency=family.frequency / second,
        cross=gains[:, None] * family.cross, cross_std=gains[:, None] * family.cross_std,
        compression=family.compression * [1.0 / motor, 1.0 / second, second],
        findings={**family.findings, "tested": {**tested, "amplitude": amplitude}},
    )  # fmt: skip


def _numbers(model: Any) -> Vector:
    return np.full(3, np.nan) if model is None else np.array([model.b[0] / model.a[0], model.a[0], model.delay])
