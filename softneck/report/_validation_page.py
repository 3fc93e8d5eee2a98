"""What `softneck validate` tells: the table of fits, remarks, and the page that shows each model beside the data."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import Matrix, percent, to_si
from softneck.identification import INFINITE, Validation
from softneck.plots import Chart, Section, Table, page, residual_chart, validation_chart

VALIDATION_NOTE = (
    "Fit is 100 (1 - |y - yhat| / |y - mean y|) in %, {outputs}. Persistence repeats the last sample: a one-step fit "
    "that is not above it says nothing. Best linear was fitted on the judged rows themselves: no linear model of the "
    "set-points has a better free run on them. The free run has the set-points alone (or the logged motors, if asked "
    "for); that is what an FMU of the plant does. Rows that a model was trained on are left out."
)
_ERROR = "Error is measured minus predicted; where a row is not scored, or was not recorded, nothing is drawn."
_RESIDUALS = (
    "A model that has caught everything leaves white errors that no set-point foretells: 99 of 100 bars within the "
    "dashed bounds. Positive lags: the error follows the set-point, so that a bar outside is a gain or a lag that the "
    "model misses; slow or periodic set-points spread it over many lags, negative ones too. Set-points made by a "
    "controller from the outputs show at negative lags."
)
_HEAD = ("model on data", "ahead", "persistence", "best linear", "model", "95 % interval", "rms", "worst")
# A free run beyond this has diverged [rad], of other outputs than angles beyond so many times what was measured; it is
# not drawn from there on, for the rest to stay readable.
_DRAWN, _DRAWN_TIMES = np.pi, 10.0


def validation_page(results: Sequence[Validation], *, title: str = "Validation") -> str:
    """Return one self-contained page with interactive plots of all results.

    Where several models were judged on the same rows, a chart of all their free runs comes first.

    Args:
        results: of `validate`, one for each model and recording.
        title: of the page.
    """
    together = _comparisons(results)
    sections = [_overview(results, together or [curves(results[0])])]
    sections += [_section(r, drawn=not together and r is results[0]) for r in results]
    return page(title, sections, verdict=_verdict(results), footer="Written by softneck validate.")


def _verdict(results: Sequence[Validation]) -> str:
    """Return in a sentence which model is best on each recording, by its longest horizon."""
    said = []
    for data in dict.fromkeys(r.data for r in results):
        rivals = [r for r in results if r.data == data]
        best = max(rivals, key=lambda r: min(-np.inf if fit is None else fit for fit in _last(r).values()))
        fits = ", ".join(f"{name} {_text(fit, 1)} %" for name, fit in _last(best).items())
        ahead = list(best.fits)[-1]
        how = "Simulation fit" if ahead == INFINITE else f"Fit {ahead} samples ahead"
        diverged = [Path(r.model).stem for r in rivals if r.diverged is not None]
        said.append(
            f"{how} of {Path(best.model).stem} on {Path(data).stem}: {fits}"
            + (f" (best of {len(rivals)} models)" if len(rivals) > 1 else "")
            + (f"; diverged: {', '.join(diverged)}" if diverged else "")
        )
    return "; ".join(said) + "."


def _last(r: Validation) -> dict[str, float | None]:
    return r.fits[list(r.fits)[-1]]


def fit_table(results: Sequence[Validation]) -> Table:
    """Return the fits [%] of the outputs, a row for each horizon, beside what they must be compared with."""
    rows, outputs = [], results[0].robot.outputs
    for r in results:
        for h in r.fits:
            tables = (r.persistence, r.best_linear, r.fits, r.intervals)
            cells = [_cell(table.get(h, {}), 1) for table in tables]
            errors = [_cell(r.rmse_deg[h], 2), _cell(r.worst_deg[h], 1)]
            rows.append([_name(r), "free run" if h == INFINITE else h, *cells, *errors])
    return Table(f"Fit in %, errors in {outputs.display_unit}, {'/'.join(outputs.names)}", _HEAD, rows)


def _overview(results: Sequence[Validation], charts: Sequence[Chart]) -> Section:
    names = "/".join(results[0].robot.outputs.names)
    return Section("Fits", charts=charts, tables=[fit_table(results)], method=[VALIDATION_NOTE.format(outputs=names)])


def _comparisons(results: Sequence[Validation]) -> list[Chart]:
    """Put the free runs of models that were judged on the same rows into one chart."""
    groups: dict[tuple[str, bytes, bytes], list[Validation]] = {}
    for r in results:
        if INFINITE in r.fits:
            groups.setdefault((r.data, r.time.tobytes(), r.measured.tobytes()), []).append(r)
    charts = []
    for group in groups.values():
        if len(group) > 1:
            data = Path(group[0].data).stem
            runs = {Path(r.model).stem: drawable(r, r.free_run) for r in group}
            runs = runs if len(runs) == len(group) else {r.model: drawable(r, r.free_run) for r in group}
            first = group[0]
            charts.append(
                validation_chart(
                    first.time, first.measured, runs, f"Free runs on {data}", run=first.run, caption=_ERROR,
                    robot=first.robot,
                )
            )  # fmt: skip
    return charts


def _predictions(r: Validation) -> dict[str, Matrix]:
    predictions = {"one step": drawable(r, r.one_step)}
    if INFINITE in r.fits:
        predictions["free run"] = drawable(r, r.free_run)
    return predictions


def curves(r: Validation) -> Chart:
    """Return what was measured and predicted, with the bounds of the free run."""
    bounds = _bounds_of(r)
    caption = _ERROR + (" The band holds the model's bounds of its free run." if bounds else "")
    return validation_chart(
        r.time, r.measured, _predictions(r), f"{_name(r)}: measured and predicted", bounds=bounds, run=r.run,
        caption=caption, robot=r.robot,
    )  # fmt: skip


def _section(r: Validation, *, drawn: bool) -> Section:
    """Return all on one result; its curves unless they are `drawn` already."""
    charts = [*([] if drawn else [curves(r)]), _residuals(r)]
    text = [f"{said[0].upper()}{said[1:]}." for said in remarks(r)]
    return Section(_name(r), text=text, tables=_run_tables(r), charts=charts)


def _residuals(r: Validation) -> Chart:
    tests = r.residual_tests
    return residual_chart(
        (tests.lags, tests.autocorrelation, tests.bound),
        (tests.cross_lags, tests.cross_correlation, tests.cross_bound),
        "Residual tests of the one-step errors",
        caption=_RESIDUALS,
        robot=r.robot,
    )


def remarks(r: Validation) -> list[str]:
    """Return what there is to say of a model on a recording beside its fits."""
    lines = [f"{r.rows_scored} rows judged, {r.rows_left_out} left out as the model was trained on them"]
    lost = [entry for entry in r.per_run if entry["diverged"] is not None]
    lines += [f"the free run of run {e['run']} diverged at {e['diverged']:.2f} s" for e in lost]
    if INFINITE in r.fits:
        lines.append(f"free run {_cell(r.cold_fits, 1)} % from the first row only (cold, as an FMU starts)")
    lines.append(_residuals_said(r))
    if lost:
        return lines
    if r.coverage_pct is not None and r.mean_width_deg is not None:
        lines.append(
            f"free-run bounds hold {_cell(r.coverage_pct, 1)} % of the samples, "
            f"{_cell(r.mean_width_deg, 1)} {r.robot.outputs.display_unit} wide"
        )
    if r.outside_pct is not None:
        lines.append(f"{_cell(r.outside_pct, 1)} % of the samples lie outside what the model has seen")
    if r.validity is not None:
        v = r.validity
        lines.append(
            f"validity {v['mean']:.2f} in the mean, {v['least']:.2f} at least; {100 * v['held']:.0f} % of the "
            f"samples were within the tolerance (Brier score {v['brier']:.3f}, of that share alone "
            f"{v['brier_base_rate']:.3f})"
        )
    return [*lines, *r.bounds_remarks, *_calibrated(r)]


def _residuals_said(r: Validation) -> str:
    p_value = r.residual_tests.p_value
    if np.isnan(p_value).any():
        return "too few one-step errors to test whether they are white"
    p_values = "/".join("<0.001" if p < 1e-3 else f"{p:.3f}" for p in p_value)
    return (
        f"one-step errors are {'' if r.white else 'not '}white (p {p_values}) and "
        f"{'do not follow' if r.uncorrelated else 'follow'} the inputs (99 %)"
    )


def _calibrated(r: Validation) -> list[str]:
    """Return the bounds that whole records allow, or why there are none."""
    found, unit = r.calibrated_bounds, r.robot.outputs.display_unit
    lines = []
    for what, of in (("pointwise", "any sample"), ("path", "all samples")):
        for axis, bound in found.get(what, {}).items():
            held = (
                "" if bound["coverage_pct"] is None else f"; left out one by one it held {bound['coverage_pct']:.0f} %"
            )
            lines.append(
                f"calibrated on {found['records']} records, 90 % for {of} of a further one: {axis} "
                f"+-{bound['half_width']:.2f} {unit}{held}"
            )
    if lines:
        unit, ends = r.robot.motors.unit, zip(found["domain"]["min"], found["domain"]["max"], strict=True)
        said = "  ".join("..".join(f"{end / to_si(unit)[0]:.3g}" for end in pair) for pair in ends)
        lines.append(f"beyond the set-points of these records ({said} {unit}) there is no such bound")
    if found["reason"] is not None:
        lines.append(found["reason"] if lines else f"no calibrated bounds, {found['reason']}")
    return lines


def _run_tables(r: Validation) -> list[Table]:
    """Return the scores of each stretch, where there are several."""
    if len(r.per_run) < 2:
        return []
    horizons = [str(horizon) for horizon in r.fits]
    head = ["run", "from [s]", "rows", *("free run" if h == INFINITE else f"{h} ahead" for h in horizons)]
    rows = [
        [str(e["run"]), f"{e['start_s']:.2f}", str(e["rows_scored"]), *(_cell(e["fits"][h], 1) for h in horizons)]
        for e in r.per_run
    ]
    return [Table(f"Fit [%] of each run, {'/'.join(r.robot.outputs.names)}", head, rows)]


def _cell(values: dict[str, Any], digits: int) -> str:
    return "/".join(_text(value, digits) for value in values.values())


def _text(value: float | Iterable[float] | None, digits: int) -> str:
    if value is None:
        return "-"
    if isinstance(value, float | int):
        return percent(value) if digits == 1 else f"{value:.{digits}f}"
    return "..".join(f"{edge:.{digits}f}" for edge in value)


def _name(r: Validation) -> str:
    return f"{Path(r.model).stem} on {Path(r.data).stem}"


def drawable(r: Validation, values: Matrix) -> Matrix:
    """Return outputs without what has diverged."""
    most = _DRAWN if _turns(r) else _DRAWN_TIMES * float(np.nanmax(np.abs(r.measured), initial=0.0))
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < most, values, np.nan)


def _turns(r: Validation) -> bool:
    """Return whether the outputs are angles."""
    return to_si(r.robot.outputs.unit)[1] == "rad"


def _bounds_of(r: Validation) -> tuple[Matrix, Matrix] | None:
    if not np.isfinite(r.lower).any():
        return None
    return drawable(r, r.lower), drawable(r, r.upper)
