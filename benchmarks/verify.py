"""Time `softneck verify` on 500 plants beside a loop over python-control's own functions.

`python benchmarks/verify.py [PLANTS]`. Ours is the whole verification: both axes, margins of every plant, the search,
bounds of mu, steps of every plant in time with limits and noise, 54 loops over the virtual neck. python-control's loop
does a part of it: poles, gain and phase margins, disk margin and H-infinity norm of the sensitivity, and a linear step,
of pitch alone on a tenth of the plants, and its time is scaled to all plants and both axes.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import control
import numpy as np

from softneck.design import PiSettings
from softneck.estimation import LinearNeck
from softneck.verification import Verification, make_requirements, verify

TS = 0.02


def neck() -> LinearNeck:
    """Return the paper's neck (Eq. 31)."""
    a = math.exp(-5.293 * TS)
    tf = control.TransferFunction([math.radians(27.69) / 5.293 * (1.0 - a)], [1.0, -a, 0.0, 0.0, 0.0, 0.0], TS)
    return LinearNeck(pitch=tf, roll=tf)


def by_python_control(found: Verification, rows: np.ndarray) -> float:
    """Return what python-control takes for `rows` of pitch [s]."""
    plants, law = found.evidence.plants, found.evidence.linear[0].law
    own = control.StateSpace(law.A, law.By[:, [0]], -law.C[[0]], -law.Dy[[0]][:, [0]], TS)
    K: Any = control.minreal(own, verbose=False)
    infinity: Any = "inf"
    w = np.geomspace(0.02, math.pi / TS, 360)
    begin = time.perf_counter()
    for row in rows:
        below = np.append(plants.denominator[row, 0], np.zeros(plants.delay[row, 0]))
        L: Any = control.ss(control.TransferFunction(plants.numerator[row, 0], below, TS)) * K
        S: Any = control.feedback(1, L)
        T: Any = control.feedback(L, 1)
        np.abs(T.poles()).max()
        control.stability_margins(L)
        control.disk_margins(L, w)
        control.system_norm(S, p=infinity, print_warning=False)
        control.step_response(T, np.arange(400) * TS)
    return time.perf_counter() - begin


def main() -> None:
    """Print both times."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    controller, asked = PiSettings().design(neck()), make_requirements({"sampling": {"plants": count}})
    first = verify(controller, neck(), asked)
    begin, used = time.perf_counter(), time.process_time()
    found = verify(controller, neck(), asked)
    wall, used = time.perf_counter() - begin, time.process_time() - used
    rows = np.linspace(0, count - 1, max(1, count // 10)).astype(int)
    other = by_python_control(found, rows) / rows.size * count * 2
    print(f"{count} plants, {len(found.evidence.necks)} loops over the virtual neck")
    print(f"softneck verify: {wall:.1f} s ({used:.1f} s of processor), the first time {first.wall_time:.1f} s")
    print(f"python-control, margins, norms and linear steps alone: {other:.1f} s")


if __name__ == "__main__":
    main()
