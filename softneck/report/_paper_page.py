"""The page of `softneck reproduce-paper`: tables first, then the figures by their numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from softneck.identification import INFINITE, Model, continuous_parameters
from softneck.plots import BLUE, ORANGE, Chart, Curve, Panel, Section, Table, page, recording_chart, validation_chart
from softneck.signals import Recording, concatenate, redefine

from ._packaging import TESTS
from ._reproduce import AXES, LINEAR, NAMES, PAPER_HEAD, PAPER_NOTE, Entry, Reproduction, paper_entries

_PLANT = (
    "The plant is a virtual neck (preset `paper`), not the paper's hardware. What could be the plant's shows in the "
    "column other necks: the same estimators on the presets rough and lab and on necks drawn around paper."
)
LINEAR_HEAD = ["axis", "paper (Eq. 31)", "ours", "static gain: paper", "static gain: ours"]


def paper_page(found: Reproduction) -> str:
    """Return the HTML of a reproduction, self-contained."""
    rows = paper_entries(found)
    tables = [Table(title, PAPER_HEAD, [row.row() for row in part], text=3) for title, part in grouped(rows).items()]
    tables.append(Table("Eq. 31: the linear model, in deg", LINEAR_HEAD, linear_rows(found)))
    figures = paper_charts(found)
    shown = figures.pop(_FIRST)
    sections = [Section("Tables 3 and 4, section 7.4", charts=[shown], tables=tables, method=[_PLANT, PAPER_NOTE])]
    sections.append(Section("Figures", charts=list(figures.values())))
    return page(
        "The paper, reproduced on a virtual neck", sections, verdict=_verdict(found),
        footer="Written by softneck reproduce-paper.",
    )  # fmt: skip


def _verdict(found: Reproduction) -> str:
    """Return in a sentence which model is best where the paper's section 7.4 judges: free run on the tests."""
    least = {
        model: min(
            -np.inf if fit is None else fit
            for (name, _), pair in found.judged.items() if name == model
            for fit in pair.free.fits[INFINITE].values()
        )
        for model in found.models
    }  # fmt: skip
    best = max(least, key=lambda name: least[name])
    worst = ", ".join(
        f"{name} {'diverges' if np.isneginf(fit) else f'{fit:.1f} %'}" for name, fit in least.items() if name != best
    )
    return (
        f"Run free from set-points alone, {best} is the safest of the paper's models on the virtual neck: its worst "
        f"fit on any test is {least[best]:.1f} % (the others' worst: {worst})."
    )


def grouped(rows: list[Entry]) -> dict[str, list[Entry]]:
    """Return the entries of Table 3, Table 4 and section 7.4, each under its title."""
    titles = {
        "Table 3. Fitness of models on the validation data": "Table 3",
        "Table 4. Fitness on the three tests": "Table 4",
        "Section 7.4. Prediction and simulation": "section 7.4",
    }
    return {title: [row for row in rows if row.where.startswith(word)] for title, word in titles.items()}


def linear_facts(found: Reproduction) -> list[dict[str, Any]]:
    """Return gain K [deg/(rad s)], pole [1/s] and dead time [s] of each axis, the paper's (Eq. 31) and ours."""
    model = found.models["rls"]
    facts = []
    for axis, name in enumerate(AXES):
        ours = continuous_parameters(model.sample_time, model.arrays, axis)
        mine = None if ours is None else {"K": float(np.degrees(ours[0])), "p": ours[1], "L": ours[2]}
        facts.append({"axis": name, "paper": dict(zip("KpL", LINEAR[name], strict=True)), "ours": mine})
    return facts


def linear_rows(found: Reproduction) -> list[list[str]]:
    """Return the same as cells under `LINEAR_HEAD`."""
    rows = []
    for fact in linear_facts(found):
        pair = [fact["paper"], fact["ours"]]
        texts = ["-" if g is None else f"exp(-{g['L']:.2f} s) {g['K']:.2f}/(s + {g['p']:.3f})" for g in pair]
        gains = ["-" if g is None else f"{g['K'] / g['p']:.2f}" for g in pair]
        rows.append([fact["axis"], *texts, *gains])
    return rows


