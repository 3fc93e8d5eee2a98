"""Print what filters that correct the state of a model are worth beside ours, which corrects none of it.

`python benchmarks/filters.py [--necks NECK...] [--seeds N...] [--unscented]`: the necks, motions and spoiled
measurements of `observer.py`, a blackout in each motion, and a `greybox` of the same recording for all. rms error, and
that in the blackouts:

- `ours`: the default of `softneck observer`; `data`: with the levels that are likeliest on 60 s of another motion,
  which the model has not seen; `told`: the default, told the sensor's noise; `best`: the best of a grid, told too.
- `extended`: the extended filter over the model's own step and its exact derivatives (`extended_runtime.py`) and a
  disturbance of each output that walks, process noise through the motors; `data` and `best` as of ours.
- `both`: the extended filter with the walk of our best, which goes as far as the model moves.

"best" is chosen on the very rows that it is judged on: no choice of levels from elsewhere does better. All tell the
angle of now, 50 ms after the measurement, and take jumps of the set-points as ramps of the motors' rate. The last
column is by how much the extended filter and filterpy's differ at most [rad] over 3 s in which both take all in.

`--unscented`: filterpy's unscented filter beside the extended one, both with the best levels of the latter, over the
blackout of each motion and the 5 s before it; NaN where its covariance is not positive definite any more.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import KalmanSettings, NonlinearObserver, fit_noise
from softneck.estimation._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE, KALMAN_LEAD, KALMAN_REJECTIONS
from softneck.estimation._noise import SETTLE, find_outliers
from softneck.estimation._offline import measured_angles
from softneck.identification import GreyBox, Model
from softneck.runtime import Block, Port, State, load_runtime
from softneck.signals import Recording, signal
from tests.estimation.necks import ramped
from tests.foreign_necks.necks import CHOOSING, ForeignNeck
from tests.foreign_necks.spoiled import NOISE, SCORED, Spoiled, filtered, logged, motions, moved, spoiled

# Levels: measurement, walk at rest, walk as a part of the motion, motors [rad a sample].
Levels = tuple[float, float, float, float]
NONE = 1e-9
OURS = [(NOISE, math.radians(rest), ratio, NONE) for rest, ratio in product((0.02, 0.1), (0.3, 0.5, 0.7, 1.0, 1.4))]
EXTENDED = [
    (NOISE, math.radians(walk), NONE, motors) for walk, motors in product((0.05, 0.1, 0.2, 0.3, 0.45), (0.03, 0.1, 0.3))
]
MOTORS = (0.01, 0.03, 0.1)  # of `both`
START = (math.radians(0.1), math.radians(0.1), NONE, 0.03)  # where the likelihood's search begins
UNSEEN_S, UNSEEN_SEED = 60.0, 77
BEFORE = 250  # rows before a blackout, of `--unscented`
CHECKED = 150
# Keeps the covariance of states that no noise reaches positive, in filterpy's unscented filter.
_TINY = 1e-8


def designed(model: Model, levels: Levels | None = None) -> NonlinearObserver:
    """Return our observer, with levels or its defaults."""
    found = KalmanSettings().design(model)
    return found if levels is None else found.with_noise(levels[:3])


def extended(model: Model, levels: Levels) -> Block:
    """Return the extended filter with the ports, constants and arrays of ours."""
    ours = designed(model, levels).block()
    return replace(
        ours,
        runtime=ours.runtime.replace("softneck.estimation._nonlinear_runtime", "extended_runtime"),
        parameters=(*ours.parameters, Port(name="motor_noise_std", unit="rad", start=levels[3])),
    )


def likeliest(model: Model, recording: Recording) -> Levels:
    """Return the levels of the extended filter, the sensor's too, under which a recording is likeliest."""
    from numba import njit
    from scipy.optimize import minimize

    block = extended(model, START)
    arrays, runtime = list(block.arrays), load_runtime(block.runtime)
    arrays[1] = constants = arrays[1].copy()
    constants[KALMAN_GATE] = constants[KALMAN_REJECTIONS] = np.inf
    constants[KALMAN_FROZEN] = constants[KALMAN_LEAD] = 0.0
    z = measured_angles(recording)
    z[find_outliers(z)] = math.nan
    rows, step, given = inputs(recording, z), runtime.step, tuple(arrays)

    @njit
    def cost(q: Vector, x: Vector, y: Vector) -> float:  # as `kalman_cost`
        total = 0.0
        for k in range(rows.shape[0]):
            x[6] = np.nan  # log det of an innovation's covariance
            step(given, q, x, rows[k], y)
            if k >= SETTLE and not math.isnan(x[6]):
                total += x[6] + y[4]
        return total

    def of(level: Vector) -> float:
        q = np.array([10.0 ** level[0], 10.0 ** level[1], NONE, 10.0 ** level[2]])
        return cost(q, np.zeros(runtime.state_size(given)), np.zeros(6))

    start = np.log10([START[0], START[1], START[3]])
    simplex = np.vstack([start, start + 0.3 * np.eye(3)])
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1.0}
    found = 10.0 ** minimize(of, start, method="Nelder-Mead", options=options).x
    return float(found[0]), float(found[1]), NONE, float(found[2])


