"""Choose how large a hole in the lengths of a clock's steps tells a gap from jitter, by leaving out clocks.

`python benchmarks/clock_gaps.py [--seeds N] [--models]`

Stand-in clocks that lose nothing, that pause (5 to 60 rows, six times) and that lose rows one by one, of 300 and 3,000
rows. A value's cost for a clock: the times that it splits what lost nothing, and the share of lost rows that it
bridges. Each clock is judged by the value that is best for all others; the last line is the value that is best for all.
`--models`: what models are worth (`oe` and `rls`, free run on another recording) where a logger drops single rows of
80 s, one in so many, and these are missed samples, or split the run; minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from softneck.core import Vector
from softneck.identification import OutputError, Rls, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal
from softneck.signals.importing._clocks import fill_gaps
from softneck.signals.recording._resampling import Samples, find_gaps, split_at_gaps

HOLES = (1.02, 1.05, 1.1, 1.15, 1.2, 1.3, 1.5)
SIZES = (300, 3000)
Clock = Callable[[np.random.Generator, int], Vector]


def _stamped(late: Callable[[np.random.Generator, int], Vector]) -> Clock:
    """Rows at an even rate whose stamps are off by some part of a step; none before the one before."""
    return lambda rng, n: np.maximum.accumulate(np.arange(n) + late(rng, n)) + 1e-6 * np.arange(n)


def clocks() -> dict[str, Clock]:
    """Return name -> times in usual steps."""
    named: dict[str, Clock] = {
        "steady": _stamped(lambda rng, n: 0.01 * rng.standard_normal(n)),
        "whole ms of 13.4": lambda _rng, n: np.round(np.arange(n) * 13.37) / 13.37,
        "two rows at once": _stamped(lambda rng, n: 0.9 * (rng.random(n) < 0.1) + 0.01 * rng.standard_normal(n)),
    }
    for part in (0.1, 0.2, 0.3):
        named |= {
            f"stamps within {part:g}": _stamped(lambda rng, n, a=part: rng.uniform(-a, a, n)),
            f"stamps of std {part:g}": _stamped(lambda rng, n, a=part: a * rng.standard_normal(n)),
            f"late by {part:g}": _stamped(lambda rng, n, a=part: rng.exponential(a, n)),
            f"loops of std {part:g}": lambda rng, n, a=part: np.cumsum(np.exp(a * rng.standard_normal(n))),
            f"sleeps and {part:g}": lambda rng, n, a=part: np.cumsum(1.0 + rng.exponential(a, n)),
        }
    return named


def cost(clock: Clock, hole: float, seeds: int) -> tuple[float, float, float]:
    """Return mean splits of whole logs, the share of pauses and that of single rows that are bridged."""
    found = []
    for n in SIZES:
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            t = clock(rng, n)
            late = np.zeros(n)
            at = np.sort(rng.choice(np.arange(20, n - 20), 6, replace=False))
            for k in at:
                late[k:] += rng.uniform(5.0, 60.0)
            paused = 1.0 - _gaps(t + late, hole)[at - 1].mean()
            bridged = []
            for rate in (0.002, 0.02, 0.08):
                there = rng.random(n) > rate
                there[[0, -1, n // 2]] = True, True, False
                missing = np.diff(np.flatnonzero(there)) > 1
                bridged.append(1.0 - _gaps(t[there], hole)[missing].mean())
            found.append((_gaps(t, hole).sum(), paused, np.mean(bridged)))
    whole, paused, bridged = np.mean(found, axis=0)
    return float(whole), float(paused), float(bridged)


def _gaps(time: Vector, hole: float) -> np.ndarray:
    return find_gaps(Samples(time, np.zeros(time.size, dtype=np.int64), {}), hole)[0]


def models(seeds: int) -> None:
    """Print the fits of models of filled and of split recordings."""
    neck = VirtualNeck(NeckParameters.paper())
    whole, other = (record(signal("mixed", duration=t, seed=s), neck, seed=s) for t, s in ((80.0, 1), (40.0, 7)))
    print("| one row lost in | of missed samples, oe/rls [%] | of split runs |\n|---|---|---|")
    for rows in (15, 50, 150):
        fits = []
        for seed in range(seeds):
            there = np.ones(len(whole), dtype=bool)
            there[np.random.default_rng(seed).choice(np.arange(1, len(whole) - 1), len(whole) // rows)] = False
            logged = Samples(whole.time, whole.run, whole.channels).rows(there)
            for found in (fill_gaps(logged, whole.robot, always=True)[0], split_at_gaps(logged)[0]):
                known = Recording(found.time, whole.sample_time, found.channels, found.run, whole.robot)
                for kind in (OutputError, Rls):
                    judged = validate(kind().fit(known), other, horizons=("inf",)).fits["inf"]
                    fits.append(min(fit for fit in judged.values() if fit is not None))
        missed, split = np.array(fits).reshape(seeds, 2, 2).mean(axis=0)
        print(f"| {rows} | {missed[0]:.1f}/{missed[1]:.1f} | {split[0]:.1f}/{split[1]:.1f} |", flush=True)


def main() -> None:
    """Print a row a clock, and the choice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--models", action="store_true")
    asked = parser.parse_args()
    seeds = asked.seeds
    if asked.models:
        models(seeds)
        return
    table = {name: [cost(clock, hole, seeds) for hole in HOLES] for name, clock in clocks().items()}
    total = {name: np.array(row).sum(axis=1) for name, row in table.items()}
    print("| clock | best for the others | splits of a whole log | pauses bridged | lost rows bridged |")
    print("|---|---|---|---|---|")
    for name, row in table.items():
        best = int(np.argmin(sum(total[other] for other in total if other != name)))
        whole, paused, bridged = row[best]
        print(f"| {name} | {HOLES[best]:g} | {whole:.2f} | {100 * paused:.0f} % | {100 * bridged:.0f} % |")
    print(f"\nbest for all: {HOLES[int(np.argmin(sum(total.values())))]:g}")


if __name__ == "__main__":
    main()
