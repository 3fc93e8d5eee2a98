"""The main job, end to end: from a recording to a verified closed loop over FMUs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from softneck.core import OutputFileError, SettingsError, atomic_write
from softneck.cosim import Result
from softneck.identification import Model, Validation
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plots import neck_view, page, write_page
from softneck.signals import write_recording

from ._closing import DemoDesign, close_loops, design
from ._demo_page import sections, verdict, words
from ._experiments import Experiments, Tell, ValidationPair, identify, judge, on_rough, record_experiments
from ._packaging import PackagedFmu, package
from ._tables import demo_json, score_line

FULL_DURATION = 200.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSettings:
    """How `softneck demo` is run: length of the experiment, training, folder.

    Attributes:
        out: folder for recordings, models, FMUs, loops, results and the report.
        duration: length of the Eq. 22 experiment [s]; the paper's is 200.
        iterations: of the network's training, for each axis.
        seed: of the network's start.
        compare_rows: samples of each FMU's free run.
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
        """Return the short form: 80 s of experiment and less training."""
        return cls(out=out, duration=80.0, iterations=10, compare_rows=300)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Demo:
    """All that the demo found; `rough` has the free runs of what was trained anew on the preset `rough`."""

    settings: DemoSettings
    experiments: Experiments
    models: Mapping[str, Model]
    judged: Mapping[tuple[str, str], ValidationPair]
    rough: Mapping[tuple[str, str], Validation]
    packaged: Mapping[str, PackagedFmu]
    designed: DemoDesign
    loops: Mapping[str, Result]
    seconds: float

    @property
    def holds(self) -> bool:
        """Whether every FMU equals its model and every limit of every loop holds."""
        return all(item.equal for item in self.packaged.values()) and all(r.holds for r in self.loops.values())

    def as_dict(self) -> dict:
        """Return the demo's JSON."""
        return demo_json(self.judged, self.rough, self.packaged, self.loops) | {
            "holds": self.holds,
            "experiment_s": self.settings.duration,
            "shortened": self.settings.duration < FULL_DURATION,
            "report": str(self.settings.out / "report.html"),
        }


def run_demo(settings: DemoSettings, *, tell: Tell) -> Demo:
    """Run the demo, from experiment to closed loop, and write everything to `settings.out`.

    Args:
        settings: what to do.
        tell: announces a stage and returns its progress callback.

    Raises:
        OutputFileError: the folder cannot be written.
    """
    begin = time.monotonic()
    out = settings.out
    if out.exists() and not out.is_dir():
        raise OutputFileError(f"{out}: is a file; name a folder.")
    neck = NeckParameters.paper()
    experiments = record_experiments(neck, duration=settings.duration, tell=tell)
    _write_recordings(out / "recordings", experiments)
    models = identify(experiments.identification, iterations=settings.iterations, seed=settings.seed, tell=tell)
    for name, model in models.items():
        model.save(out / "models" / f"{name}.npz", force=True)
    judged = judge(models, experiments, tell=tell)
    rough = on_rough(duration=settings.duration, tell=tell)
    plants = {**models, "virtual_neck": VirtualNeck(neck)}
    compared = experiments.tests["rotation"].rows(0, settings.compare_rows)
    scores = {name: score_line(judged, name) for name in models}
    packaged = package(plants, out / "fmus", compared, scores=scores, tell=tell)
    designed = design(models["rls"], out / "fmus")
    designed.controller.save(out / "models" / "pi.npz", force=True)
    designed.observer.save(out / "models" / "kalman.npz", force=True)
    loops = close_loops(out / "loops", sample_time=models["rls"].sample_time, tell=tell)
    for name, result in loops.items():
        recording = result.recording()
        write_recording(out / "results" / f"{name}.csv", recording, force=True)
        write_page(
            out / "results" / f"{name}_3d.html",
            neck_view(recording, title=f"The neck in the loop {words(name)}"),
            force=True,
        )
    demo = Demo(
        settings=settings,
        experiments=experiments,
        models=models,
        judged=judged,
        rough=rough,
        packaged=packaged,
        designed=designed,
        loops=loops,
        seconds=0.0,
    )
    _write_results(demo, tell)
    return replace(demo, seconds=time.monotonic() - begin)


def _write_recordings(folder: Path, experiments: Experiments) -> None:
    everything = {"identification": experiments.identification, **experiments.judged}
    for name, recording in everything.items():
        write_recording(folder / f"{name}.csv", recording, force=True)


def _write_results(demo: Demo, tell: Tell) -> None:
    tell("write the report")
    out = demo.settings.out
    with atomic_write(out / "results" / "summary.json", force=True) as temporary:
        temporary.write_text(json.dumps(demo.as_dict(), indent=2) + "\n", encoding="utf-8")
    sentence, holds = verdict(demo.packaged, demo.loops)
    html = page(
        "From a recording to a verified closed loop",
        sections(
            experiments=demo.experiments,
            models=demo.models,
            judged=demo.judged,
            rough=demo.rough,
            packaged=demo.packaged,
            designed=demo.designed,
            loops=demo.loops,
            shortened=demo.settings.duration < FULL_DURATION,
        ),
        verdict=sentence,
        holds=holds,
        footer="Written by softneck demo.",
    )
    write_page(out / "report.html", html, force=True)
