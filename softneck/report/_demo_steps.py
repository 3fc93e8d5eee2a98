"""Steps of the demo and of the reproduction: experiments, models, validation, FMUs, and closed loops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from softneck.core import Matrix, Progress, write_text
from softneck.cosim import Result, load_loop, simulate, simulate_fmu
from softneck.design import LinearController, PiSettings
from softneck.estimation import KalmanObserver, KalmanSettings
from softneck.fmu import Buildable, build_fmu, fmu_info
from softneck.identification import INFINITE, Model, Network, Rls, SetMembership, Validation, validate
from softneck.loop import default_limits
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import Recording, signal

TESTS = ("steps", "sine", "rotation")
# Section 5: 7,000 of 10,000 samples for identification, the rest for validation.
TRAIN = 0.7
# Noise differs between experiments, but not between runs of the demo.
_SEEDS = {"eq22": 1, "steps": 2, "sine": 3, "rotation": 4}

Tell = Callable[[str], Progress]


@dataclass(frozen=True, slots=True, eq=False)
class Experiments:
    """Recordings: Eq. 22 split into its two parts, and the three tests."""

    identification: Recording
    validation: Recording
    tests: Mapping[str, Recording]

    @property
    def judged(self) -> dict[str, Recording]:
        """All recordings on which no model was trained, by the paper's names."""
        return {"validation": self.validation, **self.tests}


@dataclass(frozen=True, slots=True, eq=False)
class ValidationPair:
    """Validation of a model on a recording: from set-points alone, and with measured motors (paper, section 7.4)."""

    free: Validation
    measured: Validation


def record_experiments(neck: NeckParameters, *, duration: float, tell: Tell) -> Experiments:
    """Record Eq. 22 for `duration` [s] and the three tests on a virtual neck."""
    report = tell("record on the virtual neck")
    recordings: dict[str, Recording] = {}
    for number, name in enumerate(("eq22", *TESTS)):
        report(number / 4, name)
        length = duration if name == "eq22" else None
        recordings[name] = record(signal(name, duration=length), VirtualNeck(neck), seed=_SEEDS[name])
    head, tail = recordings.pop("eq22").split(TRAIN)
    return Experiments(head, tail, recordings)


def identify(recording: Recording, *, iterations: int, seed: int, tell: Tell) -> dict[str, Model]:
    """Identify the paper's three models from one recording, and set membership on the residual of rls."""
    estimators = {
        "rls": Rls(),
        "nlsm": SetMembership(form="paper_eq21"),
        "nlsm_residual": SetMembership(form="residual"),
        "nn": Network(iterations=iterations, seed=seed),
    }
    return {name: estimator.fit(recording, progress=tell(f"identify {name}")) for name, estimator in estimators.items()}


def judge(
    models: Mapping[str, Model], experiments: Experiments, *, tell: Tell
) -> dict[tuple[str, str], ValidationPair]:
    """Validate every model on every recording that it was not trained on."""
    report = tell("validate")
    judged: dict[tuple[str, str], ValidationPair] = {}
    pairs = [(model, data) for model in models for data in experiments.judged]
    for number, (name, data) in enumerate(pairs):
        report(number / len(pairs), f"{name} on {data}")
        recording = experiments.judged[data]
        free = validate(models[name], recording, names=(name, data), horizons=(1, INFINITE))
        measured = validate(models[name], recording, names=(name, data), horizons=(INFINITE,), motors="measured")
        judged[name, data] = ValidationPair(free, measured)
    return judged


# Rounding in another process accumulates in a simulation, but stays far below a micro-degree.
TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class PackagedFmu:
    """An FMU and its largest difference [SI] from the Python model in simulation, over all outputs and `rows`."""

    path: Path
    rows: int
    difference: float

    @property
    def equal(self) -> bool:
        """Whether the FMU equals its model."""
        return self.difference <= TOLERANCE


