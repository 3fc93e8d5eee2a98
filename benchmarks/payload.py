"""Print what a model of several payloads, and an observer over it, are worth on foreign necks.

`python benchmarks/payload.py [--necks NECK...]`

`several` is a `greybox` of 0, 0.5 and 1 kg, `own` one of the payload that
it is judged on, `none` one of 0 kg, each of 100 s of Eq. 22 a payload; judged in free run on the 40 s that follow. The
observers see a poor sensor (noise of 0.25 deg, 20 % of the samples lost, two blackouts of a second) on three motions at
0, 0.32, 0.75 and 1 kg: over `none`, over `several`, and over `several` whose payload is told. Nothing is chosen here.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import KalmanSettings
from softneck.identification import GreyBox, Model
from softneck.signals import Recording, signal
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.necks import NECKS, ForeignNeck, record

TRAINED, UNSEEN, LOADS = (0.0, 0.5, 1.0), (0.25, 0.75), (0.0, 0.32, 0.75, 1.0)
ROWS, NOISE = 5000, np.radians(0.25)


def log(neck: str, payload: float, motion: str = "eq22", seed: int = 1) -> Recording:
    """Return a recording that says its payload."""
    run = record(signal(motion), ForeignNeck(name=neck, seed=1), seed=seed, payload=payload)
    return run.with_channels(payload=np.full(len(run), payload))


def fit(model: Model, run: Recording) -> Vector:
    """Return the fit of the free run [%] of each output."""
    y, said = run.outputs[50:], model.simulate(run)[50:, :2]
    return 100.0 * (1.0 - np.linalg.norm(y - said, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))


def told(model: Model, payload: float) -> Model:
    """Return the model as if its payload were this one alone."""
    lines = model.arrays["payload"][2:]
    return replace(model, arrays={**model.arrays, "payload": np.concatenate([[payload, payload], lines])})


def spoiled(run: Recording, seed: int) -> Recording:
    """Return what a poor sensor says of a run."""
    rng = np.random.default_rng(seed)
    z = run.outputs + NOISE * rng.standard_normal(run.outputs.shape)
    z[rng.random(len(z)) < 0.2] = z[300:350] = z[700:750] = np.nan
    return run.with_channels(pitch=z[:, 0], roll=z[:, 1])


def error(model: Model, runs: list[Recording]) -> float:
    """Return the rms error [deg] of an observer over `model`."""
    observer = KalmanSettings(sensor_delay=0.0, measurement_noise_std=NOISE).design(model)
    missed: list[Matrix] = []
    for number, run in enumerate(runs):
        missed.append((observer.estimate(spoiled(run, number)).outputs - run.outputs)[100:])
    return float(np.degrees(np.sqrt(np.mean(np.concatenate(missed) ** 2))))


def models(neck: str) -> tuple[Model, Model]:
    """Print the free runs; return the models of none and of several payloads."""
    logs = {payload: log(neck, payload) for payload in (*TRAINED, *UNSEEN)}
    none = GreyBox().fit(logs[0.0].rows(0, ROWS))
    several = GreyBox().fit([logs[payload].rows(0, ROWS) for payload in TRAINED])
    for payload in sorted(logs):
        run = logs[payload].rows(ROWS, 7000)
        own = GreyBox().fit(logs[payload].rows(0, ROWS))
        cells = ["/".join(f"{value:.1f}" for value in fit(model, run)) for model in (none, several, own)]
        mark = "unseen" if payload in UNSEEN else ""
        print(f"{neck:18}{payload:5.2f} kg {mark:7}" + "".join(f"{cell:>16}" for cell in cells), flush=True)
    return none, several


def main() -> None:
    """Print the tables of each neck."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="*", default=["column", "spring", "foam"], choices=NECKS)
    asked = parser.parse_args()
    for neck in asked.necks:
        print(f"{neck + (' (held out)' if neck in HELD_OUT else ''):34}{'none':>16}{'several':>16}{'own':>16}")
        none, several = models(neck)
        print(f"{'observer, rms error [deg]':34}{'none':>16}{'estimated':>16}{'told':>16}")
        for payload in LOADS:
            runs = [log(neck, payload, motion, 5).rows(0, 2000) for motion in ("rotation", "steps", "eq22")]
            cells = [error(model, runs) for model in (none, several, told(several, payload))]
            print(f"{neck:18}{payload:5.2f} kg{'':8}" + "".join(f"{cell:16.2f}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
