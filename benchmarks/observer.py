"""Print what the observer is worth against the true angles on foreign necks with a poor sensor, beside a peer.

`python benchmarks/observer.py [--seeds N] [--necks NECK...] [--grid | --unseen | --oracle | --causes]`

Noise of 0.25 deg, 20 % of the samples lost, 2 % outliers, a blackout of a second in each of four motions; every filter
sees the same. The model is an `oe` of 140 s of Eq. 22 with that noise. `no delay` and `default` (over 50 ms) are ours;
`greybox` is the default over that model of the same recording; `peer` is thirty lines of filterpy over the `oe` with
three samples of look-ahead. Nothing is chosen here: the two necks that are held out have lines
of their own; defaults are chosen by `leave_one_neck_out.py observer.*`.

`--grid`: of the defaults over `oe` and over `greybox` the rms error, the same told the sensor's noise, that of the best
of a grid of noise levels and sensor delays *on the very motions it is judged on*, and by how much both miss it.
`--unseen`: what `--data` makes of the filter over the `greybox` with 60 s of another motion that the model has not
seen, as the poor sensor logs it: error on the rows that it held out itself, of the defaults and of what it kept, then
against the truth. `--oracle`: the filter over the `greybox`; the same that knew at each sample, without noise, gaps or
outliers, what its model misses at the sensor's time; and the error left in the blackouts under the best constant
disturbance of each, in hindsight. `--causes`: the filter over the `greybox` of the neck as it is, and of the same neck
without one part of its physics, which says what the equations of `greybox` lack.
"""

from __future__ import annotations

import argparse
import math
from itertools import product
from typing import Any

import numpy as np

from softneck.core import Matrix
from softneck.estimation import KalmanSettings
from softneck.estimation._axis import axis_plant
from softneck.estimation._observer import AnyObserver, design_observer, fit_levels_and_delays
from softneck.identification import GreyBox, Model, OutputError
from softneck.runtime import Block
from softneck.signals import Recording, redefinition_matrix, signal
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.necks import NECKS, ForeignNeck
from tests.foreign_necks.spoiled import NOISE, Spoiled, errors_deg, filtered, logged, motions, moved, spoiled

AHEAD = 3  # samples; delay and lag of an ordinary inclinometer
MEASURED = (None, *np.radians((0.1, 0.25, 0.5)).tolist())
DELAYS = (0.0, 0.03, 0.04, 0.05, 0.06, 0.07)
# Of a filter over `oe`, and of one over `greybox`.
LEVELS = {
    "oe": {
        "model_noise_std": np.radians((0.05, 0.15, 0.5)).tolist(),
        "disturbance_noise_std": np.radians((0.3, 0.7, 1.0, 1.5, 2.0)).tolist(),
    },
    "greybox": {
        "rest_noise_std": np.radians((0.02, 0.1, 0.3)).tolist(),
        "motion_noise_ratio": (0.2, 0.35, 0.5, 0.7, 1.0, 1.4),
    },
}
UNSEEN_S, UNSEEN_SEED = 60.0, 77
# What is taken out of a neck, and the numbers that do so.
Changes = tuple[tuple[str, tuple[float, ...]], ...]
CAUSES: dict[str, dict[str, Changes]] = {
    "spring": {
        "hysteresis": (("hysteresis", (0.0, 0.0)),),
        "dead zone and play": (("dead_zone", (0.0, 0.5, 100.0)), ("backlash", (0.0, 0.4, 8.0))),
        "axes and tendons aside": (
            ("stiffness", (0.8, 0.8, 0.0)), ("angle", (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)),
            ("radius", (0.05, 0.05, 0.05)),
        ),
    },
    "foam": {
        "sheaths' friction": (("sheath", (0.0, 0.0008)),),
        "buckling": (("stiffness", (0.62, 0.25, 0.0, 12.0)),),
        "lobes, buckling, stiffening": (("stiffness", (0.62, 0.0, 0.0, 0.0)),),
    },
}  # fmt: skip