def inputs(run: Recording, z: Matrix) -> Matrix:
    """Return the rows of an observer's inputs (time, 6)."""
    return np.column_stack([run.set_points[np.maximum(np.arange(len(run)) - 1, 0)], z, np.ones(len(run))])


def heard(run: Recording) -> Matrix:
    """Return what the sensor said (time, 2)."""
    return np.column_stack([run.channels["pitch_measured"], run.channels["roll_measured"]])


def told(block: Block, run: Recording) -> Matrix:
    """Return the angles of now (time, 2) that a filter's block tells."""
    return block.run(block.initial_state(), inputs(run, heard(run)))[1][:, :2]


def judged(tell: Callable[[Recording], Matrix], runs: Sequence[Spoiled]) -> tuple[float, float]:
    """Return the rms error [deg], and that in the blackouts; NaN where the filter breaks off."""
    try:
        errors = [tell(run.recording) - run.recording.outputs for run in runs]
    except np.linalg.LinAlgError:
        return math.nan, math.nan
    scored = np.vstack([error[SCORED:] for error in errors])
    dark = np.vstack([error[run.dark] for run, error in zip(runs, errors, strict=True)])
    return math.degrees(np.sqrt(np.mean(scored**2))), math.degrees(np.sqrt(np.mean(dark**2)))


class Stepped:
    """What filterpy needs of a model: its step on vectors of its state, its outputs and a disturbance of each."""

    def __init__(self, model: Model, run: Recording) -> None:
        """Take a model, and settle it under the first set-points."""
        self.model, self.start = model, model.initial_state()
        self.n, self.runtime = len(self.start.values), load_runtime(model.block().runtime)
        self.arrays = model.block().arrays
        rate = (model.robot.motors.rate_limit or (math.inf,))[0]
        self.motors = inputs(ramped(run, rate), heard(run))[:, :3]
        self.x0 = np.append(self.start.values, np.zeros(4))
        for _ in range(300):
            self.x0 = self.move(self.x0, self.motors[0])
        self.P0 = np.zeros((self.n + 4, self.n + 4))
        self.P0[-2:, -2:] = math.radians(40.0) ** 2 * np.eye(2)

    def move(self, x: Vector, u: Vector) -> Vector:
        """Return the next vector."""
        values, out = x[: self.n].copy(), np.zeros(len(self.start.outputs))
        row = np.append(u, np.full(5, np.nan))
        self.runtime.step(self.arrays, self.start.parameters, values, row, out)
        return np.concatenate([values, out[:2], x[-2:]])

    def slopes(self, x: Vector, u: Vector) -> tuple[Matrix, Matrix]:
        """Return the derivatives of the next vector by this one and by the motors."""
        found = self.model.jacobian(State(x[: self.n].copy(), self.start.parameters, self.start.outputs), u)
        F, B = np.zeros((self.n + 4, self.n + 4)), np.zeros((self.n + 4, 3))
        F[: self.n, : self.n], F[self.n : -2, : self.n] = found.A, found.C[:2]
        F[-2:, -2:] = np.eye(2)
        B[: self.n], B[self.n : -2] = found.B, found.D[:2]
        return F, B

    def noise(self, B: Matrix, levels: Levels) -> Matrix:
        """Return the covariance of a sample's process noise."""
        Q = levels[3] ** 2 * B @ B.T
        Q[-2:, -2:] += levels[1] ** 2 * np.eye(2)
        return Q


