"""The demo: from a recording over models, FMUs and a controller to a verified closed loop over FMUs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from softneck.core import OutputFileError, SettingsError, write_text
from softneck.cosim import Result
from softneck.identification import INFINITE, Model
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plots import Chart, Section, Table, cell, loop_chart, page, recording_chart, validation_chart, write_page
from softneck.signals import write_recording

from ._demo_steps import (
    TOLERANCE,
    DemoDesign,
    Experiments,
    PackagedFmu,
    Tell,
    ValidationPair,
    close_loops,
    design,
    identify,
    judge,
    limits_of,
    package,
    record_experiments,
)
from ._reproduce import FREE_RUN, FREE_RUN_MEASURED, ONE_STEP

FULL_DURATION = 200.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSettings:
    """Settings of `softneck demo`.

    Attributes:
        out: folder for recordings, models, FMUs, loops, results and the report.
        duration: of the Eq. 22 experiment [s]; the paper's is 200.
        iterations: of the network's training, for each axis.
        compare_rows: samples in the comparison of each FMU.
    """

    out: Path
    duration: float = FULL_DURATION
    iterations: int = 30
    seed: int = 0
    compare_rows: int = 1500

    def __post_init__(self) -> None:
        if self.duration < 40.0:
            raise SettingsError(f"`duration` must be at least 40 s for the network's weights; got {self.duration:g}.")

    @classmethod
    def quick(cls, out: Path) -> DemoSettings:
        """Return the quick settings: 80 s of experiment and less training."""
        return cls(out=out, duration=80.0, iterations=10, compare_rows=300)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Demo:
    """Results of the demo."""

    settings: DemoSettings
    experiments: Experiments
    models: Mapping[str, Model]
    judged: Mapping[tuple[str, str], ValidationPair]
    packaged: Mapping[str, PackagedFmu]
    designed: DemoDesign
    loops: Mapping[str, Result]
    seconds: float

    @property
    def holds(self) -> bool:
        """Whether every FMU equals its model and every loop keeps its limits."""
        return all(item.equal for item in self.packaged.values()) and all(r.holds for r in self.loops.values())

    def as_dict(self) -> dict:
        """Return the JSON values."""
        return {
            "models": [
                result.free.as_dict() | {"free_run_measured_motors": result.measured.fits[INFINITE]}
                for result in self.judged.values()
            ],
            "fmus": {
                name: {"fmu": str(item.path), "rows": item.rows, "max_difference": item.difference, "holds": item.equal}
                for name, item in self.packaged.items()
            },
            "loops": {name: result.report() for name, result in self.loops.items()},
            "holds": self.holds,
            "experiment_s": self.settings.duration,
            "shortened": self.settings.duration < FULL_DURATION,
            "report": str(self.settings.out / "report.html"),
        }


def run_demo(settings: DemoSettings, *, tell: Tell) -> Demo:
    """Run the demo, from experiment to closed loop, and write everything to `settings.out`.

    `tell` announces a stage and returns its progress callback.

    Raises:
        OutputFileError: the folder cannot be written.
    """
    begin = time.monotonic()
    out = settings.out
    if out.exists() and not out.is_dir():
        raise OutputFileError(f"{out}: is a file; name a folder.")
    neck = NeckParameters.paper()
    experiments = record_experiments(neck, duration=settings.duration, tell=tell)
    for name, recording in {"identification": experiments.identification, **experiments.judged}.items():
        write_recording(out / "recordings" / f"{name}.csv", recording, force=True)
    models = identify(experiments.identification, iterations=settings.iterations, seed=settings.seed, tell=tell)
    for name, model in models.items():
        model.save(out / "models" / f"{name}.npz", force=True)
    judged = judge(models, experiments, tell=tell)
    plants = {**models, "virtual_neck": VirtualNeck(neck)}
    compared = experiments.tests["rotation"].rows(0, settings.compare_rows)
    scores = dict.fromkeys(models, "simulation (free run) fit from set-points alone [%], pitch/roll")
    for (name, data), pair in judged.items():
        scores[name] += f"\n{data}: {cell(pair.free.fits[INFINITE], '.1f')}"
    packaged = package(plants, out / "fmus", compared, scores=scores, tell=tell)
    designed = design(models["rls"], out / "fmus")
    designed.controller.save(out / "models" / "pi.npz", force=True)
    designed.observer.save(out / "models" / "kalman.npz", force=True)
    loops = close_loops(out / "loops", sample_time=models["rls"].sample_time, tell=tell)
    for name, result in loops.items():
        write_recording(out / "results" / f"{name}.csv", result.recording(), force=True)
    demo = Demo(
        settings=settings, experiments=experiments, models=models, judged=judged, packaged=packaged,
        designed=designed, loops=loops, seconds=0.0,
    )  # fmt: skip
    _write_results(demo, tell)
    return replace(demo, seconds=time.monotonic() - begin)


def _write_results(demo: Demo, tell: Tell) -> None:
    tell("write the report")
    out = demo.settings.out
    write_text(out / "results" / "summary.json", json.dumps(demo.as_dict(), indent=2) + "\n", force=True)
    sentence, holds = verdict(demo.packaged, demo.loops)
    html = page(
        "From a recording to a verified closed loop", _sections(demo), verdict=sentence, holds=holds,
        footer="Written by softneck demo.",
    )  # fmt: skip
    write_page(out / "report.html", html, force=True)


Rows = list[list[str]]
FIT_HEAD = [
    "model on data", "persistence", "one step", "paper, one step", "simulation", "paper, simulation",
    "simulation, measured motors", "paper, same",
]  # fmt: skip
FIT_NOTE = (
    "Fit 100 (1 - |y - yhat| / |y - mean y|) in %, pitch/roll. Persistence repeats the last sample; a one-step fit is "
    "useful only above it. A simulation (free run) has only the set-points as input, as an FMU of the plant does. The "
    "paper's SM and NN figures of Tables 3 and 4 are one step ahead, its RLS figures simulations; its section 7.4 is "
    "simulation with measured motors. The paper's plant is the real neck, ours the virtual one. nlsm is set membership "
    "over the paper's Eq. 21. nlsm_residual, which the paper does not have, is set membership on the residual of the "
    "simulation of rls; it has no feedback, so it cannot drift."
)


def fit_rows(judged: Mapping[tuple[str, str], ValidationPair]) -> Rows:
    """Return one row for each model and recording."""
    rows = []
    for (model, data), result in judged.items():
        key = (model, data)
        rows.append(
            [
                f"{model} on {data}",
                cell(result.free.persistence["1"], ".1f"),
                cell(result.free.fits["1"], ".1f"),
                _paper_cell(ONE_STEP.get(key)),
                cell(result.free.fits[INFINITE], ".1f"),
                _paper_cell(FREE_RUN.get(key)),
                cell(result.measured.fits[INFINITE], ".1f"),
                _paper_cell(FREE_RUN_MEASURED.get(key)),
            ]
        )
    return rows


def _paper_cell(pair: tuple[float, float] | None) -> str:
    return "" if pair is None else cell(dict(enumerate(pair)), ".1f")


def fmu_rows(packaged: Mapping[str, PackagedFmu]) -> tuple[list[str], Rows]:
    """Return one row for each FMU with its difference from the Python model in simulation."""
    rows = [
        [name, item.path.name, str(item.rows), f"{item.difference:.1e}", "holds" if item.equal else "fails"]
        for name, item in packaged.items()
    ]
    return ["model", "FMU", "samples", "largest difference", f"at most {TOLERANCE:g}"], rows


def loop_rows(loops: Mapping[str, Result]) -> tuple[list[str], Rows]:
    """Return one row for each limit of each loop."""
    rows = [
        [
            f"{name}: {row['metric']}",
            cell(row["value"], ".3f"),
            f"{row['limit']:g}",
            "holds" if row["holds"] else "fails",
        ]
        for name, row in limits_of(loops)
    ]
    return ["loop and metric", "value", "limit", "verdict"], rows


_LOOP_NOTE = "Plant, observer and controller are FMUs in fmpy; the plant is the virtual neck with its inclinometer."
# The test whose simulations are beside the table: no model was trained on a similar signal.
_FIRST_TEST = "rotation"
_TITLES = {
    "identification": "Identification: Eq. 22 with Table 2, the part that models are trained on",
    "validation": "Validation: the rest of Eq. 22",
    "steps": "Test 1: steps of 8 s, one tendon after the other",
    "sine": "Test 2: sine of rising frequency",
    "rotation": "Test 3: rotation",
}


def _sections(demo: Demo) -> list[Section]:
    first, *others = demo.loops
    found = [[name, line] for name, model in demo.models.items() for line in model.summary().splitlines()[1:]]
    models = Table("Models and their findings", ["model", "finding"], found, text=2)
    recordings = {"identification": demo.experiments.identification, **demo.experiments.judged}
    return [
        _overview(demo, first),
        _fits(demo),
        *(_validation_section(data, demo) for data in demo.experiments.judged if data != _FIRST_TEST),
        *(Section(f"Closed loop: {name.replace('_', ' ')}", charts=[_loop(name, demo.loops[name])]) for name in others),
        _design_section(demo.designed),
        Section("Identified models", tables=[models]),
        Section("Experiment", charts=[recording_chart(item, _TITLES[name]) for name, item in recordings.items()]),
    ]


def verdict(packaged: Mapping[str, PackagedFmu], loops: Mapping[str, Result]) -> tuple[str, bool]:
    """Return a sentence on the limits and FMUs, and whether all of them hold."""
    rows = limits_of(loops)
    held, equal = sum(bool(row["holds"]) for _, row in rows), sum(item.equal for item in packaged.values())
    holds = held == len(rows) and equal == len(packaged)
    said = (
        f"{held} of {len(rows)} limits hold in {len(loops)} closed loops over FMUs, and {equal} of {len(packaged)} "
        "FMUs of plants compute what their Python models do."
    )
    return f"{'It works' if holds else 'Not all holds'}: {said}", holds


def _overview(demo: Demo, first: str) -> Section:
    tables = [
        Table("Limits of the closed loops", *loop_rows(demo.loops)),
        Table("FMUs in fmpy against the Python models, in simulation", *fmu_rows(demo.packaged)),
    ]
    return Section("Closed loop", charts=[_loop(first, demo.loops[first])], tables=tables, method=[_LOOP_NOTE])


def _fits(demo: Demo) -> Section:
    quick = "This is the quick form: the experiment is shorter than the paper's and the training less."
    method = [*([quick] if demo.settings.duration < FULL_DURATION else []), FIT_NOTE]
    table = Table("Models, ours beside the paper's", FIT_HEAD, fit_rows(demo.judged))
    return Section("Models", charts=_validation_section(_FIRST_TEST, demo).charts[:1], method=method, tables=[table])


def _validation_section(data: str, demo: Demo) -> Section:
    results = {name: demo.judged[name, data].free for name in demo.models}
    first = next(iter(results.values()))
    free = {name: r.free_run if r.fits[INFINITE]["pitch"] is not None else np.full_like(r.free_run, np.nan)
            for name, r in results.items()}  # fmt: skip
    one = {name: r.one_step for name, r in results.items()}
    charts = [
        validation_chart(first.time, first.measured, free, f"Simulation on {data}, from set-points alone"),
        validation_chart(first.time, first.measured, one, f"One step ahead on {data}"),
    ]
    return Section(f"Models on {data}", charts=charts)


def _design_section(designed: DemoDesign) -> Section:
    rows = [["controller", line] for line in designed.controller.summary().splitlines()]
    rows += [["observer", line] for line in designed.observer.summary().splitlines()]
    text = ["Both were designed on the identified linear model and simulated below with the virtual neck."]
    return Section(
        "Design", text=text, tables=[Table("Controller and Kalman filter", ["part", "finding"], rows, text=2)]
    )


def _loop(name: str, result: Result) -> Chart:
    title = f"{name.replace('_', ' ').capitalize()} of the virtual neck"
    return loop_chart(result.signals.time, result.signals.signals, title, limits=result.bounds)