# Measured with the free runs of all models: the paper's section 7.4.
_FIRST = "20 and 21"
# [s] of the data that Figures 5 and 7 show: they plot a part.
_EXCERPT = (20.0, 60.0)
_TITLES = {"steps": "Test 1", "sine": "Test 2", "rotation": "Test 3"}


def paper_charts(found: Reproduction) -> dict[str, Chart]:
    """Return Figures 4 to 23 of the paper by their numbers, from our data, pitch and roll in one chart."""
    experiments, tests = found.experiments, found.experiments.tests
    whole = concatenate([experiments.identification, experiments.validation])
    charts = {
        "4": recording_chart(whole, "Figure 4. Input and output signals"),
        "5": _redefined(experiments.identification),
        "6": _step_responses(found.models["rls"]),
        "7": _linear_excerpt(found),
        "8": recording_chart(experiments.validation, "Figure 8. Signals of the validation"),
        "9 and 10": _outputs("9 and 10. Validation", found, "validation"),
    }
    for test, first in zip(TESTS, (11, 14, 17), strict=True):
        charts[f"{first}"] = recording_chart(tests[test], f"Figure {first}. {_TITLES[test]}, signals")
        numbers = f"{first + 1} and {first + 2}"
        charts[numbers] = _outputs(f"{numbers}. {_TITLES[test]}", found, test)
    for numbers, test in ((_FIRST, "rotation"), ("22 and 23", "sine")):
        title = f"{numbers}. {_TITLES[test]}, free run with measured motors"
        charts[numbers] = _outputs(title, found, test, measured_motors=True)
    return charts


def _redefined(recording: Recording) -> Chart:
    part = recording.rows(*(min(round(t / recording.sample_time), len(recording)) for t in _EXCERPT))
    inputs, panels = redefine(part.set_points), []
    for i, (axis, name) in enumerate(zip(AXES, ("theta_i", "phi_i"), strict=True)):
        gain = LINEAR[axis][0] / LINEAR[axis][1]
        asked = Curve(part.time, gain * inputs[:, i], f"{gain:.2f} {name} [rad]", ORANGE, "step")
        panels.append(Panel([asked, Curve(part.time, np.degrees(part.outputs[:, i]), axis, BLUE)], f"{axis} [deg]"))
    caption = "The redefined input is drawn times the paper's static gain, so that only dynamics and delay differ."
    return Chart("Figure 5. Redefined inputs and measured angles", panels, caption=caption)


def _step_responses(model: Model) -> Chart:
    import control

    t, panels = np.arange(0.0, 1.5, model.sample_time), []
    for axis in AXES:
        gain, pole, delay = LINEAR[axis]
        printed = np.where(t >= delay, gain / pole * (1.0 - np.exp(-pole * np.maximum(t - delay, 0.0))), 0.0)
        ours = np.asarray(control.step_response(model.tf(axis, angle_unit="deg"), t).outputs, dtype=np.float64)
        curves = [Curve(t, printed, "Eq. 31 as printed", "black", "dashed"), Curve(t, ours, "ours", ORANGE, "step")]
        panels.append(Panel(curves, f"{axis} [deg]"))
    return Chart("Figure 6. Response to a unit step of the redefined input", panels)


def _linear_excerpt(found: Reproduction) -> Chart:
    result = found.judged["rls", "validation"].free
    part = slice(0, round((_EXCERPT[1] - _EXCERPT[0]) / found.models["rls"].sample_time))
    predictions = {"RLS, free run": result.free_run[part]}
    return validation_chart(
        result.time[part], result.measured[part], predictions, "Figure 7. Validation of the linear models"
    )


def _outputs(title: str, found: Reproduction, data: str, *, measured_motors: bool = False) -> Chart:
    """Draw all three models as the paper does: SM and NN one step ahead and RLS free, or all in free run."""
    first, predictions = found.judged["nlsm", data].free, {}
    for model, name in NAMES.items():
        pair = found.judged[model, data]
        free = pair.measured if measured_motors else pair.free
        predictions[name] = free.free_run if measured_motors or model == "rls" else free.one_step
    caption = "SM and NN one step ahead (Fig. 3a), RLS in free run, as in the paper."
    if measured_motors:
        caption = "Fig. 3b: no measured output stands in the regressor; the motor positions are measured."
    return validation_chart(first.time, first.measured, predictions, f"Figures {title}", caption=caption)
