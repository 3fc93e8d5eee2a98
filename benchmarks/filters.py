"""Print what filters that correct the state of a model are worth beside ours, which corrects none of it.

`python benchmarks/filters.py [--necks NECK...] [--seed N] [--rows N] [--quick]`: the necks, motions and spoiled
measurements of `observer.py`, the first rows of each, and a `greybox` of the same recording for all. `ours` is the
default of `softneck observer`. `extended` and `unscented` are filterpy's, over the model's own step (and its exact
derivatives) and a disturbance of each output that walks; process noise enters through the motors. Theirs are the
noise levels, of a grid, with which `extended` is best on the very rows it is judged on. All tell the angle of now, 50
ms after the measurement, and take jumps of the set-points as ramps of the motors' rate. `--quick` leaves `unscented`
out.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import KalmanSettings
from softneck.identification import GreyBox, Model
from softneck.runtime import State
from softneck.signals import signal
from tests.estimation.necks import ramped
from tests.foreign_necks.necks import CHOOSING, ForeignNeck
from tests.foreign_necks.spoiled import NOISE, SCORED, Spoiled, filtered, logged, motions, moved, spoiled

LEAD = 2.5  # samples of 20 ms
GATE = 18.4  # that of ours: 0.9999 of good measurements
FORCED = 10  # refused in a row until the next one is taken in, as ours does
MOTOR_NOISE = (0.01, 0.03, 0.1)  # [rad] a sample
WALK = tuple(math.radians(level) for level in (0.02, 0.1, 0.3))
START = math.radians(5.0)
# Keeps the covariance of states that no noise reaches positive.
_TINY = 1e-10


class Stepped:
    """The model's step on plain vectors: its state, then a disturbance of pitch and one of roll."""

    def __init__(self, model: Model, first: Vector) -> None:
        """Take a model, and settle it under the first set-points."""
        self.model, self.start = model, model.initial_state()
        state = self.start
        for _ in range(300):
            state, _ = model.step(state, first)
        self.n = len(state.values)
        self.x0 = np.append(state.values, np.zeros(2))
        self.P0 = _TINY * np.eye(self.n + 2)
        self.P0[-2:, -2:] += START**2 * np.eye(2)

    def state(self, x: Vector) -> State:
        """Return the state of the model."""
        return State(np.ascontiguousarray(x[: self.n]), self.start.parameters, self.start.outputs)

    def move(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Return the next vector, and the angles after the move."""
        state, outputs = self.model.step(self.state(x), u)
        return np.append(state.values, x[self.n :]), outputs[:2] + x[self.n :]

    def slopes(self, x: Vector, u: Vector) -> tuple[Matrix, Matrix, Matrix]:
        """Return the derivatives of the next vector by vector and motors, and those of the angles by the vector."""
        found = self.model.jacobian(self.state(x), u)
        A = np.eye(self.n + 2)
        A[: self.n, : self.n] = found.A
        return A, np.vstack([found.B, np.zeros((2, 3))]), np.hstack([found.C[:2], np.eye(2)])

    def noise(self, B: Matrix, motors: float, walk: float) -> Matrix:
        """Return the covariance of a sample's process noise."""
        Q = motors**2 * B @ B.T + _TINY * np.eye(len(B))
        Q[-2:, -2:] += walk**2 * np.eye(2)
        return Q

    def ahead(self, x: Vector, u: Vector) -> Vector:
        """Return the angles of now; `x` is the vector a step before the measurement."""
        x, before = self.move(x, u)
        after = before
        for _ in range(math.floor(LEAD) + 1):
            before = after
            x, after = self.move(x, u)
        return before + (LEAD - math.floor(LEAD)) * (after - before)


def extended(on: Stepped, P: Matrix, Z: Matrix, motors: float, walk: float) -> Matrix:
    """Return the angles of filterpy's extended filter; its state is that a step before the measurement."""
    from filterpy.kalman import ExtendedKalmanFilter

    kf: Any = ExtendedKalmanFilter(dim_x=on.n + 2, dim_z=2)
    kf.x, kf.P, kf.R = on.x0.copy(), on.P0.copy(), NOISE**2 * np.eye(2)
    told, refused = [], 0
    for u, z in zip(P[np.maximum(np.arange(len(Z)) - 1, 0)], Z, strict=True):
        A, B, C = on.slopes(kf.x, u)
        said = on.move(kf.x, u)[1]
        good, refused = accepted(z - said, C @ kf.P @ C.T + kf.R, refused)
        if good:
            kf.update(z, HJacobian=lambda _, C=C: C, Hx=lambda _, said=said: said)
        told.append(on.ahead(kf.x, u))
        kf.x = on.move(kf.x, u)[0]
        kf.P = A @ kf.P @ A.T + on.noise(B, motors, walk)
    return np.array(told)


def unscented(on: Stepped, P: Matrix, Z: Matrix, motors: float, walk: float) -> Matrix:
    """Return the angles of filterpy's unscented filter, the same way."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter, unscented_transform

    points = MerweScaledSigmaPoints(on.n + 2, alpha=0.1, beta=2.0, kappa=0.0)
    kf: Any = UnscentedKalmanFilter(on.n + 2, 2, 0.02, hx=lambda x, u: on.move(x, u)[1],
                                    fx=lambda x, _, u: on.move(x, u)[0], points=points)  # fmt: skip
    kf.x, kf.P, kf.R = on.x0.copy(), on.P0.copy(), NOISE**2 * np.eye(2)
    told, refused = [], 0
    for u, z in zip(P[np.maximum(np.arange(len(Z)) - 1, 0)], Z, strict=True):
        kf.sigmas_f = points.sigma_points(kf.x, kf.P)
        heard = np.array([on.move(x, u)[1] for x in kf.sigmas_f])
        said, S = unscented_transform(heard, kf.Wm, kf.Wc, kf.R)
        good, refused = accepted(z - said, S, refused)
        if good:
            kf.update(z, u=u)
        told.append(on.ahead(kf.x, u))
        kf.Q = on.noise(on.slopes(kf.x, u)[1], motors, walk)
        kf.P = 0.5 * (kf.P + kf.P.T) + _TINY * np.eye(on.n + 2)
        kf.predict(u=u)
    return np.array(told)


def accepted(error: Vector, S: Matrix, refused: int) -> tuple[bool, int]:
    """Return whether a measurement is taken in, and how many were refused in a row."""
    if not np.isfinite(error).all():
        return False, refused
    good = bool(error @ np.linalg.solve(S, error) <= GATE) or refused >= FORCED
    return good, 0 if good else refused + 1


def judged(told: Callable[[Spoiled], Matrix], runs: list[Spoiled]) -> tuple[float, float]:
    """Return the rms error [deg] over all, and the milliseconds a row took; NaN where the filter breaks off."""
    start = time.process_time()
    try:
        angles = [told(run) for run in runs]
    except np.linalg.LinAlgError:  # filterpy's sigma points, of a covariance that is not positive definite
        return math.nan, math.nan
    took = time.process_time() - start
    errors = np.vstack([said[SCORED:] - run.recording.outputs[SCORED:] for run, said in zip(runs, angles, strict=True)])
    return math.degrees(np.sqrt(np.mean(errors**2))), 1e3 * took / sum(len(run.dark) for run in runs)


def row(name: str, seed: int, rows: int, peers: tuple[Any, ...]) -> str:
    """Return a line of the table, with these peers."""
    block = ForeignNeck(name=name, seed=seed, noise=False).block()
    log = logged(moved(block, signal("eq22"), 1000 * seed + 1).rows(0, 7000))
    whole = [spoiled(block, motion, 1000 * seed + 10 + i) for i, motion in enumerate(motions())]
    runs = [Spoiled(run.recording.rows(0, rows), run.dark[:rows]) for run in whole]
    model = GreyBox().fit(log)
    own = KalmanSettings().design(model)

    def peer(make: Any, *levels: float) -> Callable[[Spoiled], Matrix]:
        def told(run: Spoiled) -> Matrix:
            P = ramped(run.recording, (model.robot.motors.rate_limit or (math.inf,))[0]).set_points
            Z = np.column_stack([run.recording.channels[f"{axis}_measured"] for axis in ("pitch", "roll")])
            return make(Stepped(model, P[0]), P, Z, *levels)

        return told

    best = min(product(MOTOR_NOISE, WALK), key=lambda levels: judged(peer(extended, *levels), runs)[0])
    cells = [judged(lambda run: filtered(own, run.recording), runs)]
    cells += [judged(peer(make, *best), runs) for make in peers]
    return f"{name:8}" + "".join(f"{f'{error:.3f} ({took:.2g})':>18}" for error, took in cells)


def main() -> None:
    """Print a line for each neck."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="*", default=list(CHOOSING), choices=CHOOSING, help="(all that choose)")
    parser.add_argument("--seed", type=int, default=1, help="specimen and noise (1)")
    parser.add_argument("--rows", type=int, default=300, help="of each motion (300)")
    parser.add_argument("--quick", action="store_true", help="without the unscented filter")
    wanted = parser.parse_args()
    peers = (extended,) if wanted.quick else (extended, unscented)
    print("rms error [deg] (processor time of a row [ms])")
    print(f"{'':8}" + "".join(f"{name:>18}" for name in ("ours", *(item.__name__ for item in peers))))
    for name in wanted.necks:
        print(row(name, wanted.seed, wanted.rows, peers), flush=True)


if __name__ == "__main__":
    main()
