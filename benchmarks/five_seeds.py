"""Print the five-seed table of docs/howto/which_model.md: free run and one step on the virtual neck, preset `paper`.

`python benchmarks/five_seeds.py [KIND...] [--data eq22 mixed] [--seeds 0 1 2 3 4]`

Each seed has noise of its own in every recording, and starts of its own where a kind starts at random. Every kind has
its defaults; rows and tests that it is judged on are never shown to it. Seconds are of one processor, all threads.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from softneck.core import KINDS, resolve
from softneck.identification import INFINITE, Model, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

TESTS = ("steps", "sine", "rotation")
KINDS_SHOWN = ("play", "nn", "greybox")


def recordings(data: str, seed: int) -> dict[str, Recording]:
    """Return 7,000 rows to train on, what follows (Eq. 22) or a minute of another `mixed`, and the three tests."""
    neck, first = VirtualNeck(NeckParameters.paper()), 10 * seed
    made = {name: record(signal(name), neck, seed=first + number) for number, name in enumerate(TESTS, start=2)}
    if data == "eq22":
        made["train"], made["validation"] = record(signal("eq22"), neck, seed=first + 1).split(0.7)
    else:
        made["train"] = record(signal("mixed", duration=140.0), neck, seed=first + 1)
        made["validation"] = record(signal("mixed", duration=60.0, seed=100 + seed), neck, seed=first + 5)
    return made


def trained(kind: str, train: Recording, seed: int) -> Model:
    """Return a model with the kind's defaults."""
    settings = resolve(KINDS[kind].settings)
    values: dict[str, Any] = {"seed": seed} if "seed" in settings.__dataclass_fields__ else {}
    if kind == "nlsm":
        values["form"] = "residual"
    return settings(**values).fit(train)


def table(kind: str, data: str, seeds: list[int]) -> None:
    """Print one kind, trained on one signal: each seed, then median and worst."""
    free: list[list[float]] = []
    one: list[float] = []
    above, seconds = [], []
    for seed in seeds:
        made = recordings(data, seed)
        begin = time.process_time()
        model = trained(kind, made["train"], seed)
        seconds.append(time.process_time() - begin)
        row = []
        for name in ("validation", *TESTS):
            judged = validate(model, made[name], horizons=(1, INFINITE))
            row += [_number(fit) for fit in judged.fits[INFINITE].values()]
            one += [_number(fit) for fit in judged.fits["1"].values()]
            above += [
                _number(judged.fits["1"][axis]) - _number(judged.persistence["1"][axis]) for axis in judged.fits["1"]
            ]
        free.append(row)
        last = one[-8:]
        print(
            f"  {kind} {data} seed {seed}: free {_pairs(row)}; one step {_pairs(last)}; {seconds[-1]:.1f} s", flush=True
        )
    _print("median", kind, data, np.median, free)
    _print("worst seed", kind, data, np.min, free)
    print(
        f"{kind} {data}: one step {min(one):.2f} to {max(one):.2f}, above persistence by {min(above):.2f} at least; "
        f"at worst validation {min(min(row[:2]) for row in free):.1f}, tests {min(min(row[2:]) for row in free):.1f}; "
        f"{max(seconds):.1f} s of processor at most",
        flush=True,
    )


def _print(what: str, kind: str, data: str, of: Callable, free: list[list[float]]) -> None:
    print(f"{kind} {data} {what}: {_pairs(list(of(np.array(free), axis=0)))}", flush=True)


def _pairs(row: list[float]) -> str:
    return " ".join(f"{pitch:.1f}/{roll:.1f}" for pitch, roll in zip(row[::2], row[1::2], strict=True))


def _number(fit: float | None) -> float:
    return -np.inf if fit is None else fit


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("kinds", nargs="*", default=KINDS_SHOWN)
    parser.add_argument("--data", nargs="+", default=["eq22", "mixed"], choices=["eq22", "mixed"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    wanted = parser.parse_args()
    print("columns: validation, steps, sine, rotation; fit in % pitch/roll")
    for data in wanted.data:
        for kind in wanted.kinds:
            table(kind, data, wanted.seeds)


if __name__ == "__main__":
    main()
