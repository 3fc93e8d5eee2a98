"""The plausibility supervisor over many runs in virtual time; each part goes on where it was stopped.

`python benchmarks/supervisor.py baseline` writes what the tests compare with (1,440 s of motion, half a minute).
`... faults [--seeds 1000] [--row NAME]` plays every row of the table, each from a fork of the run before its fault.
`... undisturbed [--hours 30]` looks for false alarms at 0 to 1 kg: it keeps the motion (`... motion` plays that alone),
which no supervisor changes that says nothing, and asks the charts again where the baseline or the code changed. Results
are lines of JSON under build/supervisor; `... report` prints the tables, and which faults are told apart; `--first`
SEED begins elsewhere, where nobody looked, and reports what was found from there on.
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
from scipy.stats import beta, chi2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from softneck.core import Matrix, file_hash
from softneck.drives.supervision._motor_models import Motion
from softneck.drives.supervision._plausibility import Plausibility
from tests.drives.broken import PATH, ROWS, play_all
from tests.drives.plausible import BASELINE, PAYLOADS, baseline, commissioned, kind_of, watched
from tests.drives.undisturbed import undisturbed as motion_of

FOLDER = Path("build/supervisor")
_MINUTES = 10.0
# Motion, and faults, of the seeds before were looked at while the charts were made.
_FIRST, _FIRST_FAULT = 68, 64
_EACH, _SAMPLED = ("setpoints", "positions", "tensions"), ("values", "rates")
TITLES = {"runs": 6, "excited": 9, "found": 7, "in time": 9, "least": 8, "named": 7, "own": 6, "< 3 deg": 9,
          "least ": 8, "median [s]": 12, "95 % [s]": 10}  # fmt: skip


def judged_by() -> str:
    """Return what a result hangs on: the baseline and the supervisor's text."""
    folders = ("softneck/drives/supervision",)
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


def faults(first: int, seeds: int, rows: list[str]) -> None:
    """Play the rows, seed by seed."""
    path = FOLDER / "faults.jsonl"
    known = {(item["row"], item["seed"]) for item in done(path)}
    for seed in range(first, first + seeds):
        # Payloads at which tendons are taut: at 1 kg they hang, and the tilt is not watched (see the docs).
        payload = float(np.random.default_rng([seed, 5]).uniform(0.0, 0.3))
        left = {name: ROWS[name] for name in rows if (name, seed) not in known}
        for name, found in play_all(left, seed, payload=payload) if left else ():
            add(path, {"row": name, "seed": seed, "payload": payload, "event": found.event, "after": found.after,
                       "beyond": found.beyond, "excited": found.excited, "showed": found.showed})  # fmt: skip


def undisturbed(first: int, hours: float, *, judge: bool = True) -> None:
    """Ask the charts of motion without any fault, ten minutes each, and note what they say; or play it only."""
    path = FOLDER / "undisturbed.jsonl"
    known = {item["seed"] for item in done(path)}
    for seed in range(first, first + math.ceil(hours * 60.0 / _MINUTES)):
        if seed in known:
            continue
        payload = float(np.random.default_rng([seed, 6]).uniform(0.0, 1.0))
        motion, references, ended = moved(seed, payload)
        if not judge:
            continue
        begin = time.process_time()
        told, valid = said(motion, references)
        cost = time.process_time() - begin
        add(path, {"seed": seed, "kind": kind_of(seed), "payload": payload, "seconds": len(motion.due) * 0.01,
                   "ended": ended, "valid": valid, "told": told, "judged_s": cost})  # fmt: skip


def moved(seed: int, payload: float) -> tuple[Motion, Matrix, str]:
    """Return ten minutes of undisturbed motion with its references, and what ended it early ("").

    It is taken from the folder if it was played before.
    """
    path = FOLDER / "motion" / f"{seed}.npz"
    if not path.exists():
        motion, references, why = motion_of(watched(seed, kind_of(seed), payload), 60.0 * _MINUTES)
        path.parent.mkdir(parents=True, exist_ok=True)
        part, due = path.with_suffix(".part.npz"), motion.due
        each = {name: getattr(motion, name) for name in _EACH}
        sampled = {name: getattr(motion, name)[due] for name in _SAMPLED}
        np.savez(part, **each, **sampled, references=references[due], due=due, why=why)
        part.replace(path)
    with np.load(path) as columns:
        due = columns["due"]
        rows = {name: np.full((len(due), columns[name].shape[1]), np.nan) for name in (*_SAMPLED, "references")}
        for name, values in rows.items():
            values[due] = columns[name]
        references = rows.pop("references")
        return Motion(**{name: columns[name] for name in _EACH}, **rows, due=due), references, str(columns["why"])


