"""The plausibility supervisor over many runs in virtual time; each part goes on where it was stopped.

`python benchmarks/supervisor.py baseline` writes what the tests compare with (480 s of motion, half a minute).
`... faults [--seeds 1000] [--row NAME]` plays every row of the table. `... undisturbed [--hours 30]` looks for false
alarms at 0 to 1 kg: it keeps the motion, which no supervisor changes that says nothing, and asks the charts again where
the baseline or the code changed. Results are lines of JSON under build/supervisor; `... report` prints the tables.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from softneck.core import file_hash
from softneck.drives.master import Phase
from softneck.drives.supervision._log import MotionLog
from softneck.drives.supervision._motor_models import Motion
from softneck.drives.supervision._plausibility import Plausibility
from tests.drives.plausible import BASELINE, PATH, ROWS, baseline, commissioned, kind_of, play, watched

FOLDER = Path("build/supervisor")
_MINUTES = 10.0
# Motion of the seeds before was looked at while the charts were made.
_FIRST = 18
_COLUMNS = ("setpoints", "positions", "tensions", "values", "rates", "due")
WIDTHS = (6, 9, 7, 9, 7, 6, 9, 12, 10)


def judged_by() -> str:
    """Return what a result hangs on: the baseline and the supervisor's text."""
    folders = ("softneck/drives/supervision", "softneck/signals/detection")
    files = [BASELINE, *(path for folder in folders for path in sorted(Path(folder).glob("*.py")))]
    return hashlib.sha256("".join(map(file_hash, files)).encode()).hexdigest()[:16]


def done(path: Path) -> Iterator[dict[str, Any]]:
    """Yield what earlier calls found with this baseline and this text."""
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            item = json.loads(line)
            if item["judged_by"] == judged_by():
                yield item


def add(path: Path, item: dict[str, Any]) -> None:
    """Append one result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({**item, "judged_by": judged_by()}) + "\n")


def faults(seeds: int, rows: list[str]) -> None:
    """Play the rows, seed by seed."""
    path = FOLDER / "faults.jsonl"
    known = {(item["row"], item["seed"]) for item in done(path)}
    for seed in range(seeds):
        # Payloads at which tendons are taut: at 1 kg they hang, and the tilt is not watched (see the docs).
        payload = float(np.random.default_rng([seed, 5]).uniform(0.0, 0.3))
        for name in rows:
            if (name, seed) not in known:
                found = play(ROWS[name], seed, payload=payload)
                add(path, {"row": name, "seed": seed, "payload": payload, "event": found.event, "after": found.after,
                           "beyond": found.beyond, "excited": found.excited})  # fmt: skip


def undisturbed(hours: float) -> None:
    """Ask the charts of motion without any fault, ten minutes each, and note what they say."""
    path = FOLDER / "undisturbed.jsonl"
    known = {item["seed"] for item in done(path)}
    for seed in range(_FIRST, _FIRST + math.ceil(hours * 60.0 / _MINUTES)):
        if seed in known:
            continue
        payload = float(np.random.default_rng([seed, 6]).uniform(0.0, 1.0))
        motion = moved(seed, payload)
        begin = time.process_time()
        told, valid = said(motion)
        cost = time.process_time() - begin
        add(path, {"seed": seed, "kind": kind_of(seed), "payload": payload, "seconds": len(motion.due) * 0.01,
                   "valid": valid, "told": told, "judged_s": cost})  # fmt: skip


def moved(seed: int, payload: float) -> Motion:
    """Return ten minutes of undisturbed motion, from the folder if it was played before."""
    path = FOLDER / "motion" / f"{seed}.npz"
    if not path.exists():
        bench, log = watched(seed, kind_of(seed), payload), MotionLog()
        bench.run.watches, bench.link.tap = (log,), None
        until = bench.now + 60.0 * _MINUTES
        while bench.phase is Phase.RUNNING and bench.now < until:
            bench.step()
        if bench.phase is not Phase.RUNNING:
            print(f"seed {seed}, {payload:.2f} kg: {bench.master.supervisor.fault}", file=sys.stderr)
        motion = log.motion()
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, **{name: getattr(motion, name) for name in _COLUMNS})
        part.replace(path)
    with np.load(path) as columns:
        return Motion(**{name: columns[name] for name in _COLUMNS})


def said(motion: Motion) -> tuple[list[tuple[float, str, str]], float]:
    """Return (time, event, detail) of all false alarms, and the part of the time in which the tilt's model holds."""
    told, valid = [], 0
    charts: Plausibility | None = None
    for k in range(len(motion.due)):
        if charts is None:
            charts = Plausibility(baseline())
            charts.begin()
        found = charts.cycle(motion.setpoints[k], motion.positions[k], motion.tensions[k])
        if motion.due[k] and found is None:
            values = motion.values[k] if np.isfinite(motion.values[k]).all() else None
            found = charts.sample(motion.positions[k], values, motion.rates[k])
        valid += charts.tilt.valid
        if found is not None:
            told.append((0.01 * k, found.name, found.detail))
            charts = None
    return told, valid / len(motion.due)


