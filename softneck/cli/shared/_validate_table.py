"""The terminal's table of `softneck validate`: one line for each model, recording and horizon, in 120 columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import to_si

from ._console import percent

if TYPE_CHECKING:
    from softneck.identification import Validation


Head = list[str]
Cells = list[list[str]]
# What is left of 120 columns beside the numbers.
_NAME = 18
# [%] What the mean of the rows scores: a model that is further off knows less than one that never moves.
_USELESS = 0.0
# [%] What `design` asks for at least.
_WORTH = 30.0


def fit_table(results: Sequence[Validation]) -> tuple[Head, Cells]:
    """Return the fits [%] of the outputs beside what they must be compared with."""
    head = [
        "model on data",
        "horizon",
        "persist.",
        "best linear",
        "model",
        "95 % interval",
        f"rms {results[0].robot.outputs.display_unit}",
        "worst",
    ]
    cells: Cells = []
    for r in results:
        name = _short(f"{Path(r.model).stem} on {Path(r.data).stem}")
        for horizon, fits in r.fits.items():
            cells.append(
                [
                    name,
                    "free run" if horizon == "inf" else horizon,
                    _pair(r.persistence.get(horizon, {}).values()),
                    _pair(r.best_linear[horizon].values()),
                    _pair(fits.values()),
                    "  ".join(_interval(interval) for interval in r.intervals[horizon].values()),
                    _pair(r.rmse_deg[horizon].values(), digits=2),
                    _pair(r.worst_deg[horizon].values(), digits=1),
                ]
            )
            name = ""
    return head, cells


def remarks(r: Validation) -> list[str]:
    """Return the lines below the table on one model and recording."""
    who = f"{Path(r.model).stem} on {Path(r.data).stem}"
    lines = [f"{who}: {r.rows_scored} rows judged, {r.rows_left_out} left out as the model was trained on them"]
    lost = [entry for entry in r.per_run if entry["diverged"] is not None]
    lines += [f"{who}: the free run of run {e['run']} diverged at {e['diverged']:.2f} s" for e in lost]
    if "inf" in r.fits:
        lines.append(
            f"{who}: free run {_pair(r.cold_fits.values())} % from the first row only (cold, as an FMU starts)"
        )
    lines += [
        f"{who}: free run {'  '.join(map(_interval, table.values()))} % over {what} of these rows, least..largest"
        for what, table in r.spread.items()
        if any(table.values()) and not lost
    ]
    if any(fit is not None for fit in r.noise_ceiling.values()):
        lines.append(f"{who}: repeats allow a perfect model {_pair(r.noise_ceiling.values())} % (noise ceiling)")
    lines.append(f"{who}: {_residuals(r)}")
    if r.coverage_pct is not None and r.mean_width_deg is not None and not lost:
        lines.append(
            f"{who}: free-run bounds hold {_pair(r.coverage_pct.values())} % of the samples, "
            f"{_pair(r.mean_width_deg.values())} {r.robot.outputs.display_unit} wide"
        )
    if r.outside_pct is not None and not lost:
        lines.append(f"{who}: {_pair(r.outside_pct.values())} % of them lie outside what the model has seen")
    if r.validity is not None:
        v = r.validity
        lines.append(
            f"{who}: validity {v['mean']:.2f} in the mean, {v['least']:.2f} at least; {100 * v['held']:.0f} % of the "
            f"samples were within the tolerance (Brier score {v['brier']:.3f}, of that share alone "
            f"{v['brier_base_rate']:.3f})"
        )
    lines += [f"{who}: {said}" for said in r.bounds_remarks if not lost]
    if not lost:
        lines += _calibrated(who, r)
    return lines


def _calibrated(who: str, r: Validation) -> list[str]:
    """Return the bounds that whole records allow, or why there are none."""
    found, unit = r.calibrated_bounds, r.robot.outputs.display_unit
    lines = []
    for what, of in (("pointwise", "any sample"), ("path", "all samples")):
        for axis, bound in found.get(what, {}).items():
            held = (
                "" if bound["coverage_pct"] is None else f"; left out one by one it held {bound['coverage_pct']:.0f} %"
            )
            lines.append(
                f"{who}: calibrated on {found['records']} records, 90 % for {of} of a further one: {axis} "
                f"+-{bound['half_width']:.2f} {unit}{held}"
            )
    if lines:
        unit, ends = r.robot.motors.unit, zip(found["domain"]["min"], found["domain"]["max"], strict=True)
        said = "  ".join("..".join(f"{end / to_si(unit)[0]:.3g}" for end in pair) for pair in ends)
        lines.append(f"{who}: beyond the set-points of these records ({said} {unit}) there is no such bound")
    if found["reason"] is not None:
        lines.append(f"{who}: no calibrated bounds, {found['reason']}" if not lines else f"{who}: {found['reason']}")
    return lines


def useless(r: Validation) -> str | None:
    """Return why a model is no model of the rows that it was judged on, or None."""
    if r.diverged is not None:
        return f"its free run diverges at {r.diverged:.2f} s"
    fits = [(fit, "in free run" if h == "inf" else f"{h} sample(s) ahead", axis)
            for h, table in r.fits.items() for axis, fit in table.items() if fit is not None]  # fmt: skip
    worst, horizon, axis = min(fits, default=(0.0, "", ""))
    return f"its fit {horizon} is {percent(worst)} % in {axis}" if worst < _USELESS else None


def left_out(r: Validation) -> str:
    """Return the advice to go on without the outputs that spoil a model of the others; "" where that is no way out."""
    fits = {axis: fit for axis, fit in r.fits.get("inf", {}).items() if fit is not None}
    poor = [axis for axis, fit in fits.items() if fit < _USELESS]
    good = [axis for axis in fits if axis not in poor]
    if r.diverged is not None or not poor or not good or min(fits[axis] for axis in good) < _WORTH:
        return ""
    said = "/".join(percent(fits[axis]) for axis in good)
    without = ", ".join(poor)
    return f"Leave {without} out of `outputs.names` in a robot.toml: without it {', '.join(good)} fits {said} %."


def _residuals(r: Validation) -> str:
    p_value = r.residual_tests.p_value
    if np.isnan(p_value).any():
        return "too few one-step errors to test whether they are white"
    p_values = "/".join("<0.001" if p < 1e-3 else f"{p:.3f}" for p in p_value)
    return (
        f"one-step errors are {'' if r.white else 'not '}white (p {p_values}) and "
        f"{'do not follow' if r.uncorrelated else 'follow'} the inputs (99 %)"
    )


def _pair(values: Iterable[float | None], *, digits: int = 1) -> str:
    words = ["-" if value is None else percent(value) if digits == 1 else f"{value:.{digits}f}" for value in values]
    return "/".join(words) if words else ""


def _interval(interval: Sequence[float] | None) -> str:
    return "-" if interval is None else f"{interval[0]:.1f}..{interval[1]:.1f}"


def _short(name: str) -> str:
    return name if len(name) <= _NAME else name[: _NAME - 1] + "…"
