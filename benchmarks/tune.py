"""Hold what `softneck tune` returns against necks on which nothing was chosen.

`python benchmarks/tune.py [--necks NECK...] [--kinds KIND...] [--budget N] [--seed N] [--workers N] [--best |
--defaults [--set NAME=VALUE...]] [--fresh]`

For each neck what docs/howto/payloads.md tells a user to do: the least co-contraction at which the large experiment is
heard with 1 kg; from Eq. 22 and multisines of small and large amplitude at 0.32 and 1 kg, played around it, a family,
and from Eq. 22 a grey box of both payloads. `tune` gets those alone. What it returns, and the best of every other kind
that it judged by all loops, is then run on the neck itself: steps of 15 deg in three directions with 0.32, 0.66 and 1
kg, and a circle of 12 deg at 1.2 rad/s, known ahead by as much as `tune` says and not; beside each kind what its
defaults do, unless --best. Angles are those that the neck's sensor tells. With --defaults what a plain `design` makes
is run instead, at the same co-contraction, with what --set
says. Nothing is chosen here. Recordings' models are kept in `build/tune`; --fresh forgets them.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import softneck
from benchmarks.promises import AMPLITUDES, SHOWN, Sensed, block_of, experiments, recorded, taut
from softneck.core import KINDS, resolve
from softneck.identification import FamilySettings, GreyBox
from softneck.loop import BlockPart, Loop, LoopResult, RobotReference, metrics, run_loop
from softneck.signals import signal
from softneck.tuning import tune
from softneck.tuning._judge import design_candidate, prepare
from softneck.tuning._task import Task
from softneck.tuning._tune import BUDGET, task_of

OUT = Path("build/tune")
PAYLOADS, JUDGED = (0.32, 1.0), (0.32, 0.66, 1.0)
ORIENTATIONS = (0.0, 45.0, 90.0)
PLAIN = ("pi", "pid", "fopi", "hinf", "lqg")
SIZE, CIRCLE, TURN = math.radians(15.0), math.radians(12.0), 1.2
# Overshoot [%], rise [s], steady rms [deg], circle unknown and known ahead [deg].
GOALS = {"overshoot": 5.0, "rise": 0.4, "steady": 0.15, "circle": 3.0, "ahead": 1.5}


def known(neck: str) -> dict[str, Any]:
    """Return the family and the grey box of what a user would record; made once and kept."""
    files = {f"{name}.npz": OUT / f"{neck}_{name}.npz" for name in ("family", "greybox")}
    if not all(file.exists() for file in files.values()):
        begin = time.process_time()
        common = taut(neck)
        eq22 = [recorded(neck, signal("eq22", duration=80.0), n, kg, common) for n, kg in enumerate(PAYLOADS)]
        GreyBox().fit(eq22).save(files["greybox.npz"], force=True)
        played = [
            experiments(neck, amplitude, 10 * n, kg, common)
            for n, amplitude in enumerate(AMPLITUDES)
            for kg in PAYLOADS
        ]
        FamilySettings().fit([*eq22, *played]).save(files["family.npz"], force=True)
        print(f"  {neck}: models at {common:g} rad, {time.process_time() - begin:.0f} s", file=sys.stderr, flush=True)
    return {name: softneck.load(file) for name, file in files.items()}


def truth(neck: str, controller: Any, ahead: float) -> dict[str, float]:
    """Return the worst of what the neck itself does."""
    block = controller.block()
    worst = dict.fromkeys(GOALS, 0.0)
    for seed, kg in enumerate(JUDGED):
        for angle in ORIENTATIONS:
            share = math.cos(math.radians(angle)), math.sin(math.radians(angle))
            step = RobotReference(kind="step", values=(SIZE * share[0], SIZE * share[1]), at=3.0)
            found = metrics(run(neck, block, step, kg, seed, 8.0))
            stepped = [found[axis] for axis, part in zip(("pitch", "roll"), share, strict=True) if part > 0.05]
            for name, key in (("overshoot", "overshoot_pct"), ("rise", "rise_s")):
                values = [item[key] for item in stepped]
                worst[name] = max([worst[name], *(math.inf if value is None else value for value in values)])
            worst["steady"] = max(
                [worst["steady"], *(found[axis]["steady_rms_deg"] or 0.0 for axis in ("pitch", "roll"))]
            )
        circle = RobotReference(kind="rotation", values=(CIRCLE,), frequency=TURN / (2.0 * math.pi), at=3.0, rise=2.0)
        result = run(neck, block, circle, kg, seed, 5.0 + 4.0 * math.pi / TURN)
        for name, lead in (("circle", 0.0), ("ahead", ahead)):
            worst[name] = max(worst[name], distance(result, round(lead / result.sample_time)))
    return worst


def run(neck: str, block: Any, reference: Any, kg: float, seed: int, duration: float) -> LoopResult:
    """Return a loop over the neck's sensor."""
    plant = Sensed(block_of(neck, noise=True, seed=seed))
    return run_loop(Loop(plant=plant, controller=BlockPart(block), reference=reference, duration=duration,
                         plant_inputs={"payload": kg}))  # fmt: skip