def report() -> None:
    """Print both tables."""
    items = list(done(FOLDER / "faults.jsonl"))
    titles = ("runs", "excited", "found", "in time", "named", "own", "< 3 deg", "median [s]", "95 % [s]")
    print(f"{'row':36}" + "".join(f"{title:>{width}}" for title, width in zip(titles, WIDTHS, strict=True)))
    for name, row in ROWS.items():
        runs = [item for item in items if item["row"] == name]
        if not runs:
            continue
        excited = [item for item in runs if item["excited"] or item["event"]]
        found = [item for item in excited if item["event"]]
        soon = [item for item in found if item["after"] <= row.limit + 1e-6]
        named = [item for item in found if item["event"] in row.names]
        own = [item for item in found if item["event"] == row.names[0]]
        near = [item for item in found if item["beyond"] <= PATH]
        after = sorted(max(item["after"], 0.0) for item in found) or [math.nan]
        print(f"{name:36}{len(runs):6}{len(excited):9}{len(found):7}{len(soon):9}{len(named):7}{len(own):6}{len(near):9}"
              f"{np.median(after):12.2f}{np.quantile(after, 0.95):10.2f}")  # fmt: skip
    calm = list(done(FOLDER / "undisturbed.jsonl"))
    hours = sum(item["seconds"] for item in calm) / 3600.0
    alarms = [(item, *told) for item in calm for told in item["told"]]
    told = sum(item["valid"] * item["seconds"] for item in calm) / 3600.0
    cost = sum(item["judged_s"] for item in calm) / 60.0
    print(f"undisturbed: {hours:.1f} h at 0 to 1 kg, the tilt watched by its model in {told:.1f} h of them; "
          f"{len(alarms)} false alarms; {hours / max(cost, 1e-9):.1f} h are judged in a processor minute")  # fmt: skip
    short = [item["payload"] for item in calm if item["seconds"] < 59.0 * _MINUTES]
    if short:
        print(f"  {len(short)} of {len(calm)} runs were over early by another guard, at {min(short):.2f} kg and more")
    for item, after, name, detail in alarms:
        run = f"seed {item['seed']}, {item['kind']}, {item['payload']:.2f} kg"
        print(f"  {run}, after {after:.0f} s: {name}: {detail}")


def main() -> None:
    """Do what the arguments ask."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("baseline", "faults", "undisturbed", "report"))
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--row", action="append", choices=list(ROWS))
    parser.add_argument("--hours", type=float, default=30.0)
    asked = parser.parse_args()
    if asked.part == "baseline":
        BASELINE.unlink(missing_ok=True)
        commissioned().save(BASELINE)
    elif asked.part == "faults":
        faults(asked.seeds, asked.row or list(ROWS))
    elif asked.part == "undisturbed":
        undisturbed(asked.hours)
    report()


if __name__ == "__main__":
    main()
