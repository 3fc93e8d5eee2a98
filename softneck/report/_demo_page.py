"""The demo's report: the experiment, each validation, the FMUs, the loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softneck.cosim import Result
from softneck.identification import INFINITE, Model, Validation
from softneck.plots import Chart, Section, Table
from softneck.plots._charts import loop_chart, recording_chart, validation_chart
from softneck.signals import Recording

from ._closing import DemoDesign, limits_of
from ._experiments import Experiments, ValidationPair
from ._packaging import PackagedFmu
from ._tables import FIT_HEAD, FIT_NOTE, fit_rows, fmu_rows, loop_rows

_PARTS = "Plant, observer and controller are FMUs in fmpy; the plant is the virtual neck with its inclinometer."
# Of the tests, the one whose free runs stand beside the table: no model was trained on anything like it.
_SHOWN = "rotation"
_TITLES = {
    "identification": "Identification: Eq. 22 with Table 2, the part that models are trained on",
    "validation": "Validation: the rest of Eq. 22",
    "steps": "Test 1: steps of 8 s, one tendon after the other",
    "sine": "Test 2: sine of rising frequency",
    "rotation": "Test 3: rotation",
}


def sections(
    *,
    experiments: Experiments,
    models: Mapping[str, Model],
    judged: Mapping[tuple[str, str], ValidationPair],
    rough: Mapping[tuple[str, str], Validation],
    packaged: Mapping[str, PackagedFmu],
    designed: DemoDesign,
    loops: Mapping[str, Result],
    shortened: bool,
) -> Sequence[Section]:
    """Return the report's sections."""
    first, *others = loops
    return [
        _overview(loops, first, packaged),
        _fits(judged, rough, models, shortened=shortened),
        *(_validation_section(data, judged, models) for data in experiments.judged if data != _SHOWN),
        *(_loop_section(name, loops[name]) for name in others),
        _design_section(designed),
        _model_section(models),
        _experiment_section(experiments),
    ]


def verdict(packaged: Mapping[str, PackagedFmu], loops: Mapping[str, Result]) -> tuple[str, bool]:
    """Return one sentence on all that had to hold, and whether it does."""
    rows = limits_of(loops)
    held, equal = sum(bool(row["holds"]) for _, row in rows), sum(item.equal for item in packaged.values())
    holds = held == len(rows) and equal == len(packaged)
    said = (
        f"{held} of {len(rows)} limits hold in {len(loops)} closed loops over FMUs, and {equal} of {len(packaged)} "
        "FMUs of plants compute what their Python models do."
    )
    return f"{'It works' if holds else 'Not all holds'}: {said}", holds


def _overview(loops: Mapping[str, Result], first: str, packaged: Mapping[str, PackagedFmu]) -> Section:
    tables = [
        Table("Limits of the closed loops", *loop_rows(loops)),
        Table("FMUs in fmpy against the Python models, free run", *fmu_rows(packaged)),
    ]
    return Section("Closed loop", charts=[_loop(first, loops[first])], tables=tables, method=[_PARTS])


def _fits(
    judged: Mapping[tuple[str, str], ValidationPair],
    rough: Mapping[tuple[str, str], Validation],
    models: Mapping[str, Model],
    *,
    shortened: bool,
) -> Section:
    method = [FIT_NOTE]
    if shortened:
        method.insert(0, "This is the quick form: the experiment is shorter than the paper's and the training less.")
    return Section(
        "Models", charts=_validation_section(_SHOWN, judged, models).charts[:1], method=method,
        tables=[Table("Models, ours beside the paper's", FIT_HEAD, fit_rows(judged, rough))],
    )  # fmt: skip


def _experiment_section(experiments: Experiments) -> Section:
    recordings = {"identification": experiments.identification, **experiments.judged}
    return Section("Experiment", charts=[_chart(recording, _TITLES[name]) for name, recording in recordings.items()])


def _chart(recording: Recording, title: str) -> Chart:
    return recording_chart(recording.time, recording.set_points, recording.outputs, title, run=recording.run)


def _model_section(models: Mapping[str, Model]) -> Section:
    rows = [[name, line] for name, model in models.items() for line in model.summary().splitlines()[1:]]
    return Section(
        "What was identified", tables=[Table("Models and their findings", ["model", "finding"], rows, text=2)]
    )


def _validation_section(
    data: str, judged: Mapping[tuple[str, str], ValidationPair], models: Mapping[str, Model]
) -> Section:
    results = {name: judged[name, data].free for name in models}
    first = next(iter(results.values()))
    free = {name: r.free_run if r.fits[INFINITE]["pitch"] is not None else np.full_like(r.free_run, np.nan)
            for name, r in results.items()}  # fmt: skip
    one = {name: r.one_step for name, r in results.items()}
    charts = [
        validation_chart(first.time, first.measured, free, f"Free run on {data}, from set-points alone"),
        validation_chart(first.time, first.measured, one, f"One step ahead on {data}"),
    ]
    return Section(f"Models on {data}", charts=charts)


def _design_section(designed: DemoDesign) -> Section:
    rows = [["controller", line] for line in designed.controller.summary().splitlines()]
    rows += [["observer", line] for line in designed.observer.summary().splitlines()]
    words = ["Both were designed on the identified linear model and run below against the virtual neck, another plant."]
    return Section(
        "Design", text=words, tables=[Table("Controller and Kalman filter", ["part", "finding"], rows, text=2)]
    )


def _loop_section(name: str, result: Result) -> Section:
    return Section(f"Closed loop: {words(name)}", charts=[_loop(name, result)])


def _loop(name: str, result: Result) -> Chart:
    title = f"{words(name).capitalize()} of the virtual neck"
    return loop_chart(result.signals.time, result.signals.signals, title, limits=result.bounds)


def words(name: str) -> str:
    """Return the name of a loop's file as words."""
    return name.replace("_", " ")
