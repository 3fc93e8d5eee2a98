"""Results of `softneck validate`: the table of fits, remarks, and the page that shows each model beside the data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softneck.core import Matrix, to_si
from softneck.identification import INFINITE, Validation
from softneck.plots import Chart, Section, Table, cell, page, residual_chart, validation_chart

from ._decisions import beats, fit_word, validation_decision

VALIDATION_NOTE = (
    "Fit is 100 (1 - |y - yhat| / |y - mean y|) in %, {outputs}. Persistence repeats the last sample; a one-step fit "
    "is useful only above it: the verdict says whether it beats, equals or misses persistence. A simulation is very "
    "good from 90 %, good from 80 %, fair from 70 %, poor from 30 %, else useless. Best linear is fitted on the judged "
    "rows themselves: no linear model of the set-points has a better simulation on them. A simulation (free run) has "
    "only the set-points as input (or the logged motors, if requested), as an FMU of the plant does. Rows that a model "
    "was trained on are left out."
)
_ERROR_NOTE = "Error is measured minus predicted; rows that are not scored or not recorded are not drawn."
_RESIDUAL_NOTE = (
    "A model without missing dynamics leaves white residuals that no set-point predicts: 99 of 100 bars are within the "
    "dashed bounds. A bar outside at a positive lag, at which the error follows the set-point, is a wrong gain or lag "
    "of the model. Slow or periodic set-points spread it over many lags, negative ones too. Set-points of a controller "
    "depend on the outputs and show at negative lags."
)
_FIT_COLUMNS = (
    "model on data", "output", "ahead", "persistence", "best linear", "model", "from", "to", "rms", "worst", "verdict",
)  # fmt: skip
# A simulation beyond half a turn, or of other outputs beyond this multiple of the measured range, is not drawn, so that
# the rest remains readable.
_MAX_RATIO = 10.0


def validation_page(results: Sequence[Validation]) -> str:
    """Return the HTML page of all results, with interactive charts; it opens with `validation_decision`.

    Models that were judged on the same rows first have one chart of all their simulations.
    """
    together, decision = _comparisons(results), validation_decision([r.as_dict() for r in results])
    note = VALIDATION_NOTE.format(outputs="/".join(results[0].robot.outputs.names))
    charts = together or [curves(results[0])]
    sections = [Section("Fits", charts=charts, tables=[fit_table(results)], method=[note])]
    sections += [_section(r, drawn=not together and r is results[0]) for r in results]
    return page("Validation", sections, verdict=decision, footer="Written by softneck validate.")


def fit_table(results: Sequence[Validation]) -> Table:
    """Return the fits [%], a row for each horizon and output, beside the baselines."""
    rows = []
    for r in results:
        for h, fits in r.fits.items():
            for axis, fit in fits.items():
                beside = [cell(table.get(h, {}).get(axis), "%") for table in (r.persistence, r.best_linear)]
                ends = r.intervals.get(h, {}).get(axis) or (None, None)
                errors = [cell(r.rmse_deg[h][axis], ".2f"), cell(r.worst_deg[h][axis], ".1f")]
                verdict = fit_word(fit) if h == INFINITE else beats(fit, r.persistence.get(h, {}).get(axis))
                rows.append([_name(r), axis, "simulation" if h == INFINITE else h, *beside, cell(fit, "%"),
                             *(cell(end, ".1f") for end in ends), *errors, verdict])  # fmt: skip
    caption = f"Fit in % (from, to: its 95 % interval), errors in {results[0].robot.outputs.display_unit}"
    return Table(caption, _FIT_COLUMNS, rows)


def _comparisons(results: Sequence[Validation]) -> list[Chart]:
    """Return a chart of the simulations of all models judged on the same rows, for each such group."""
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
                    first.time, first.measured, runs, f"Simulations on {data}", run=first.run, caption=_ERROR_NOTE,
                    robot=first.robot,
                )
            )  # fmt: skip
    return charts


def curves(r: Validation) -> Chart:
    """Return a chart of measured and predicted outputs, with the bounds of the simulation."""
    bounds = (drawable(r, r.lower), drawable(r, r.upper)) if np.isfinite(r.lower).any() else None
    predictions = {"one step": drawable(r, r.one_step)}
    if INFINITE in r.fits:
        predictions["simulation"] = drawable(r, r.free_run)
    caption = _ERROR_NOTE + (" The band shows the model's bounds in simulation." if bounds else "")
    return validation_chart(
        r.time, r.measured, predictions, f"{_name(r)}: measured and predicted", bounds=bounds, run=r.run,
        caption=caption, robot=r.robot,
    )  # fmt: skip


def _section(r: Validation, *, drawn: bool) -> Section:
    """Return the section of one result, with its curves unless `drawn`."""
    tests = r.residual_tests
    residuals = residual_chart(
        (tests.lags, tests.autocorrelation, tests.bound),
        (tests.cross_lags, tests.cross_correlation, tests.cross_bound),
        "Residual tests of the one-step errors", caption=_RESIDUAL_NOTE, robot=r.robot,
    )  # fmt: skip
    charts = [residuals] if drawn else [curves(r), residuals]
    text = [f"{said[0].upper()}{said[1:]}." for said in remarks(r)]
    return Section(_name(r), text=text, tables=_run_tables(r), charts=charts)


def remarks(r: Validation) -> list[str]:
    """Return remarks on a model and a recording, beside its fits."""
    lines = [f"{r.rows_scored} rows judged, {r.rows_left_out} left out as the model was trained on them"]
    lost = [entry for entry in r.per_run if entry["diverged"] is not None]
    lines += [f"the simulation of run {e['run']} diverged at {e['diverged']:.2f} s" for e in lost]
    if INFINITE in r.fits:
        lines.append(f"simulation {cell(r.cold_fits, '%')} % from the first row only (as an FMU starts)")
    lines.append(_residual_remark(r))
    if lost:
        return lines
    if r.coverage_pct is not None and r.mean_width_deg is not None:
        lines.append(
            f"bounds in simulation hold {cell(r.coverage_pct, '.1f')} % of the samples, "
            f"{cell(r.mean_width_deg, '.1f')} {r.robot.outputs.display_unit} wide"
        )
    if r.outside_pct is not None:
        lines.append(f"{cell(r.outside_pct, '.1f')} % of the samples are outside the training range")
    if r.validity is not None:
        v = r.validity
        lines.append(
            f"validity {v['mean']:.2f} in the mean, {v['least']:.2f} at least; {100 * v['held']:.0f} % of the "
            f"samples were within the tolerance (Brier score {v['brier']:.3f}, of that share alone "
            f"{v['brier_base_rate']:.3f})"
        )
    return [*lines, *r.bounds_remarks, *_calibrated_remarks(r)]


def _residual_remark(r: Validation) -> str:
    p_value = r.residual_tests.p_value
    if np.isnan(p_value).any():
        return "too few residuals for a test of whiteness"
    p_values = "/".join("<0.001" if p < 1e-3 else f"{p:.3f}" for p in p_value)
    own = "white" if r.white else "correlated with each other"
    inputs = "not correlated" if r.uncorrelated else "correlated"
    cause = "" if r.white and r.uncorrelated else ": the model misses dynamics"
    return f"the residuals are {own} (p {p_values}) and {inputs} with the inputs (99 %){cause}"


def _calibrated_remarks(r: Validation) -> list[str]:
    """Return the error bounds from whole records, or why there are none."""
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
        lines.append(found["reason"] if lines else f"no calibrated bounds: {found['reason']}")
    return lines


def _run_tables(r: Validation) -> list[Table]:
    """Return a table of the fits of each run, if there are several."""
    if len(r.per_run) < 2:
        return []
    head = ["run", "output", "from [s]", "rows", *("simulation" if h == INFINITE else f"{h} ahead" for h in r.fits)]
    rows = [
        [str(e["run"]), axis, f"{e['start_s']:.2f}", str(e["rows_scored"]),
         *(cell(e["fits"][h][axis], "%") for h in r.fits)]
        for e in r.per_run for axis in r.robot.outputs.names
    ]  # fmt: skip
    return [Table("Fit [%] of each run", head, rows)]


def _name(r: Validation) -> str:
    return f"{Path(r.model).stem} on {Path(r.data).stem}"


def drawable(r: Validation, values: Matrix) -> Matrix:
    """Replace diverged outputs by NaN."""
    most = r.robot.angle_limit
    if not np.isfinite(most):
        most = _MAX_RATIO * float(np.nanmax(np.abs(r.measured), initial=0.0))
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < most, values, np.nan)