def peer(model: Model, run: Recording) -> Matrix:
    """Return the angles of a Kalman filter as one writes it with filterpy: model and a disturbance that walks."""
    from filterpy.kalman import KalmanFilter

    told = []
    for axis, u in zip(("pitch", "roll"), (redefinition_matrix() @ run.set_points.T)[:2], strict=True):
        plant = axis_plant(model, axis)
        A, b, c = plant.observable_form()
        n = len(A)
        kf: Any = KalmanFilter(dim_x=n + 1, dim_z=1, dim_u=1)
        kf.F = np.block([[A, np.zeros((n, 1))], [np.zeros((1, n)), np.ones((1, 1))]])
        kf.B, kf.H = np.append(b, 0.0)[:, None], np.append(c, 1.0)[None, :]
        kf.P, kf.Q, kf.R = 0.1 * np.eye(n + 1), math.radians(0.5) ** 2 * np.eye(n + 1), NOISE**2 * np.eye(1)

        def acting(k: int, u: np.ndarray = u, delay: int = plant.delay) -> np.ndarray:
            return u[min(max(k - 1 - delay, 0), len(u) - 1)] * np.ones((1, 1))

        for k, z in enumerate(run.channels[f"{axis}_measured"]):
            kf.predict(acting(k))
            spread = math.sqrt(float((kf.H @ kf.P @ kf.H.T + kf.R)[0, 0]))
            # Four standard deviations: what is further is an outlier.
            kf.update(z if np.isfinite(z) and abs(z - float((kf.H @ kf.x)[0, 0])) < 4.0 * spread else None)
            x = kf.x
            for i in range(1, AHEAD + 1):
                x = kf.F @ x + kf.B @ acting(min(k + i, k + plant.delay))
            told.append(float((kf.H @ x)[0, 0]))
    return np.array(told).reshape(2, -1).T


def known(neck: str, seed: int, changes: Changes = ()) -> tuple[Block, Recording, list[Spoiled]]:
    """Return a specimen, the recording that models are from, and the motions to judge by."""
    block = ForeignNeck(name=neck, seed=seed, noise=False, changes=changes).block()
    log = logged(moved(block, signal("eq22"), 1000 * seed + 1).rows(0, 7000))
    return block, log, [spoiled(block, motion, 1000 * seed + 10 + i) for i, motion in enumerate(motions())]


def error(observer: AnyObserver, runs: list[Spoiled]) -> tuple[float, float]:
    """Return the rms errors [deg], over all and in the blackouts."""
    return errors_deg(runs, [filtered(observer, run.recording) for run in runs])


def row(neck: str, seed: int) -> dict[str, tuple[float, float]]:
    """Return rms errors [deg], over all and in the blackouts, of each filter."""
    _, log, runs = known(neck, seed)
    model = OutputError().fit(log)
    found = {
        "no delay": KalmanSettings(sensor_delay=0.0).design(model),
        "default": design_observer(KalmanSettings(), model, None),
        "greybox": KalmanSettings().design(GreyBox().fit(log)),
    }
    scores = {name: error(item, runs) for name, item in found.items()}
    return {**scores, "peer": errors_deg(runs, [peer(model, run.recording) for run in runs])}


def grid(neck: str, seed: int) -> str:
    """Return of each model the error of the defaults, of the best of the grid with their delay, and with any delay."""
    _, log, runs = known(neck, seed)
    cells = []
    for kind, model in (("oe", OutputError().fit(log)), ("greybox", GreyBox().fit(log))):
        usual = KalmanSettings().design(model)
        tried = [usual.noise, *((values[0] or usual.noise[0], *values[1:]) for values in
                                product(MEASURED, *LEVELS[kind].values()))]  # fmt: skip
        errors = [error(usual.with_noise(item), runs)[0] for item in tried]
        best = tried[int(np.argmin(errors))]
        later = {
            delay: error(KalmanSettings(sensor_delay=delay).design(model).with_noise(best), runs)[0] for delay in DELAYS
        }
        delay = min(later, key=lambda item: later[item])
        said = ", ".join(f"{level:.2g}" for level in best)
        told = error(KalmanSettings(measurement_noise_std=NOISE).design(model), runs)[0]
        cells.append(f"{kind} {errors[0]:.3f} {told:.3f}")
        for what, least in ((f"({said})", min(errors)), (f"({delay:g} s)", min(*errors, later[delay]))):
            cells.append(
                f"{least:.3f} {100.0 * (errors[0] / least - 1.0):+.0f} {100.0 * (told / least - 1.0):+.0f} % {what}"
            )
    return f"{neck:8}{seed:3}  " + "  ".join(cells)


