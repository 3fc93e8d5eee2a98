"""The plausibility supervisor over many runs in virtual time; each part goes on where it was stopped.

`python benchmarks/supervisor.py baseline` writes what the tests compare with (240 s of motion, a minute).
`... faults [--seeds 1000] [--row NAME]` plays every row of the table; `... undisturbed [--hours 30]` looks for false
alarms at 0 to 1 kg. Results are lines of JSON under build/supervisor; `... report` prints the tables.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from softneck.core import file_hash
from softneck.drives.master import Phase
from tests.drives.plausible import BASELINE, PATH, ROWS, commissioned, play, watched

FOLDER = Path("build/supervisor")
_MINUTES = 10.0
WIDTHS = (6, 9, 7, 9, 7, 9, 12, 10)


def done(path: Path) -> Iterator[dict[str, Any]]:
    """Yield what earlier calls found with this baseline."""
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            item = json.loads(line)
            if item["baseline"] == file_hash(BASELINE):
                yield item


def add(path: Path, item: dict[str, Any]) -> None:
    """Append one result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({**item, "baseline": file_hash(BASELINE)}) + "\n")


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
    """Run without any fault, ten minutes each, and note what was said."""
    path = FOLDER / "undisturbed.jsonl"
    known = {item["seed"] for item in done(path)}
    for seed in range(math.ceil(hours * 60.0 / _MINUTES)):
        if seed in known:
            continue
        kind, payload = ("step", "ramp", "open")[seed % 3], float(np.random.default_rng([seed, 6]).uniform(0.0, 1.0))
        bench = watched(seed, kind, payload)
        begin, told = bench.now, 0.0
        while bench.phase is Phase.RUNNING and bench.now < begin + 60.0 * _MINUTES:
            bench.step()
            plausible = bench.master._watches._plausible
            told += 0.0 if plausible is None else plausible.tilt.valid
        fault = bench.master.supervisor.fault
        seconds = bench.now - begin
        add(path, {"seed": seed, "kind": kind, "payload": payload, "seconds": seconds,
                   "valid": told * 0.01 / seconds, "event": "" if fault is None else str(fault),
                   "name": "" if fault is None else fault.name})  # fmt: skip


def report() -> None:
    """Print both tables."""
    items = list(done(FOLDER / "faults.jsonl"))
    titles = ("runs", "excited", "found", "in time", "named", "< 3 deg", "median [s]", "95 % [s]")
    print(f"{'row':36}" + "".join(f"{title:>{width}}" for title, width in zip(titles, WIDTHS, strict=True)))
    for name, row in ROWS.items():
        runs = [item for item in items if item["row"] == name]
        if not runs:
            continue
        excited = [item for item in runs if item["excited"] or item["event"]]
        found = [item for item in excited if item["event"]]
        time = [item for item in found if item["after"] <= row.limit + 1e-6]
        named = [item for item in found if item["event"] in row.names]
        near = [item for item in found if item["beyond"] <= PATH]
        after = sorted(max(item["after"], 0.0) for item in found) or [math.nan]
        print(f"{name:36}{len(runs):6}{len(excited):9}{len(found):7}{len(time):9}{len(named):7}{len(near):9}"
              f"{np.median(after):12.2f}{np.quantile(after, 0.95):10.2f}")  # fmt: skip
    calm = list(done(FOLDER / "undisturbed.jsonl"))
    hours = sum(item["seconds"] for item in calm) / 3600.0
    alarms = [item for item in calm if item["name"]]
    told = sum(item["valid"] * item["seconds"] for item in calm) / 3600.0
    print(f"undisturbed: {hours:.1f} h at 0 to 1 kg, the tilt watched by its model in {told:.1f} h of them; "
          f"{len(alarms)} false alarms")  # fmt: skip
    for item in alarms:
        run = f"seed {item['seed']}, {item['kind']}, {item['payload']:.2f} kg"
        print(f"  {run}, after {item['seconds']:.0f} s: {item['event']}")


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
