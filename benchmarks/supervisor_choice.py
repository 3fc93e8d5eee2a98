"""How constants of the plausibility supervisor are chosen: a kind of motion is left out, the others choose.

`python benchmarks/supervisor_choice.py [--seeds 9]` plays faults and undisturbed motion of seeds that no table judges,
calibrates each candidate on half of the commissioning run, and prints the mean time to an event of each kind of motion
(steps, ramps, open loop; no event: 6 s; a false alarm in two minutes of 0 to 1 kg: 6 s more), and what each kind left
out gets from the others' choice.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from softneck.drives import default_drives
from softneck.drives.supervision._baseline import Baseline
from softneck.drives.supervision._calibrate import calibrate
from softneck.drives.supervision._motor_models import Motion, MotionLog
from softneck.drives.supervision._plausibility import Plausibility
from tests.drives.bench import T
from tests.drives.broken import ROWS, Row, _excited, break_at, calm_run
from tests.drives.plausible import LOOPS, PAYLOADS, experiments, kind_of, looped, watched
from tests.drives.undisturbed import undisturbed
from tests.foreign_necks.choosing import leave_one_out

# Far from those of the table and of the tests.
FIRST = 50_000
LATEST = 6.0


# Parts of the largest slow error that the tilt's charts take for no fault: the code's own first.
CANDIDATES = [0.25, 0.5, 1.0]


class Played(NamedTuple):
    """One run: its motion, and the cycle in which its fault was excited (-1: there is none)."""

    kind: str
    motion: Motion
    excited: int


def broken(row: Row, seed: int, payload: float) -> Played | None:
    """Return a run that breaks and that nobody judges; None where nothing excites the fault."""
    calm = calm_run(seed, payload, 7.0 + LATEST)
    bench, log = watched(seed, kind_of(seed), payload, gyro=row.gyro), MotionLog()
    bench.run.watches = (log,)
    k = 0 if row.early else break_at(seed)
    bench.pass_time(k * T)
    excited = _excited(row, calm, k)
    if excited >= k + round(LATEST / T):
        return None
    row.breaks(bench)
    bench.pass_time((excited - k) * T + LATEST)
    return Played(kind_of(seed), log.motion(), excited)


def runs(seeds: int) -> list[Played]:
    """Return all that is judged; half a minute each without a fault."""
    played: list[Played] = []
    for seed in range(FIRST, FIRST + seeds):
        payload = float(np.random.default_rng([seed, 5]).uniform(0.0, 0.3))
        ours = [row for row in ROWS.values() if not (row.loop and kind_of(seed) == "open")]
        played += [run for row in ours if (run := broken(row, seed, payload)) is not None]
        calm, references, _ = undisturbed(watched(seed, kind_of(seed), payload / 0.3), 120.0)
        played.append(Played(kind_of(seed), with_references(calm, references), -1))
    return played


def with_references(motion: Motion, references: np.ndarray) -> Motion:
    """Return it with what its loop wanted."""
    return Motion(**{name: getattr(motion, name) for name in motion.__dataclass_fields__ if name != "references"},
                  references=references)  # fmt: skip


def first(motion: Motion, judged: Baseline) -> int:
    """Return the cycle of the first event, -1 for none."""
    charts = Plausibility(judged)
    charts.begin()
    none = np.full(motion.values.shape, np.nan)
    references = none if motion.references is None else motion.references
    for k in range(len(motion.due)):
        found = charts.cycle(motion.setpoints[k], motion.positions[k], motion.tensions[k])
        if motion.due[k] and found is None:
            values = motion.values[k] if np.isfinite(motion.values[k]).all() else None
            found = charts.sample(motion.positions[k], values, motion.rates[k], references[k])
        if found is not None:
            return k
    return -1


def cost(run: Played, judged: Baseline) -> float:
    """Return the time to the event [s]."""
    k = first(run.motion, judged)
    if run.excited < 0:
        return LATEST if k >= 0 else 0.0
    return LATEST if k < 0 else min(max(0.0, (k - run.excited) * T), LATEST)


def half() -> list[Motion]:
    """Return half of the commissioning run: its first two experiments and a loop with each payload."""
    motions = [motion for payload in PAYLOADS for motion in experiments(None, payload)[:2]]
    return motions + [looped(seed, kind, payload) for payload in PAYLOADS for kind, seed in LOOPS]


def main() -> None:
    """Print the choice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=9)
    played, motions = runs(parser.parse_args().seeds), half()
    kinds = sorted({run.kind for run in played})
    table: dict[str, Any] = {kind: [] for kind in kinds}
    for candidate in CANDIDATES:
        judged = calibrate(motions, cycle=T, sample_cycles=2, slack=default_drives().limits.slack,
                           known_bias=candidate)  # fmt: skip
        costs = {kind: [cost(run, judged) for run in played if run.kind == kind] for kind in kinds}
        for kind in kinds:
            table[kind].append(float(np.mean(costs[kind])))
        print(f"bias {candidate:4g}: " + ", ".join(f"{kind} {table[kind][-1]:.3f} s" for kind in kinds), flush=True)
    for fold in leave_one_out({kind: np.array([row]) for kind, row in table.items()}, 0):
        print(
            f"left out {fold.left_out:5} others choose bias {CANDIDATES[fold.chosen]:g}: "
            f"{fold.ratios[fold.chosen]:.2f} of the code's, its best {fold.ratios[fold.best]:.2f}"
        )


if __name__ == "__main__":
    main()
