"""Residual tests as MATLAB's `resid`: whiteness, and correlation with the inputs, with 99 % bounds (Ljung 1999, 16.6).

All sums are inside each segment of rows. Calibrated bounds take the errors of whole records as exchangeable, never
rows: the half-width for the largest error of a further record is an order statistic (Stankeviciute et al. 2021); that
for one of its samples weighs each record alike, and a further one as infinite (Lee, Barber and Willett 2023). On
motions unlike these there is no guarantee (Barber et al. 2023).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector

from ..models._model import Model
from ..models._validity import has_validity, tolerance_of
from ._score_tables import Rows

# As in MATLAB's `resid`.
LEVEL, LAGS = 0.99, 25


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTests:
    """Whiteness of the one-step errors of pitch and roll, and their correlation with the inputs.

    lags: (26,) 0 to 25 samples; autocorrelation: (2, 26); bound: (2,) a white error stays within +- this at each lag
    with 99 %; p_value: (2,) of the portmanteau test of lags 1 to 25 (Ljung and Box 1978), NaN where rows are too few;
    cross_lags: (51,) -25 to 25, positive: the error follows the input; cross_correlation: (2, 3, 51) of each error with
    each set-point; cross_bound: (2, 3) for an error of its own colour that does not depend on the input.
    """

    lags: np.ndarray
    autocorrelation: Matrix
    bound: Vector
    p_value: Vector
    cross_lags: np.ndarray
    cross_correlation: Matrix
    cross_bound: Matrix

    @property
    def white(self) -> bool:
        """Whether both axes pass the portmanteau test at the 99 % level."""
        return bool((self.p_value >= 1.0 - LEVEL).all())

    @property
    def uncorrelated(self) -> bool:
        """Whether no error follows an input at lags 0 to 25: 99 % for all of these tests together (Bonferroni)."""
        if not np.isfinite(self.p_value).all():
            return False
        causal = np.abs(self.cross_correlation[:, :, LAGS:])
        return bool((causal.max(axis=2) <= self.cross_bound * _sigmas(causal.size) / _sigmas(1)).all())

    def as_dict(self, names: Sequence[str] = ("pitch", "roll")) -> dict[str, Any]:
        """Return the arrays as lists, for JSON; `names` are those of the outputs."""
        return {
            "lags": self.lags.tolist(),
            "autocorrelation": self.autocorrelation.tolist(),
            "bound": self.bound.tolist(),
            "p_value": dict(zip(names, self.p_value.tolist(), strict=True)),
            "cross_lags": self.cross_lags.tolist(),
            "cross_correlation": self.cross_correlation.tolist(),
            "cross_bound": self.cross_bound.tolist(),
        }


def residual_tests(errors: Matrix, inputs: Matrix, segment: np.ndarray) -> ResidualTests:
    """Test one-step errors (time, 2), NaN where there is none, against themselves and set-points (time, 3).

    `segment`: (time,) number of the segment of rows; sorted.
    """
    from scipy.stats import chi2

    edges = np.flatnonzero(np.diff(segment)) + 1
    axes = errors.shape[1]
    autocorrelation, bound, p_value = np.zeros((axes, LAGS + 1)), np.full(axes, np.nan), np.full(axes, np.nan)
    cross, cross_bound = np.zeros((axes, inputs.shape[1], 2 * LAGS + 1)), np.full((axes, inputs.shape[1]), np.nan)
    for axis, column in enumerate(errors.T):
        there = np.isfinite(column)
        n = int(there.sum())
        if n <= 2 * LAGS:  # too few for a correlation at lag 25
            continue
        e = np.where(there, column - column[there].mean(), 0.0)
        # What the test calls the input is the input at the rows that have an error.
        U = np.where(there[:, None], inputs - inputs[there].mean(axis=0), 0.0)
        parts = list(zip(np.split(e, edges), np.split(U, edges), np.split(there, edges), strict=True))
        pairs = _total(_products(seen.astype(float), seen.astype(float)) for _, _, seen in parts)
        r = _normalise(_total(_products(e_part, e_part) for e_part, _, _ in parts), e, e)
        autocorrelation[axis] = r
        bound[axis] = _sigmas(1) / np.sqrt(n)
        p_value[axis] = chi2.sf(n * (n + 2) * float(np.sum(r[1:] ** 2 / np.maximum(pairs[1:], 1))), LAGS)
        for j, u in enumerate(U.T):
            later = _total(_products(e_part, U_part[:, j]) for e_part, U_part, _ in parts)
            earlier = _total(_products(U_part[:, j], e_part) for e_part, U_part, _ in parts)
            cross[axis, j] = _normalise(np.concatenate([earlier[:0:-1], later]), e, u)
            r_u = _normalise(_total(_products(U_part[:, j], U_part[:, j]) for _, U_part, _ in parts), u, u)
            # Variance of a coloured error's correlation; truncation may leave it below a white one's: it never is.
            variance = max(1.0, 1.0 + 2.0 * float(r[1:] @ r_u[1:]))
            cross_bound[axis, j] = _sigmas(1) * np.sqrt(variance / n)
    lags = np.arange(LAGS + 1)
    return ResidualTests(lags, autocorrelation, bound, p_value, np.arange(-LAGS, LAGS + 1), cross, cross_bound)


def _products(late: Vector, early: Vector) -> Vector:
    """Return `sum_t late(t + k) early(t)` for k = 0..25."""
    n = late.size
    return np.array([float(late[k:] @ early[: n - k]) if k < n else 0.0 for k in range(LAGS + 1)])


def _total(sums: Iterable[Vector]) -> Vector:
    return np.sum(list(sums), axis=0)


def _normalise(sums: Vector, a: Vector, b: Vector) -> Vector:
    return sums / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)


def _sigmas(tests: int) -> float:
    """Return the two-sided 99 % bound of a standard normal, shared by so many tests."""
    from scipy.stats import chi2

    return float(np.sqrt(chi2.ppf(1.0 - (1.0 - LEVEL) / tests, 1)))


BOUND_LEVEL = 0.9
#: Records at least for a bound at 90 %: nine of ten are below the largest of nine and a tenth.
LEAST_RECORDS = 9
# Wider than this part of what was measured a bound says nothing that the range of the data does not.
_MAX_USEFUL_WIDTH = 0.5
# Of the range of the set-points: what is no further beyond it is not another motion.
_DOMAIN_MARGIN = 0.01
# What set membership promises is all of it; this much less is rounding and outliers [%].
_PROMISED_COVERAGE_PCT = 99.0


def useful_parts(rows: Rows, lower: Matrix, upper: Matrix) -> tuple[Matrix, Matrix]:
    """Return the bounds (time, outputs), NaN where they are wider than the measured range."""
    too_wide = ~(upper - lower <= _range(rows))
    return np.where(too_wide, np.nan, lower), np.where(too_wide, np.nan, upper)


def judged_bounds(
    rows: Rows, coverage: dict[str, float] | None, width: dict[str, float] | None, *, promised: bool
) -> tuple[dict[str, float | None] | None, list[str]]:
    """Return the mean widths, None for useless ones, and the remarks, one line each.

    `promised`: whether the bounds promise to hold all samples, as set membership does.
    """
    if coverage is None or width is None:
        return None, []
    unit = rows.robot.outputs.display_unit
    shown: dict[str, float | None] = dict(width)
    said = []
    for (name, wide), span in zip(width.items(), _range(rows), strict=True):
        range_ = rows.to_display_unit(float(span))
        if wide > range_:
            shown[name] = None
            said.append(
                f"no useful bound in {name}: it would be wider than all that was measured ({range_:.3g} {unit})"
            )
        elif wide > _MAX_USEFUL_WIDTH * range_:
            said.append(
                f"no useful bound in {name}: {wide:.3g} {unit} wide in the mean, more than half of what was measured "
                f"({range_:.3g} {unit})"
            )
        if promised and coverage[name] < _PROMISED_COVERAGE_PCT:
            said.append(
                f"the bounds of {name} promise all samples and held {coverage[name]:.0f} %: their assumption (noise "
                "within epsilon, a slope of at most gamma) does not hold on these rows"
            )
    return shown, said


def calibrated_bounds(rows: Rows, errors: Matrix) -> dict[str, Any]:
    """Return 90 % half-widths around a simulation from whole segments, and their coverage of segments left out.

    `pointwise` is for any one sample of a further record of this kind, `path` for all of its samples at once. Of both:
    axis -> half-width, what it held on records left out within the domain of the others, and how much of them lay
    beyond (`outside_pct`). `domain`: range of set-points [SI] beyond which there is no bound. `errors` (time, outputs)
    are NaN where not judged. Without bounds, the reason.
    """
    numbers = [number for number in range(int(rows.segment[-1]) + 1)
               if np.isfinite(errors[rows.segment == number]).all(axis=1).any()]  # fmt: skip
    records = [errors[rows.segment == number] for number in numbers]
    motors = [rows.set_points[rows.segment == number] for number in numbers]
    found: dict[str, Any] = {"level_pct": 100.0 * BOUND_LEVEL, "records": len(records), "reason": None}
    if len(records) < LEAST_RECORDS:
        needed = f"bounds at {100 * BOUND_LEVEL:g} % need {LEAST_RECORDS} separate recordings"
        reason = f"{needed}; {len(records)} were given"
        return {**found, "reason": reason}
    found["domain"] = dict(zip(("min", "max"), (end.tolist() for end in _range_of(motors)), strict=True))
    inside = [_within(own, [*motors[:number], *motors[number + 1 :]]) for number, own in enumerate(motors)]
    reasons = []
    for what, half_width in (("pointwise", _pointwise), ("path", _path)):
        found[what] = {}
        for i, name in enumerate(rows.names):
            there = [np.isfinite(record[:, i]) for record in records]
            parts = [np.abs(record[seen, i]) for record, seen in zip(records, there, strict=True)]
            half = half_width(parts)
            if 2.0 * half > _MAX_USEFUL_WIDTH * float(_range(rows)[i]):
                reasons.append(f"no useful {what} bound in {name}: wider than half of what was measured")
                continue
            known = [near[seen] for near, seen in zip(inside, there, strict=True)]
            found[what][name] = {
                "half_width": rows.to_display_unit(half),
                "coverage_pct": _left_out(parts, known, half_width, what),
                "outside_pct": 100.0 * float(np.mean(~np.concatenate(known))),
            }
    return {**found, "reason": "; ".join(reasons) or None}


def _path(parts: Sequence[Vector]) -> float:
    """Return the 90 % bound on the largest error of a further record."""
    largest = np.sort([part.max() for part in parts])
    rank = int(np.ceil(BOUND_LEVEL * (len(parts) + 1) - 1e-9))
    return float(largest[rank - 1]) if rank <= len(parts) else float("inf")


def _pointwise(parts: Sequence[Vector]) -> float:
    """Return the 90 % bound on one error of a further record, with equal weights for all records."""
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(part.size, 1.0 / (part.size * (len(parts) + 1))) for part in parts])
    order = np.argsort(values)
    reached = np.flatnonzero(np.cumsum(weights[order]) >= BOUND_LEVEL - 1e-9)
    return float(values[order][reached[0]]) if reached.size else float("inf")


def _left_out(parts: Sequence[Vector], known: Sequence[np.ndarray], half_width: Any, what: str) -> float | None:
    """Return the share [%] of each record, or of all records, within the bound of the others.

    Only where there is one: `known` says which samples lie within their domain; a whole path takes all of them.
    """
    if len(parts) <= LEAST_RECORDS:
        return None
    held = []
    for number, (part, near) in enumerate(zip(parts, known, strict=True)):
        inside = part <= half_width([*parts[:number], *parts[number + 1 :]])
        if near.all() if what == "path" else near.any():
            held.append(inside[near].mean() if what == "pointwise" else inside.all())
    return 100.0 * float(np.mean(held)) if held else None


def _range_of(motors: Sequence[Matrix]) -> tuple[Vector, Vector]:
    """Return the lowest and the highest set-point of each motor (motors,) over records (time, motors)."""
    return np.min([own.min(axis=0) for own in motors], axis=0), np.max([own.max(axis=0) for own in motors], axis=0)


def _within(own: Matrix, others: Sequence[Matrix]) -> np.ndarray:
    """Return (time,) whether all set-points of a record lie within those of the others, but for a hundredth."""
    low, high = _range_of(others)
    slack = _DOMAIN_MARGIN * (high - low)
    return np.asarray(((own >= low - slack) & (own <= high + slack)).all(axis=1))


def _range(rows: Rows) -> Vector:
    """Return the measured range (outputs,); NaN without measurements."""
    return np.array([np.ptp(y[np.isfinite(y)]) if np.isfinite(y).any() else np.nan for y in rows.measured.T])


_RELIABILITY_BINS = 10


def judged_validity(model: Model, rows: Rows, free: Matrix) -> dict[str, Any] | None:
    """Return the validity over a simulation `free` (time, n_out), compared with the share of errors within tolerance.

    The Brier score is the mean squared distance between the probability and what happened (Brier 1950);
    `brier_base_rate` is that of who knows only how often these rows stay within. `held`: share of rows with all errors
    within the tolerance; reliability: predicted, held and rows for each tenth. None without validity or rows.
    """
    allowed = tolerance_of(model)
    if not has_validity(model) or allowed is None or free.shape[1] <= allowed.size:
        return None
    there = np.isfinite(rows.measured).all(axis=1) & np.isfinite(free[:, -1])
    if not there.any():
        return None
    predicted = free[there, -1]
    # An error that is no number is not within.
    held = np.asarray((np.abs(rows.measured - free[:, : allowed.size])[there] <= allowed).all(axis=1))
    share = float(held.mean())
    return {
        "least": float(predicted.min()),
        "mean": float(predicted.mean()),
        "held": share,
        "brier": float(np.mean((predicted - held) ** 2)),
        "brier_base_rate": share * (1.0 - share),
        "reliability": reliability(predicted, held),
    }


def reliability(predicted: np.ndarray, held: np.ndarray) -> list[dict[str, float]]:
    """Return for each tenth of the probability that occurs: its mean, how often that happened, and the rows."""
    bins = np.minimum((predicted * _RELIABILITY_BINS).astype(int), _RELIABILITY_BINS - 1)
    return [
        {
            "predicted": float(predicted[bins == b].mean()),
            "held": float(held[bins == b].mean()),
            "rows": int((bins == b).sum()),
        }
        for b in np.unique(bins)
    ]
