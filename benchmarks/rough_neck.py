"""Search the preset `rough`, or print how hard it is for a line beside the paper's neck and the preset `paper`.

`python benchmarks/rough_neck.py table`: gains, poles and free-run fits under Eq. 22 and the three tests.
`python benchmarks/rough_neck.py search [--seed N]`: least squares over the numbers in `START` from there (seed 0) or
from about there. Every neck that was tried is kept in `build/rough_neck`: a search that was stopped goes on where it
was. They are of the code that computed them: use --fresh after a change.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares as minimise

from softneck.core import Matrix, SettingsError, Vector, silent
from softneck.identification import INFINITE, Model, Rls, validate
from softneck.identification.models._linear_systems import continuous_parameters
from softneck.plant import NeckParameters
from softneck.report._demo_steps import Experiments, record_experiments
from softneck.signals import redefine
from tests.foreign_necks.kept import keep, kept_lines
from tests.oracles.one_pole import (
    PAPER_FITS,
    PAPER_GAINS,
    PAPER_POLES,
    OnePole,
    fits,
    least_squares,
    output_error,
)

OUT = Path("build/rough_neck")
# Where the search begins, found by hand and by coarser searches, and how far a step of one goes: in parts where
# positive, else in its unit.
# `across` and `along` are the asymmetry's sine and cosine parts, a sin(2 angle) and a cos(2 angle).
START = {
    "bending_stiffness": (0.56, 0.3), "bending_damping": (0.055, 0.5), "along": (0.17, 0.15), "across": (0.33, 0.15),
    "rest_pitch": (-0.019, 0.03), "rest_roll": (-0.014, 0.03), "tendon_angle_2": (2.07, 0.08),
    "tendon_angle_3": (4.19, 0.08), "pretension": (1.7, 0.4), "guide_friction": (0.069, 0.5),
    "position_gain": (24.5, 0.3), "speed_limit": (4.07, 0.2), "drive_latency": (0.08, 0.2), "sensor_delay": (0.07, 0.2),
}  # fmt: skip
_SIGNED = ("along", "across", "rest_pitch", "rest_roll", "tendon_angle_2", "tendon_angle_3")
# What one unit of cost is: points of a fit beyond those that are free, parts of a gain and of a pole, steps away from
# the start.
_FREE, _POINTS, _GAIN, _POLE, _STEPS = 3.5, 0.7, 0.04, 0.3, 8.0


def neck_of(x: Vector) -> NeckParameters:
    """Return the neck at `x`, one for each of `START`; 1 is the start."""
    values = {
        name: start + scale * (part - 1.0) if name in _SIGNED else start * math.exp(scale * (part - 1.0))
        for part, (name, (start, scale)) in zip(x.tolist(), START.items(), strict=True)
    }
    along, across = values.pop("along"), values.pop("across")
    values |= {"stiffness_asymmetry": math.hypot(along, across), "stiffness_angle": 0.5 * math.atan2(across, along)}
    return NeckParameters.paper().replace(**values)


def experiments_of(neck: NeckParameters) -> Experiments:
    """Return the paper's four records, with the demo's seeds."""
    return record_experiments(neck, duration=200.0, tell=lambda _: silent)


def lines(found: Experiments, estimator: Callable[[Vector, Vector], OnePole]) -> tuple[tuple[OnePole, OnePole], Matrix]:
    """Return the one-pole models of pitch and roll, and their fits on the four records (record, axis) [%]."""
    U, Y = redefine(found.identification.set_points), found.identification.outputs
    models = (estimator(U[:, 0], Y[:, 0]), estimator(U[:, 1], Y[:, 1]))
    return models, fits(models, [(redefine(r.set_points), r.outputs) for r in found.judged.values()])


def searched(found: Experiments) -> tuple[Model, Matrix]:
    """Return `rls` with its defaults and its fits, as `softneck reproduce-paper` has them."""
    model = Rls().fit(found.identification)
    judged = [validate(model, r, horizons=(INFINITE,)).fits[INFINITE].values() for r in found.judged.values()]
    return model, np.array([[-1e3 if fit is None else fit for fit in row] for row in judged])


def cost(x: Vector, pole: float) -> Vector:
    """Return what is to be small: differences from the paper in fits, gains and poles, and the way from the start."""
    try:
        found = experiments_of(neck_of(x))
    except SettingsError:  # buckles, or leaves a range
        return np.full(20 + x.size, 1e3)
    models, scores = lines(found, least_squares)
    return np.concatenate([
        _beyond(scores - PAPER_FITS),
        _beyond(searched(found)[1] - PAPER_FITS),
        [(math.degrees(model.gain) / wanted - 1.0) / _GAIN for model, wanted in zip(models, PAPER_GAINS, strict=True)],
        [(model.pole / wanted - 1.0) / pole for model, wanted in zip(models, PAPER_POLES, strict=True)],
        (x - 1.0) / _STEPS,
    ])  # fmt: skip


def _beyond(difference: Matrix) -> Vector:
    return np.ravel(np.sign(difference) * np.maximum(0.0, np.abs(difference) - _FREE) / _POINTS)


def search(seed: int, pole: float, *, fresh: bool) -> None:
    """Search, telling of each neck that is better than all before."""
    kept = OUT / f"seed{seed}-pole{pole:g}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    known: dict[tuple[float, ...], Vector] = {}
    for line in kept_lines(kept):
        known[tuple(line["x"])] = np.array(line["cost"])
    best = math.inf

    def tried(x: Vector) -> Vector:
        nonlocal best
        key = tuple(x.tolist())
        if key not in known:
            known[key] = cost(x, pole)
            keep(kept, {"x": key, "cost": known[key].tolist()})
        total = float(known[key] @ known[key])
        if total < best:
            best = total
            print(
                f"  cost {total:.2f}, fits within {_FREE + _POINTS * np.abs(known[key][:16]).max():.1f} points",
                flush=True,
            )
        return known[key]

    x0 = np.ones(len(START))
    if seed:
        x0 += 0.5 * np.random.default_rng(seed).standard_normal(x0.size)
    # A twentieth of a step: the fits are rough below that, where tendons fall slack a sample earlier or later.
    minimise(tried, x0, diff_step=0.05, bounds=(-4.0, 6.0), max_nfev=30, ftol=1e-3, xtol=1e-3)
    # Of all that were tried, the one whose worst fit is closest.
    closest = min(known, key=lambda x: np.abs(known[x][:16]).max())
    neck, paper = neck_of(np.array(closest)), NeckParameters.paper()
    for name in neck.names():
        if getattr(neck, name) != getattr(paper, name):
            print(f'    "{name}": {getattr(neck, name):.4g},')


def table() -> None:
    """Print the paper's figures, then those of `paper` and `rough` by three estimators."""
    print("| | gain [deg/rad] | pole [1/s] | validation | steps | sine | rotation |\n|---|---|---|---|---|---|---|")
    _row("the paper", PAPER_GAINS, PAPER_POLES, PAPER_FITS)
    for name in ("paper", "rough"):
        found = experiments_of(NeckParameters.preset(name))
        for title, estimator in (("least squares, 0.08 s", least_squares), ("output error, 0.08 s", output_error)):
            models, scores = lines(found, estimator)
            gains = [math.degrees(model.gain) for model in models]
            _row(f"`{name}`, {title}", gains, [model.pole for model in models], scores)
        model, scores = searched(found)
        linear = [continuous_parameters(model.sample_time, model.arrays, axis) or (math.nan,) * 3 for axis in (0, 1)]
        gains, poles = [math.degrees(K / p) for K, p, _ in linear], [p for _, p, _ in linear]
        _row(f"`{name}`, `rls`, dead time searched", gains, poles, scores)


def _row(title: str, gains: Sequence[float], poles: Sequence[float], scores: Matrix) -> None:
    cells = [f"{pitch:.2f}, {roll:.2f}" for pitch, roll in (gains, poles)]
    cells += [f"{pitch:.0f}/{roll:.0f}" for pitch, roll in scores]
    print(f"| {title} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Read the command line and do one of the two."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("table", "search"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pole", type=float, default=_POLE, help=f"part of a pole that costs one unit ({_POLE:g})")
    parser.add_argument("--fresh", action="store_true", help="try everything again")
    wanted = parser.parse_args()
    if wanted.what == "table":
        table()
    else:
        search(wanted.seed, wanted.pole, fresh=wanted.fresh)


if __name__ == "__main__":
    main()