def angles_of(n: int) -> Matrix:
    """Return what makes the angles of a vector: the model's outputs and the disturbances (2, n + 4)."""
    return np.hstack([np.zeros((2, n)), np.eye(2), np.eye(2)])


def filterpys(model: Model, run: Recording, levels: Levels) -> Matrix:
    """Return the angles (time, 2) at the measurement's time of filterpy's extended filter, without a gate."""
    from filterpy.kalman import ExtendedKalmanFilter

    on = Stepped(model, run)
    H = angles_of(on.n)
    kf: Any = ExtendedKalmanFilter(dim_x=on.n + 4, dim_z=2)
    kf.x, kf.P, kf.R = on.x0.copy(), on.P0.copy(), levels[0] ** 2 * np.eye(2)
    angles = []
    for u, z in zip(on.motors, heard(run), strict=True):
        F, B = on.slopes(kf.x, u)
        kf.x, kf.P = on.move(kf.x, u), F @ kf.P @ F.T + on.noise(B, levels)
        if np.isfinite(z).all():
            kf.update(z, HJacobian=lambda _: H, Hx=lambda x: H @ x)
        angles.append(H @ kf.x)
    return np.array(angles)


def difference(model: Model, run: Recording, levels: Levels) -> float:
    """Return by how much the extended filter and filterpy's differ at most [rad], where both take all in."""
    block, kept = extended(model, levels), []
    constants = block.arrays[1].copy()
    constants[KALMAN_GATE], constants[KALMAN_LEAD] = np.inf, 0.0
    block = replace(block, arrays=(block.arrays[0], constants, *block.arrays[2:]))
    state = block.initial_state()
    for row in inputs(run, heard(run)):
        state, _ = block.step(state, row)
        kept.append(state.values[10:12] + state.values[12:14])  # the model's angles and the disturbances
    return float(np.abs(np.array(kept) - filterpys(model, run, levels)).max())