def package(
    things: Mapping[str, Buildable], folder: Path, recording: Recording, *, scores: Mapping[str, str], tell: Tell
) -> dict[str, PackagedFmu]:
    """Build an FMU of each plant and compare its simulation over `recording` with Python's."""
    report = tell("build FMUs and compare simulations")
    packaged: dict[str, PackagedFmu] = {}
    for number, (name, thing) in enumerate(things.items()):
        report(number / len(things), name)
        info = fmu_info(thing, scores=scores.get(name, ""), stop_time=30.0)
        path = build_fmu(thing.block(), folder / f"{name.title().replace('_', '')}.fmu", info=info, force=True)
        table = simulate_fmu(path, recording)
        difference = float(np.abs(table - python_free_run(thing.block(), recording)).max())
        packaged[name] = PackagedFmu(path, len(recording), difference)
    return packaged


def python_free_run(block: Block, recording: Recording) -> Matrix:
    """Return a plant's outputs (time, n_out) from rest, driven by a recording's set-points; row 0 is the start."""
    start = block.initial_state()
    inputs = np.tile([port.start for port in block.inputs], (len(recording), 1))
    inputs[:, :3] = recording.set_points
    _, outputs = block.run(start, inputs)
    return np.vstack([start.outputs, outputs[:-1]])


# 15 deg as in the lab's own tests.
_STEPS = {"pitch_step": (15.0, 0.0), "roll_step": (0.0, 15.0), "oblique_step": (10.6, 10.6)}

_PARTS = {
    "plant": {"fmu": "../fmus/VirtualNeck.fmu", "parameters": {"noise_seed": 5}},
    "observer": {"fmu": "../fmus/Kalman.fmu"},
    "controller": {"fmu": "../fmus/Pi.fmu"},
}


@dataclass(frozen=True, slots=True, eq=False)
class DemoDesign:
    """The controller and the observer of the demo."""

    controller: LinearController
    observer: KalmanObserver


def design(model: Model, fmus: Path) -> DemoDesign:
    """Design a controller and an observer on an identified linear model; write their FMUs to folder `fmus`."""
    controller = PiSettings().design(model)
    observer = KalmanSettings(sensor="paper").design(model)
    build_fmu(controller.block(), fmus / "Pi.fmu", info=fmu_info(controller), force=True)
    build_fmu(observer.block(), fmus / "Kalman.fmu", info=fmu_info(observer), force=True)
    return DemoDesign(controller, observer)


def close_loops(folder: Path, *, sample_time: float, tell: Tell) -> dict[str, Result]:
    """Write the loop files to `folder` and simulate them."""
    report = tell("close the loop over FMUs")
    results: dict[str, Result] = {}
    for number, (name, (pitch, roll)) in enumerate(_STEPS.items()):
        path = folder / f"{name}.toml"
        step = {"kind": "step", "pitch_deg": pitch, "roll_deg": roll, "at_s": 1.0}
        table = {"duration_s": 8.0, "sample_time_s": sample_time, **_PARTS, "reference": step}
        head = f"# Written by `softneck demo`; run it again with `softneck simulate {name}.toml`.\n"
        write_text(path, head + tomli_w.dumps({**table, "limits": _limits(pitch, roll)}), force=True)

        def progress(done: float, number: int = number, name: str = name) -> None:
            report((number + done) / len(_STEPS), name)

        results[name] = simulate(load_loop(path), report=progress)
    return results


def _limits(pitch: float, roll: float) -> dict[str, float]:
    # An axis without a step must stay in place.
    axes = {
        axis: default_limits.LOOP if size else {"rms_error_deg": 1.0}
        for axis, size in (("pitch", pitch), ("roll", roll))
    }
    return {f"{axis}.{metric}": limit for axis, limits in axes.items() for metric, limit in limits.items()}


def limits_of(results: Mapping[str, Result]) -> list[tuple[str, dict]]:
    """Return all limits of all loops, each with its loop's name."""
    return [(name, row) for name, result in results.items() for row in result.limits]