def said(motion: Motion, references: Matrix) -> tuple[list[tuple[float, str, str]], float]:
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
            found = charts.sample(motion.positions[k], values, motion.rates[k], references[k])
        valid += charts.tilt.valid
        if found is not None:
            told.append((0.01 * k, found.name, found.detail))
            charts = None
    return told, valid / len(motion.due)


def report(first: int) -> None:
    """Print both tables, of the seeds from `first` on."""
    items = [item for item in done(FOLDER / "faults.jsonl") if item["seed"] >= first]
    print(f"{'row':36}" + "".join(f"{title:>{width}}" for title, width in TITLES.items()))
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
        print(f"{name:36}{len(runs):6}{len(excited):9}{len(found):7}{len(soon):9}{least(len(soon), len(excited)):>8}"
              f"{len(named):7}{len(own):6}{len(near):9}{least(len(near), len(found)):>8}"
              f"{np.median(after):12.2f}{np.quantile(after, 0.95):10.2f}")  # fmt: skip
    for name, row in ROWS.items():
        runs = [item for item in items if item["row"] == name]
        if runs and row.shows < math.inf:
            shown = [item for item in runs if item["event"] or item["showed"] > row.limit]
            soon = sum(item["event"] != "" and item["showed"] <= row.limit + 1e-6 for item in shown)
            print(f"  {name}, {row.limit:g} s after {math.degrees(row.shows):.1f} deg off the path without it: "
                  f"{soon} of {len(shown)}, at least {least(soon, len(shown))}")  # fmt: skip
    told_apart(items)
    calm = [item for item in done(FOLDER / "undisturbed.jsonl") if item["seed"] >= first]
    known = max(PAYLOADS)
    for what, runs in (
        (f"0 to {known:g} kg, as the experiments", [item for item in calm if item["payload"] <= known]),
        ("more, up to 1 kg", [item for item in calm if item["payload"] > known]),
    ):
        hours = sum(item["seconds"] for item in runs) / 3600.0
        told = sum(item["valid"] * item["seconds"] for item in runs) / 3600.0
        alarms = sum(len(item["told"]) for item in runs)
        # What a Poisson process of a larger rate shows more of with 95 % (Garwood 1936).
        most = float(chi2.ppf(0.95, 2 * alarms + 2)) / 2.0
        print(f"undisturbed, {what}: {hours:.1f} h, the tilt watched by its model in {told:.1f} h of them; {alarms} "
              f"false alarms: less than one in {hours / most:.1f} h at 95 %")  # fmt: skip
    cost = sum(item["judged_s"] for item in calm) / 60.0
    print(
        f"  {sum(item['seconds'] for item in calm) / 3600.0 / max(cost, 1e-9):.1f} h are judged in a processor minute"
    )
    short = [item for item in calm if item["ended"]]
    print(f"  {len(short)} of {len(calm)} runs were ended early by another guard")
    for item in short:
        print(f"  seed {item['seed']}, {item['kind']}, {item['payload']:.2f} kg: {item['ended']}")
    for item in calm:
        for after, name, detail in item["told"]:
            run = f"seed {item['seed']}, {item['kind']}, {item['payload']:.2f} kg"
            print(f"  {run}, after {after:.0f} s: {name}: {detail}")


def least(good: int, of: int) -> str:
    """Return which share holds at least, with 95 % confidence [%] (Clopper and Pearson 1934, one-sided)."""
    return f"{100.0 * float(beta.ppf(0.05, good, of - good + 1)):.0f} %" if good else "0 %"


def told_apart(items: list[dict[str, Any]]) -> None:
    """Print which event each row got in how many of its runs: what cannot be told apart shares a column."""
    names = sorted({item["event"] for item in items} - {""})
    for k, name in enumerate(names):
        print(f"  {chr(97 + k)}: {name}")
    print(f"{'row, told as':36}" + "".join(f"{chr(97 + k):>5}" for k in range(len(names))) + f"{'none':>6}")
    for row in ROWS:
        events = [item["event"] for item in items if item["row"] == row]
        counts = [events.count(name) for name in names]
        if events:
            print(f"{row:36}" + "".join(f"{count or '.':>5}" for count in counts) + f"{events.count(''):6}")


def main() -> None:
    """Do what the arguments ask."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("baseline", "faults", "motion", "undisturbed", "report"))
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--row", action="append", choices=list(ROWS))
    parser.add_argument("--hours", type=float, default=30.0)
    parser.add_argument("--first", type=int)
    asked = parser.parse_args()
    if asked.part == "baseline":
        BASELINE.unlink(missing_ok=True)
        commissioned().save(BASELINE)
    elif asked.part == "faults":
        faults(_FIRST_FAULT if asked.first is None else asked.first, asked.seeds, asked.row or list(ROWS))
    elif asked.part in ("motion", "undisturbed"):
        undisturbed(_FIRST if asked.first is None else asked.first, asked.hours, judge=asked.part == "undisturbed")
    report(asked.first or 0)


if __name__ == "__main__":
    main()
