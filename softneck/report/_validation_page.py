"""The page of `softneck validate`: fits, then every model beside what was measured, its errors and residual tests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import Matrix, to_si
from softneck.identification import INFINITE, Validation
from softneck.plots import Chart, Section, Table, page
from softneck.plots._charts import residual_chart, validation_chart

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
_HEAD = [
    "model on data", "samples ahead", "persistence", "best linear", "model", "95 % interval", "rms [{unit}]",
    "worst [{unit}]", "R2",
]  # fmt: skip
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
    sections = [_overview(results, together or [_curves(results[0])])]
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
        how = "free run" if ahead == INFINITE else f"{ahead} samples ahead"
        diverged = [Path(r.model).stem for r in rivals if r.diverged is not None]
        said.append(
            f"On {Path(data).stem} {Path(best.model).stem} fits {how} {fits}"
            + (f" (best of {len(rivals)} models)" if len(rivals) > 1 else "")
            + (f"; diverged: {', '.join(diverged)}" if diverged else "")
        )
    return "; ".join(said) + "."


def _last(r: Validation) -> dict[str, float | None]:
    return r.fits[list(r.fits)[-1]]


def _overview(results: Sequence[Validation], charts: Sequence[Chart]) -> Section:
    rows, outputs = [], results[0].robot.outputs
    names, unit = "/".join(outputs.names), outputs.display_unit
    for r in results:
        for h in r.fits:
            tables = (r.persistence, r.best_linear, r.fits, r.intervals)
            rows.append(
                [
                    _name(r),
                    "free run" if h == INFINITE else h,
                    *(_cell(table.get(h, {}), 1) for table in tables),
                    _cell(r.rmse_deg[h], 2),
                    _cell(r.worst_deg[h], 1),
                    _cell(r.r2[h], 3),
                ]
            )
    fits = Table(f"Fit in %, errors in {unit}, {names}", [title.format(unit=unit) for title in _HEAD], rows)
    counts = [[_name(r), str(r.rows_scored), str(r.rows_left_out), *_verdicts(r)] for r in results]
    head = ["model on data", "rows judged", "left out", "one-step errors white", "follow no input", "free run diverged"]
    return Section(
        "Fits", charts=charts, tables=[fits, Table("What was judged", head, counts)],
        method=[VALIDATION_NOTE.format(outputs=names)],
    )  # fmt: skip


def _verdicts(r: Validation) -> list[str]:
    tested = not np.isnan(r.residual_tests.p_value).any()
    words = ["-" if not tested else "holds" if verdict else "fails" for verdict in (r.white, r.uncorrelated)]
    return [*words, "no" if r.diverged is None else f"at {r.diverged:.2f} s"]


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


def _curves(r: Validation) -> Chart:
    bounds = _bounds_of(r)
    caption = _ERROR + (" The band holds the model's bounds of its free run." if bounds else "")
    return validation_chart(
        r.time, r.measured, _predictions(r), f"{_name(r)}: measured and predicted", bounds=bounds, run=r.run,
        caption=caption, robot=r.robot,
    )  # fmt: skip


def _section(r: Validation, *, drawn: bool) -> Section:
    """Return all on one result; its curves unless they are `drawn` already."""
    charts = [*([] if drawn else [_curves(r)]), _residuals(r)]
    return Section(_name(r), text=_remarks(r), tables=_run_tables(r), charts=charts)


def _residuals(r: Validation) -> Chart:
    tests = r.residual_tests
    return residual_chart(
        (tests.lags, tests.autocorrelation, tests.bound),
        (tests.cross_lags, tests.cross_correlation, tests.cross_bound),
        "Residual tests of the one-step errors",
        caption=_RESIDUALS,
        robot=r.robot,
    )


def _remarks(r: Validation) -> list[str]:
    p_values = "/".join(f"{p:.2g}" for p in r.residual_tests.p_value)
    words = ["There are too few one-step errors to test whether they are white."]
    if not np.isnan(r.residual_tests.p_value).any():
        words = [
            f"One step ahead the errors are {'white' if r.white else 'not white'} (portmanteau p {p_values}) and "
            f"{'follow no set-point' if r.uncorrelated else 'follow the set-points'} (99 %)."
        ]
    if r.diverged is not None:
        far = "half a turn" if _turns(r) else f"{_DRAWN_TIMES:g} times what was measured"
        words.append(f"The free run diverged at {r.diverged:.2f} s and is not drawn beyond {far}.")
    if any(fit is not None for fit in r.noise_ceiling.values()):
        ceiling = _cell(r.noise_ceiling, 1)
        words.append(f"Repeated set-points say that a perfect model would fit {ceiling} % (noise ceiling).")
    if r.coverage_pct is not None and r.mean_width_deg is not None:
        words.append(
            f"The bounds of the free run hold {_cell(r.coverage_pct, 1)} % of the samples and are "
            f"{_cell(r.mean_width_deg, 1)} {r.robot.outputs.display_unit} wide in the mean."
        )
    if r.outside_pct is not None:
        words.append(f"{_cell(r.outside_pct, 1)} % of the samples lie outside what the model has seen.")
    if r.validity is not None:
        v = r.validity
        words.append(
            f"Validity is {v['mean']:.2f} in the mean, {v['least']:.2f} at least; {100 * v['held']:.0f} % of the "
            f"samples were within the tolerance. Brier score {v['brier']:.3f} (0 is best); that share alone gets "
            f"{v['brier_base_rate']:.3f}."
        )
    words += [f"{said[0].upper()}{said[1:]}." for said in r.bounds_remarks]
    return words


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
        return f"{value:.{digits}f}"
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