def distance(result: LoopResult, lead: int) -> float:
    """Return the rms distance [deg] of the last turn to where the circle was `lead` samples before."""
    rows, turn = result.time.size, round(2.0 * math.pi / TURN / result.sample_time)
    parts = [
        result[axis][-turn:] - result[f"{axis}_reference"][rows - turn - lead : rows - lead]
        for axis in ("pitch", "roll")
    ]
    return math.degrees(math.sqrt(float(np.mean(np.square(parts).sum(axis=0)))))


def seconds() -> float:
    """Return the processor time of this process and those it has waited for [s]."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--necks", nargs="*", default=("beam", "twisted"), choices=SHOWN)
    parser.add_argument("--kinds", nargs="*", default=())
    parser.add_argument("--budget", type=int, default=BUDGET)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--best", action="store_true", help="Only what is returned, not the best of other kinds.")
    parser.add_argument("--defaults", action="store_true", help="What a plain `design` makes; nothing is searched.")
    parser.add_argument("--set", nargs="*", default=(), metavar="NAME=VALUE", help="Of --defaults: other settings.")
    parser.add_argument("--fresh", action="store_true", help="Forget the models that are kept.")
    asked = parser.parse_args()
    if asked.fresh:
        shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True, exist_ok=True)
    print("| neck | controller | certificate | processor [s] | overshoot [%] | rise [s] | steady rms [deg] | "
          "circle [deg] | known ahead [deg] | misses |\n|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    for neck in asked.necks:
        (defaults if asked.defaults else searched)(neck, asked)


def searched(neck: str, asked: argparse.Namespace) -> None:
    """Print what `tune` returns, and unless --best the best of every other kind."""
    plants, begin = known(neck), seconds()
    found = tune(plants, kinds=tuple(asked.kinds), budget=asked.budget, seed=asked.seed, workers=asked.workers)
    spent = seconds() - begin
    shown = {found.best.kind: found.best}
    for item in () if asked.best else found.candidates:
        shown.setdefault(item.kind, item)
    ready = prepare(found.task)
    for item in shown.values():
        controller = design_candidate(found.task, ready, item.kind, item.settings)
        best = item is found.best
        said = ("holds" if found.holds else f"fails: {found.binding}") if best else "-"
        row([neck, f"**{item.kind}**" if best else item.kind, said, f"{spent:.0f}" if best else ""],
            truth(neck, controller, item.metrics.get("track.ahead_s", 0.0)))  # fmt: skip
        if not asked.best:
            plain(neck, found.task, item.kind, ())


def defaults(neck: str, asked: argparse.Namespace) -> None:
    """Print what kinds do with their defaults or with --set."""
    task = task_of(known(neck), None, asked.seed)
    for kind in asked.kinds or PLAIN:
        plain(neck, task, kind, asked.set)


def plain(neck: str, task: Task, kind: str, given: Sequence[str]) -> None:
    """Print what a kind does with its defaults, at the co-contraction of the recordings; nothing is known ahead."""
    made = resolve(KINDS[kind].settings)
    values = {name: float(value) for name, _, value in (text.partition("=") for text in given)}
    if any(field.name == "least_cocontraction" for field in fields(made)):
        values["least_cocontraction"] = task.cocontraction or 0.0
    row(
        [neck, " ".join([kind, *(given or ["defaults"])]), "-", ""], truth(neck, made(**values).design(task.plant), 0.0)
    )


def row(cells: list[str], true: dict[str, float]) -> None:
    """Print a row of the table."""
    missed = ", ".join(name for name, goal in GOALS.items() if true[name] > goal)
    print(f"| {' | '.join([*cells, *(f'{true[name]:.3g}' for name in GOALS), missed or '-'])} |", flush=True)


if __name__ == "__main__":
    main()