def unscented(model: Model, run: Recording, levels: Levels) -> Matrix:
    """Return the angles of now (time, 2) of filterpy's unscented filter."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    on, block = Stepped(model, run), extended(model, levels)
    c, refused, angles, H = block.arrays[1], 0, [], angles_of(on.n)
    points = MerweScaledSigmaPoints(on.n + 4, alpha=0.1, beta=2.0, kappa=0.0)
    kf: Any = UnscentedKalmanFilter(on.n + 4, 2, 0.02, hx=lambda x: H @ x,
                                    fx=lambda x, _, u: on.move(x, u), points=points)  # fmt: skip
    kf.x, kf.P, kf.R = on.x0.copy(), on.P0 + _TINY * np.eye(on.n + 4), levels[0] ** 2 * np.eye(2)
    for u, z in zip(on.motors, heard(run), strict=True):
        kf.Q = on.noise(on.slopes(kf.x, u)[1], levels) + _TINY * np.eye(on.n + 4)
        kf.P = 0.5 * (kf.P + kf.P.T)
        kf.predict(u=u)
        error, S = z - H @ kf.x, H @ kf.P @ H.T + kf.R
        if np.isfinite(error).all():
            good = error @ np.linalg.solve(S, error) <= c[KALMAN_GATE] or refused >= c[KALMAN_REJECTIONS]
            refused = 0 if good else refused + 1
            if good:
                kf.update(z)
        angles.append(ahead(on, kf.x, u, float(c[KALMAN_LEAD])))
    return np.array(angles)


def ahead(on: Stepped, x: Vector, u: Vector, lead: float) -> Vector:
    """Return the angles of now, `lead` samples after those of `x`."""
    before = x
    for _ in range(math.floor(lead) + 1):
        before, x = x, on.move(x, u)
    return angles_of(on.n) @ (before + (lead - math.floor(lead)) * (x - before))


def best(
    tell: Callable[[Levels], Callable[[Recording], Matrix]], grid: Sequence[Levels], runs: Sequence[Spoiled]
) -> Levels:
    """Return the levels with the least error on these very runs."""
    return min(grid, key=lambda levels: judged(tell(levels), runs)[0])


def specimen(name: str, seed: int) -> tuple[Model, Recording, list[Spoiled]]:
    """Return the grey box of a specimen, 60 s that it has not seen, and the motions to judge by."""
    block = ForeignNeck(name=name, seed=seed, noise=False).block()
    log = logged(moved(block, signal("eq22"), 1000 * seed + 1).rows(0, 7000))
    runs = [spoiled(block, motion, 1000 * seed + 10 + i) for i, motion in enumerate(motions())]
    other = logged(spoiled(block, signal("mixed", duration=UNSEEN_S, seed=UNSEEN_SEED), 1000 * seed + 20).recording)
    return GreyBox().fit(log), other, runs


def correcting(model: Model, levels: Levels) -> Callable[[Recording], Matrix]:
    """Return what the extended filter tells of a run."""
    return lambda run: told(extended(model, levels), run)


def row(name: str, seed: int) -> dict[str, tuple[float, float] | float]:
    """Return the rms errors [deg] of each filter on a specimen, and what is between the extended one and filterpy's."""
    model, other, runs = specimen(name, seed)

    def ours(levels: Levels | None) -> Callable[[Recording], Matrix]:
        return lambda run: filtered(designed(model, levels), run)

    def theirs(levels: Levels) -> Callable[[Recording], Matrix]:
        return correcting(model, levels)

    walk, levels = best(ours, OURS, runs), best(theirs, EXTENDED, runs)
    fitted = fit_noise(designed(model), other).observer
    filters = {
        "ours": ours(None),
        "data": lambda run: filtered(fitted, run),
        "told": ours((NOISE, *designed(model).noise[1:], NONE)),
        "best": ours(walk),
        "extended: data": theirs(likeliest(model, other)),
        "best ": theirs(levels),
        "both": theirs(best(theirs, [(*walk[:3], motors) for motors in MOTORS], runs)),
    }
    apart = difference(model, runs[1].recording.rows(0, CHECKED), levels)
    return {**{title: judged(tell, runs) for title, tell in filters.items()}, "apart": apart}


def around(run: Spoiled) -> Spoiled:
    """Return a blackout with what comes before it."""
    first = max(int(np.argmax(run.dark)) - BEFORE, 0)
    last = first + BEFORE + int(run.dark.sum())
    return Spoiled(run.recording.rows(first, last), run.dark[first:last])


def sigma_points(name: str, seed: int) -> dict[str, tuple[float, float] | float]:
    """Return the rms errors [deg] of filterpy's unscented filter and of the extended one around the blackouts."""
    model, _, runs = specimen(name, seed)
    levels = best(lambda levels: correcting(model, levels), EXTENDED, runs)
    runs = [around(run) for run in runs]
    return {
        "extended": judged(correcting(model, levels), runs),
        "unscented": judged(lambda run: unscented(model, run, levels), runs),
    }


def main() -> None:
    """Print a line for each specimen, and how far the extended filter is from filterpy's."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="*", default=list(CHOOSING), choices=CHOOSING, help="(all that choose)")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2], help="specimens and their noise (1 2)")
    parser.add_argument("--unscented", action="store_true", help="the unscented filter beside the extended one")
    wanted = parser.parse_args()
    print("rms error (in blackouts) [deg]")
    for number, (name, seed) in enumerate(product(wanted.necks, wanted.seeds)):
        found = (sigma_points if wanted.unscented else row)(name, seed)
        if number == 0:
            print(f"{'':9}" + "".join(f"{title:>16}" for title in found))
        print(f"{name:8}{seed}" + "".join(f"{cell(value):>16}" for value in found.values()), flush=True)


def cell(value: tuple[float, float] | float) -> str:
    """Return a cell of the table."""
    return f"{value[0]:.3f} ({value[1]:.2f})" if isinstance(value, tuple) else f"{value:.0e}"


if __name__ == "__main__":
    main()
