"""Print what each foreign neck is like, beside the ranges of real ones and our own presets.

`python benchmarks/foreign_necks.py [NECK...] [--seeds 0 1 2]`

Nothing is chosen here: the two necks that are held out are shown as well.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import softneck
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.figures import RANGES, figures
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.necks import NECKS, ForeignNeck, record

HEAD = ("neck", "line %", "hysteresis deg", "slack %", "3 rad deg", "dead time s", "times real time")
OURS = ("paper", "rough", "lab")


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("necks", nargs="*", default=[*NECKS, *OURS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    wanted = parser.parse_args()
    _print(HEAD)
    _print(("wanted", *(f"{low:g} to {high:g}" for low, high in RANGES.values()), "20 or more"))
    for name in wanted.necks:
        for seed in [0] if name in OURS else wanted.seeds:
            title = f"{name}{f' {seed}' if seed else ''}{' (held out)' if name in HELD_OUT else ''}"
            _print((title, *row(_recorder(name, seed))))


def row(run: Callable[[Excitation], Recording]) -> list[str]:
    """Return the cells of one neck, those out of range with a star."""
    found = figures(run)
    cells = []
    for name, (low, high) in RANGES.items():
        values = np.atleast_1d(getattr(found, name))
        outside = (values < low).any() or (values > high).any()
        cells.append("/".join(f"{value:.3g}" for value in values) + ("*" if outside else ""))
    begin = time.process_time()
    run(signal("eq22", duration=40.0))
    return [*cells, f"{44.0 / (time.process_time() - begin):.0f}"]  # 4 s to settle


def _recorder(name: str, seed: int) -> Callable[[Excitation], Recording]:
    if name in OURS:
        neck = VirtualNeck(NeckParameters.preset(name))
        return lambda excitation: softneck.record(excitation, neck, noise=False)
    foreign = ForeignNeck(name=name, seed=seed, noise=False)
    return lambda excitation: record(excitation, foreign)


def _print(cells: tuple[str, ...]) -> None:
    print("  ".join(f"{cell:>16}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
