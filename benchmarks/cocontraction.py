"""Choose co-contraction and reference filter of a neck that changes, each neck left out in turn.

`python benchmarks/cocontraction.py [--necks NECK...]`

The others choose the fastest with which none of them overshoots by more than 8 % in the loops that
`changing_neck.py payloads` prints.
"""

from __future__ import annotations

import argparse

import numpy as np
from changing_neck import TIMES, payloads

from softneck.core import Matrix
from tests.foreign_necks.necks import CHOOSING

# Co-contraction [rad], time of the reference filter [s].
CANDIDATES = [(taut, time) for taut in (1.5, 2.0, 2.5, 3.0, 4.0) for time in TIMES]
GOAL = 8.0


def choose(found: dict[str, Matrix]) -> None:
    """Print what necks left out get from the others' choice, of the worth of each candidate on each neck."""
    for neck, own in found.items():
        others = np.array([rows for name, rows in found.items() if name != neck])
        kept = (others[:, :, 0] <= GOAL).all(axis=0)
        best = int(np.argmin(np.where(kept, np.log(others[:, :, 1]).mean(axis=0), np.inf)))
        taut, time = CANDIDATES[best]
        print(f"left out {neck:8} others choose {taut:g} rad, {time:g} s: overshoot {own[best, 0]:.1f} %, 90 % after "
              f"{own[best, 1]:.2f} s; 1.5 rad, 0.06 s: {own[0, 0]:.1f} %, {own[0, 1]:.2f} s")  # fmt: skip


def main() -> None:
    """Print each candidate and the choices."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="*", choices=CHOOSING, default=list(CHOOSING))
    necks = parser.parse_args().necks
    choose({neck: np.array([payloads(neck, *each) for each in CANDIDATES]) for neck in necks})


if __name__ == "__main__":
    main()