def oracle(neck: str, seed: int) -> str:
    """Return rms errors [deg] of the filter, of one that is told all at the sensor's time, and of hindsight."""
    block, log, runs = known(neck, seed)
    model = GreyBox().fit(log)
    usual, then = KalmanSettings().design(model), KalmanSettings(sensor_delay=0.0).design(model)
    exact, left = [], []
    for number, (run, motion) in enumerate(zip(runs, motions(), strict=True)):
        clean = moved(block, motion, 1000 * seed + 10 + number, 0.0).channels
        nothing = np.full(len(run.dark), np.nan)
        dark = run.recording.with_channels(pitch_measured=nothing, roll_measured=nothing)
        free = filtered(usual, dark)
        missed = np.column_stack([clean["pitch_measured"], clean["roll_measured"]]) - filtered(then, dark)
        exact.append(free + missed)
        wrong = (run.recording.outputs - free)[run.dark]
        left.append(wrong - wrong.mean(axis=0))
    cells = [error(usual, runs), errors_deg(runs, exact)]
    hindsight = math.degrees(np.sqrt(np.mean(np.concatenate(left) ** 2)))
    return (
        f"{neck:8}{seed:3}" + "".join(f"{f'{all_:.3f} ({gap:.2f})':>16}" for all_, gap in cells) + f"{hindsight:10.2f}"
    )


def causes(neck: str, seed: int) -> str:
    """Return rms errors [deg] of the filter over the neck as it is, and without parts of its physics."""
    lines = []
    for what, changes in {"as it is": (), **CAUSES.get(neck, {})}.items():
        _, log, runs = known(neck, seed, changes)
        whole, dark = error(KalmanSettings().design(GreyBox().fit(log)), runs)
        lines.append(f"{neck:8}{seed:3}  {what:28}{whole:.3f} ({dark:.2f})")
    return "\n".join(lines)


def unseen(neck: str, seed: int) -> str:
    """Return what `--data` of a recording that the model has not seen keeps, and what that is worth."""
    block, log, runs = known(neck, seed)
    motion = signal("mixed", duration=UNSEEN_S, seed=UNSEEN_SEED)
    other = logged(spoiled(block, motion, 1000 * seed + 20).recording)
    usual = KalmanSettings().design(GreyBox().fit(log))
    fit = fit_levels_and_delays(usual, [other])
    held = [math.degrees(fit.checks[name]) for name in ("default", fit.kept)]
    true = [error(item, runs)[0] for item in (usual, fit.observer)]
    return f"{neck:10}{seed:3}{fit.kept:>18}" + "".join(f"{value:9.3f}" for value in (*held, *true))


def main() -> None:
    """Print a line for each neck: medians over the seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2, help="specimens of each neck, with noise of their own (2)")
    parser.add_argument("--necks", nargs="*", default=list(NECKS), choices=NECKS, help="(all)")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--grid", action="store_true", help="the defaults beside the best of a grid")
    other.add_argument("--unseen", action="store_true", help="what `--data` makes of rows that the model has not seen")
    other.add_argument("--oracle", action="store_true", help="what a filter that were told all would reach")
    other.add_argument("--causes", action="store_true", help="without parts of the neck's physics")
    wanted = parser.parse_args()
    printed = {
        grid: "of the defaults, told the sensor's noise, of the best of the grid (its levels), and with its best delay",
        unseen: "kept; on rows held out, of the defaults and of what was kept; the same against the truth",
        causes: "(in blackouts) of the defaults, without a part of the neck's physics",
        oracle: "(in blackouts) of the defaults, of the oracle, of hindsight in the blackouts",
    }
    for line, head in printed.items():
        if getattr(wanted, line.__name__):
            print(f"rms error [deg] {head}")
            for neck, seed in product(wanted.necks, range(1, wanted.seeds + 1)):
                print(line(neck, seed), flush=True)
            return
    heads = ("no delay", "default", "greybox", "peer")
    print("rms error (in blackouts) [deg]\n" + f"{'':20}" + "".join(f"{head:>16}" for head in heads))
    for neck in wanted.necks:
        rows = [row(neck, seed) for seed in range(1, wanted.seeds + 1)]
        cells = [np.median([item[head] for item in rows], axis=0) for head in heads]
        name = f"{neck} (held out)" if neck in HELD_OUT else neck
        print(f"{name:20}" + "".join(f"{f'{all_:.3f} ({dark:.2f})':>16}" for all_, dark in cells), flush=True)


if __name__ == "__main__":
    main()
