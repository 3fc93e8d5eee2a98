"""Choose what `softneck tune` keeps back of its limits, on all necks but one, and judge it on that one, in turn.

`python benchmarks/tune_reserve.py [--necks NECK...] [--candidates N] [--fresh]`

`tune` sees grey boxes of two payloads; the robot is not quite as they are. On each neck controllers are drawn around
the start of `tune`'s search, with what a user would record (benchmarks/tune.py). Those whose loops, as `tune` judges
them, are at most half beyond each limit are run on the neck itself. The reserve of a requirement is the least with
which 95 % of the candidates that keep the limit less it, as `tune` sees them, truly keep it. It is taken from all necks
but one; on that one it is counted how many of the candidates that keep a requirement truly do, without the reserve and
with it. The last row is of all necks: [reserve] of softneck/tuning/requirements.toml. Results are kept in
`build/tune_reserve`; --fresh after a change.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.tune import GOALS, known, seconds, truth
from softneck.core import SoftneckError
from softneck.tuning._judge import design_candidate, loop_metrics, prepare
from softneck.tuning._search import STEP
from softneck.tuning._space import spaces
from softneck.tuning._tune import task_of
from tests.foreign_necks.necks import CHOOSING

OUT = Path("build/tune_reserve")
KINDS = ("pi", "pid", "lqg", "hinf")
METRICS = {"overshoot": "sim.overshoot_pct", "rise": "sim.rise_s", "steady": "sim.steady_rms_deg",
           "circle": "track.circle_rms_deg", "ahead": "track.ahead_rms_deg"}  # fmt: skip
# What is further beyond a limit no search returns.
_BEYOND = 1.5
# So many that keep a limit less its reserve truly keep it; of fewer candidates nothing is said.
_TRUE, _FEW = 0.95, 5

# Of a candidate: goal -> [what `tune` saw, what the neck does].
Pairs = list[dict[str, list[float]]]


def pairs(neck: str, count: int) -> Pairs:
    """Return the pairs of each candidate; made once and kept."""
    kept = OUT / f"{neck}.json"
    if not kept.exists():
        begin, rows = seconds(), []
        task = replace(task_of(known(neck), {"reserve": dict.fromkeys(METRICS.values(), 0.0)}, 0), digest=neck)
        ready = prepare(task)
        for number, space in enumerate(
            spaces(KINDS, rise=GOALS["rise"], cocontraction=task.cocontraction, robot=task.robot)
        ):
            rng = np.random.default_rng(number)
            for x in space.start + STEP * rng.standard_normal((count, space.start.size)):
                try:
                    controller = design_candidate(task, ready, space.kind, space.settings(np.clip(x, 0.0, 1.0)))
                except SoftneckError:
                    continue
                seen = loop_metrics(task, ready, controller.block(), "sequential", ready.all)
                if all(seen[name] <= _BEYOND * GOALS[goal] for goal, name in METRICS.items()):
                    true = truth(neck, controller, seen["track.ahead_s"])
                    rows.append({goal: [seen[name], true[goal]] for goal, name in METRICS.items()})
        kept.write_text(json.dumps(rows))
        print(f"  {neck}: {len(rows)} candidates, {seconds() - begin:.0f} s", file=sys.stderr, flush=True)
    return json.loads(kept.read_text())


def reserve(found: dict[str, Pairs], goal: str) -> float:
    """Return the least reserve, in hundredths of the limit, with which nearly all that keep the limit less it are true.

    None where too few candidates would keep it: then plants do not show what the neck does, and no reserve mends that.
    """
    limit = GOALS[goal]
    every = [row[goal] for rows in found.values() for row in rows]
    for back in (limit * k / 100.0 for k in range(100)):
        kept = [true <= limit for seen, true in every if seen <= limit - back]
        if len(kept) < _FEW:
            break
        if np.mean(kept) >= _TRUE:
            return back
    return 0.0


def told(rows: Pairs, back: dict[str, float]) -> str:
    """Return how many of the candidates that keep some requirements less a reserve truly do."""
    said = [row for row in rows if all(row[goal][0] <= GOALS[goal] - part for goal, part in back.items())]
    true = sum(all(row[goal][1] <= GOALS[goal] for goal in back) for row in said)
    return f"{true} of {len(said)}"


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--necks", nargs="*", default=CHOOSING, choices=CHOOSING)
    parser.add_argument("--candidates", type=int, default=12, help="Of each kind.")
    parser.add_argument("--fresh", action="store_true", help="Forget what is kept.")
    asked = parser.parse_args()
    if asked.fresh:
        shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True, exist_ok=True)
    found = {neck: pairs(neck, asked.candidates) for neck in asked.necks}
    names = " | ".join(f"{goal}: reserve; true without; with" for goal in GOALS)
    print(f"| left out | {names} | all: true without; with |\n|{'---|' * (len(GOALS) + 2)}")
    for neck, rows in found.items():
        others = {other: each for other, each in found.items() if other != neck}
        back = {goal: reserve(others, goal) for goal in GOALS}
        cells = [f"{part:.3g}; {told(rows, {goal: 0.0})}; {told(rows, {goal: part})}" for goal, part in back.items()]
        print(f"| {neck} | {' | '.join(cells)} | {told(rows, dict.fromkeys(GOALS, 0.0))}; {told(rows, back)} |")
    print("| none | " + " | ".join(f"{reserve(found, goal):.3g}" for goal in GOALS) + " | |")


if __name__ == "__main__":
    main()
