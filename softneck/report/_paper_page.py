"""The page of `softneck reproduce-paper`: tables first, then the figures by their numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from softneck.core import require_whole
from softneck.identification import INFINITE, Model
from softneck.identification.models._linear_systems import continuous_parameters
from softneck.plots import Chart, Curve, Level, Panel, Section, Table, page
from softneck.plots._style import BLUE, GREEN, GREY, MOTOR_COLOURS, ORANGE
from softneck.signals import Recording, redefine

from ._experiments import TESTS, Experiments
from ._paper_tables import AXES, LINEAR, NAMES, PAPER_HEAD, PAPER_NOTE, Entry, paper_entries
from ._reproduce import Reproduction

_PLANT = (
    "The plant is a virtual neck (preset `paper`), not the paper's hardware. What could be the plant's shows in the "
    "column other necks: the same estimators on the presets rough and lab and on necks drawn around paper."
)
# Measured with the free runs of all models: the paper's section 7.4.
_FIRST = 21
# Title of a section -> the numbers of its figures.
PARTS = {
    "The experiment (sections 3.1 and 4)": range(4, 8),
    "Validation (section 6)": range(8, 11),
    "Test 1: steps (section 7.1)": range(11, 14),
    "Test 2: sine of rising frequency (section 7.2)": range(14, 17),
    "Test 3: rotation (section 7.3)": range(17, 20),
    "Free run with measured motors (section 7.4)": range(20, 24),
}
LINEAR_HEAD = ["axis", "paper (Eq. 31)", "ours", "static gain: paper", "static gain: ours"]


def paper_page(found: Reproduction) -> str:
    """Return the HTML of a reproduction, self-contained."""
    rows = paper_entries(found)
    tables = [Table(title, PAPER_HEAD, [row.row() for row in part], text=3) for title, part in grouped(rows).items()]
    tables.append(Table("Eq. 31: the linear model, in deg", LINEAR_HEAD, linear_rows(found)))
    first = Section(
        "Tables 3 and 4, section 7.4", charts=[paper_chart(_FIRST, found)], tables=tables, method=[_PLANT, PAPER_NOTE]
    )
    sections = [first]
    for title, numbers in PARTS.items():
        sections.append(Section(title, charts=[paper_chart(number, found) for number in numbers if number != _FIRST]))
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


FIRST, LAST = 4, 23
_COLOURS = {"nlsm": BLUE, "nn": GREEN, "rls": ORANGE}
# [s] of the data that Figures 5 and 7 show: they plot a part.
_EXCERPT = (20.0, 60.0)
_TITLES = {"steps": "Test 1", "sine": "Test 2", "rotation": "Test 3"}
_INPUTS = ("theta_i", "phi_i")


def paper_chart(number: int, found: Reproduction) -> Chart:
    """Return a figure of the paper, drawn from our data; `softneck.plots.chart_figure` makes a matplotlib figure of it.

    Args:
        number: 4 to 23, as in the paper.
        found: what `reproduce` returned.

    Raises:
        SettingsError: no such figure, or one that shows no data.
    """
    require_whole("number", number, FIRST, LAST)
    return _makers()[number](found)


def _makers() -> Mapping[int, Callable[[Reproduction], Chart]]:
    makers: dict[int, Callable[[Reproduction], Chart]] = {
        4: lambda r: _data_set(r.experiments),
        5: lambda r: _redefined(r.experiments),
        6: lambda r: _step_responses(r.models["rls"]),
        7: _linear_excerpt,
        8: lambda r: _inputs(8, "Control signal for the validation", r.experiments.validation),
        9: lambda r: _outputs(9, r, "validation", 0, measured_motors=False),
        10: lambda r: _outputs(10, r, "validation", 1, measured_motors=False),
    }
    for test, first in zip(TESTS, (11, 14, 17), strict=True):
        makers[first] = lambda r, n=first, t=test: _inputs(n, f"{_TITLES[t]} input signal", r.experiments.tests[t])
        for axis in range(2):
            makers[first + 1 + axis] = lambda r, n=first + 1 + axis, t=test, a=axis: _outputs(
                n, r, t, a, measured_motors=False
            )
    for test, first in (("rotation", 20), ("sine", 22)):
        for axis in range(2):
            makers[first + axis] = lambda r, n=first + axis, t=test, a=axis: _outputs(n, r, t, a, measured_motors=True)
    return makers


def _data_set(experiments: Experiments) -> Chart:
    head, tail = experiments.identification, experiments.validation
    border = Level(float(tail.time[0]), label="validation from here", vertical=True)
    motors = [
        Curve(part.time, part.set_points[:, j], f"motor {j + 1}", MOTOR_COLOURS[j], "step", 0.9)
        for j in range(3)
        for part in (head, tail)
    ]
    angles = [
        Curve(part.time, np.degrees(part.outputs[:, axis]), AXES[axis], (BLUE, ORANGE)[axis], width=0.9)
        for axis in range(2)
        for part in (head, tail)
    ]
    panels = [Panel(motors, "set-point [rad]", levels=[border]), Panel(angles, "angle [deg]", levels=[border])]
    return Chart("Figure 4. Input and output signals", panels)


def _redefined(experiments: Experiments) -> Chart:
    part = _excerpt(experiments.identification)
    inputs = redefine(part.set_points)
    panels = []
    for axis in range(2):
        gain = LINEAR[AXES[axis]][0] / LINEAR[AXES[axis]][1]
        panels.append(
            Panel(
                [
                    Curve(part.time, gain * inputs[:, axis], f"{gain:.2f} {_INPUTS[axis]} [rad]", ORANGE, "step"),
                    Curve(part.time, np.degrees(part.outputs[:, axis]), AXES[axis], BLUE),
                ],
                f"{AXES[axis]} [deg]",
            )
        )
    caption = "The redefined input is drawn times the paper's static gain, so that only dynamics and delay differ."
    return Chart("Figure 5. Redefined inputs and measured angles", panels, caption=caption)


def _step_responses(model: Model) -> Chart:
    import control

    t = np.arange(0.0, 1.5, model.sample_time)
    panels = []
    for axis in AXES:
        gain, pole, delay = LINEAR[axis]
        printed = np.where(t >= delay, gain / pole * (1.0 - np.exp(-pole * np.maximum(t - delay, 0.0))), 0.0)
        response = control.step_response(model.tf(axis, angle_unit="deg"), t)
        ours = np.asarray(response.outputs, dtype=np.float64)
        panels.append(
            Panel(
                [
                    Curve(t, printed, "Eq. 31 as printed", "black", "dashed"),
                    Curve(t, ours, "ours", _COLOURS["rls"], "step"),
                ],
                f"{axis} [deg]",
            )
        )
    return Chart("Figure 6. Response to a unit step of the redefined input", panels)


def _linear_excerpt(found: Reproduction) -> Chart:
    panels = []
    for axis in range(2):
        result = found.judged["rls", "validation"].free
        part = slice(0, round((_EXCERPT[1] - _EXCERPT[0]) / found.models["rls"].sample_time))
        time = result.time[part]
        panels.append(
            Panel(
                [
                    Curve(time, np.degrees(result.measured[part, axis]), "measured", "black", width=1.2),
                    Curve(time, np.degrees(result.free_run[part, axis]), "RLS, free run", _COLOURS["rls"]),
                ],
                f"{AXES[axis]} [deg]",
            )
        )
    return Chart("Figure 7. Validation of the linear models", panels)


def _inputs(number: int, title: str, recording: Recording) -> Chart:
    curves = [
        Curve(recording.time, recording.set_points[:, j], f"motor {j + 1}", MOTOR_COLOURS[j], "step") for j in range(3)
    ]
    return Chart(f"Figure {number}. {title}", [Panel(curves, "set-point [rad]")], row_height=3.0)


def _outputs(number: int, found: Reproduction, data: str, axis: int, *, measured_motors: bool) -> Chart:
    """Draw all three models as the paper does: SM and NN one step ahead and RLS free, or all in free run."""
    first = found.judged["nlsm", data].free
    curves = [Curve(first.time, np.degrees(first.measured[:, axis]), "measured", "black", width=1.3)]
    errors: list[Curve] = []
    for model, name in NAMES.items():
        result = found.judged[model, data]
        values = _shown(model, result.measured.free_run, result.free.free_run, result.free.one_step, measured_motors)
        colour = _COLOURS[model]
        curves.append(Curve(first.time, np.degrees(values[:, axis]), name, colour, width=0.9))
        error = np.degrees(first.measured[:, axis] - values[:, axis])
        errors.append(Curve(first.time, error, name, colour, width=0.8))
    what = f"{'Validation' if data == 'validation' else _TITLES[data]}, {AXES[axis]}"
    if measured_motors:
        what += ", free run with measured motors"
        caption = "Fig. 3b: no measured output stands in the regressor; the motor positions are measured."
    else:
        caption = "SM and NN one step ahead (Fig. 3a), RLS in free run, as in the paper."
    panels = [
        Panel(curves, f"{AXES[axis]} [deg]"),
        Panel(errors, "error [deg]", levels=[Level(0.0, colour=GREY, dashed=False)], legend=False),
    ]
    return Chart(f"Figure {number}. {what}", panels, caption=caption)


def _shown(
    model: str, with_motors: np.ndarray, free: np.ndarray, one_step: np.ndarray, measured_motors: bool
) -> np.ndarray:
    if measured_motors:
        return with_motors
    return free if model == "rls" else one_step


def _excerpt(recording: Recording) -> Recording:
    inside = np.flatnonzero((recording.time >= _EXCERPT[0]) & (recording.time < _EXCERPT[1]))
    return recording.rows(int(inside[0]), int(inside[-1]) + 1) if inside.size > 1 else recording
