"""Print what the observer is worth against the true angles on foreign necks with a poor sensor, beside a peer.

`python benchmarks/observer.py [--seeds N] [--necks NECK...]`

Noise of 0.25 deg, 20 % of the samples lost, 2 % outliers, a blackout of a second in each of four motions; every filter
sees the same. The model is an `oe` of 140 s of Eq. 22 with that noise. `default`, `look-ahead` (over 50 ms) and `data`
are ours, the last with what `--data` makes of the recording that the model is from; `greybox` is the default over
that model of the same recording, `fitted` with `--data`; `peer` is thirty lines of filterpy over the `oe` with three
samples of look-ahead. Nothing is chosen here: the two necks that are held out have lines
of their own; defaults are chosen by `leave_one_neck_out.py observer.*`.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from softneck.core import Matrix
from softneck.estimation import KalmanSettings
from softneck.estimation._axis import axis_plant
from softneck.estimation._fitted import fitted_observer
from softneck.identification import GreyBox, Model, OutputError
from softneck.signals import Recording, redefinition_matrix, signal
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.necks import NECKS, ForeignNeck
from tests.foreign_necks.spoiled import NOISE, errors_deg, filtered, logged, motions, moved, spoiled

AHEAD = 3  # samples; delay and lag of an ordinary inclinometer


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


def row(neck: str, seed: int) -> dict[str, tuple[float, float]]:
    """Return rms errors [deg], over all and in the blackouts, of each filter."""
    block = ForeignNeck(name=neck, seed=seed, noise=False).block()
    log = logged(moved(block, signal("eq22"), 1000 * seed + 1).rows(0, 7000))
    runs = [spoiled(block, motion, 1000 * seed + 10 + i) for i, motion in enumerate(motions())]
    model = OutputError().fit(log)
    observer = KalmanSettings().design(model)
    over = KalmanSettings().design(GreyBox().fit(log))
    found = {
        "default": observer,
        "look-ahead": KalmanSettings(sensor_delay=0.05).design(model),
        "greybox": over,
        "data": fitted_observer(observer, [log]).observer,
        "fitted": fitted_observer(over, [log]).observer,
    }
    scores = {name: errors_deg(runs, [filtered(item, run.recording) for run in runs]) for name, item in found.items()}
    return {**scores, "peer": errors_deg(runs, [peer(model, run.recording) for run in runs])}


def main() -> None:
    """Print a line for each neck: medians over the seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2, help="specimens of each neck, with noise of their own (2)")
    parser.add_argument("--necks", nargs="*", default=list(NECKS), choices=NECKS, help="(all)")
    wanted = parser.parse_args()
    heads = ("default", "look-ahead", "data", "greybox", "fitted", "peer")
    print("rms error (in blackouts) [deg]\n" + f"{'':20}" + "".join(f"{head:>16}" for head in heads))
    for neck in wanted.necks:
        rows = [row(neck, seed) for seed in range(1, wanted.seeds + 1)]
        cells = [np.median([item[head] for item in rows], axis=0) for head in heads]
        name = f"{neck} (held out)" if neck in HELD_OUT else neck
        print(f"{name:20}" + "".join(f"{f'{all_:.3f} ({dark:.2f})':>16}" for all_, dark in cells), flush=True)


if __name__ == "__main__":
    main()
