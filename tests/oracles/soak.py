"""A day of a predictive controller: random references, lost and wrong measurements, what cannot be reached.

`python -m tests.oracles.soak [--hours 24] [--seed 0]` prints what it counted; 24 simulated hours take some minutes.
"""

from __future__ import annotations

import argparse
import math
import resource
from dataclasses import dataclass, field

import numpy as np

from softneck.design import MpcController, MpcSettings
from softneck.design.predictive import _mpc_state_runtime as rt
from softneck.runtime import load_runtime

from .bake_off import bake_off_neck

TS = 0.02
NAMES = {rt.MPC_OPTIMAL: "optimal", rt.MPC_SOFT: "softened", rt.MPC_PLAN: "previous_plan", rt.MPC_HOLDING: "holding"}
# The plant: gain [rad/rad], pole [1/s] and dead time [samples] of the bake-off's nominal one.
GAIN, POLE, DEAD = math.radians(27.691 / 5.293), math.exp(-5.293 * TS), 4
# Of the plant against the model, drawn anew with each episode.
SPREAD = 0.3
EPISODE = 500  # samples


@dataclass
class Soaked:
    """What was seen.

    Attributes:
        samples: stepped.
        said: samples of each status, by name.
        iterations: the most of a sample.
        residual: the largest of the KKT conditions of an answer that was used.
        position, slew: the furthest of a set-point beyond its limit [rad], [rad/s]; not above 0.
        silent: samples on which a soft limit was predicted to be passed and nothing was said.
        softest: the largest slack that was needed [rad].
        finite: whether all that was remembered and given was a number.
        grown: what the process had grown by at the end, after the first tenth [MB].
    """

    samples: int = 0
    said: dict[str, int] = field(default_factory=lambda: dict.fromkeys(NAMES.values(), 0))
    iterations: int = 0
    residual: float = 0.0
    position: float = -math.inf
    slew: float = -math.inf
    silent: int = 0
    softest: float = 0.0
    finite: bool = True
    grown: float = 0.0


def soft_controller() -> MpcController:
    """Return the controller of the bake-off's neck with both soft limits."""
    settings = MpcSettings(bandwidth=8.0, angle_limit=0.3, minimum_tautness=-0.25)
    return settings.design(bake_off_neck())


def soak(controller: MpcController, hours: float, seed: int) -> Soaked:
    """Return what is seen in so many simulated hours."""
    a = rt.MpcArrays(controller.arrays)
    step, at = load_runtime(controller.block().runtime).step, rt.MpcState.parts(a)
    state = controller.initial_state()
    x, parameters = state.values.copy(), np.asarray(state.parameters, dtype=np.float64)
    places = {name: at[name].start for name in ("status", "iterations", "residual", "slack")}
    rng, seen = np.random.default_rng(seed), Soaked(samples=round(hours * 3600.0 / TS))
    out, motors, before = np.zeros(3), np.zeros(3), np.zeros(3)
    y, line = np.zeros(2), np.zeros((DEAD, 3))
    T, u, gain, load = a.T, np.zeros(10), GAIN * np.ones(2), np.zeros(2)
    warm, first = seen.samples // 10, 0
    blind = stuck = False
    for k in range(seen.samples):
        if k == warm:
            first = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if k % EPISODE == 0:
            # References beyond what the soft limit allows, and now and then none.
            u[:2], u[2] = rng.uniform(-0.8, 0.8, 2), rng.uniform(-6.0, 6.0)
            gain, load = GAIN * rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, 2), rng.uniform(-0.1, 0.1, 2)
            u[8:] = 1.0
            luck = rng.random()
            if luck < 0.05:
                u[int(rng.integers(0, 3))] = math.nan
            elif luck < 0.1:
                u[8 + int(rng.integers(0, 2))] = 0.0  # not healthy, or not enabled
            blind, stuck = luck > 0.9, 0.8 < luck < 0.85
        u[3:5] = y + 0.002 * rng.standard_normal(2)
        if blind and rng.random() < 0.6:
            u[3:5] = (math.nan, math.inf, -math.inf, 57.0)[int(rng.integers(0, 4))]
        # Motors that follow at once, hang behind, or whose encoders say nothing.
        motors = before if stuck else out
        u[5:8] = motors if rng.random() < 0.999 else math.nan
        before = out.copy()
        step(controller.arrays, parameters, x, u, out)
        _note(seen, x, places, out, before, parameters)
        v = (T @ line[-1])[:2]
        line[1:] = line[:-1].copy()
        line[0] = out
        y = POLE * y + (1.0 - POLE) * (gain * v + load)
    seen.grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - first) / 1024.0
    return seen


def _note(
    seen: Soaked, x: np.ndarray, places: dict[str, int], out: np.ndarray, before: np.ndarray, parameters: np.ndarray
) -> None:
    status, slack = x[places["status"]], float(x[places["slack"]])
    seen.said[NAMES[status]] += 1
    seen.iterations = max(seen.iterations, int(x[places["iterations"]]))
    if status in (rt.MPC_OPTIMAL, rt.MPC_SOFT):
        seen.residual = max(seen.residual, float(x[places["residual"]]))
        seen.softest = max(seen.softest, slack)
        seen.silent += int(slack > 1e-6 and status != rt.MPC_SOFT)
    seen.position = max(seen.position, float(np.abs(out).max()) - parameters[0])
    seen.slew = max(seen.slew, float(np.abs(out - before).max()) / TS - parameters[1])
    seen.finite &= bool(np.isfinite(out).all() and math.isfinite(x.sum()))


def main() -> None:
    """Soak and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    controller = soft_controller()
    for name, value in vars(soak(controller, options.hours, options.seed)).items():
        print(f"{name}: {value}")
    print(f"bound of the iterations: {int(rt.MpcArrays(controller.arrays).constants[rt.MPC_BUDGET])}")


if __name__ == "__main__":
    main()
