"""Print what look-ahead of the linear observer makes of default controllers, which do not know of it.

`python benchmarks/look_ahead.py [--necks NECK...] [--kinds KIND...] [--known]`: each is designed with its defaults, on
the family of `mpc_following.py` and on its `oe` of 0 kg alone, and closed over the observer of that `oe`, which tells
the angle of the measurement's instant or, over `sensor_delay` = 50 ms, that of now. Steps of 10 deg of pitch and of
roll at 0 and 1 kg, the worst of both; `moved` is how far all motors go in three seconds at rest. With `--known` the
designs count the look-ahead: 50 ms less dead time, which is `least_delay` = 30 ms where the plant's own is shorter.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from mpc_following import AT, AXES, JUDGED, OURS, OUT, STEP, STEP_S, Specimen, neck

from softneck.core import Vector, load
from softneck.design import design_controller
from softneck.estimation import KalmanSettings
from softneck.loop import BlockPart, Loop, LoopResult, Reference, StepReference, metrics, run_loop
from tests.foreign_necks.necks import CHOOSING

DELAYS = (0.0, 0.05)
# The designs' own `least_delay` less the look-ahead [s].
KNOWN = 0.08 - DELAYS[1]
REST_S = 3.0


def run(on: Specimen, controller: Any, reference: Reference, payload: float) -> LoopResult:
    """Close the loop once."""
    return run_loop(
        Loop(
            plant=BlockPart(on.block(0)), controller=BlockPart(controller.block()), observer=BlockPart(on.observer),
            reference=reference, duration=AT + STEP_S, plant_inputs={"payload": payload},
        )
    )  # fmt: skip


def numbers(on: Specimen, controller: Any, payload: float) -> list[float]:
    """Return overshoot [%], steady rms [deg] and motion at rest [rad]."""
    found = [metrics(run(on, controller, StepReference(**{axis: STEP}, at=AT), payload)) for axis in AXES]
    overshoot = max(found[i][axis]["overshoot_pct"] or 0.0 for i, axis in enumerate(AXES))
    steady = max(item[axis]["steady_rms_deg"] or 0.0 for item in found for axis in AXES)
    still = run(on, controller, StepReference(at=AT), payload)
    asked = np.column_stack([still[f"motor_setpoint_{j}"] for j in (1, 2, 3)])[-round(REST_S / still.sample_time) :]
    return [overshoot, steady, float(np.abs(np.diff(asked, axis=0)).sum())]


def cells(found: Vector) -> str:
    """Return the numbers of both observers as cells."""
    return " ".join(f"{over:.0f} | {steady:.2f} | {moved:.0f} |" for over, steady, moved in found.reshape(2, 3))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    everywhere = (*CHOOSING, *OURS)
    parser.add_argument("--necks", nargs="+", choices=everywhere, default=everywhere, help=", ".join(everywhere))
    parser.add_argument("--kinds", nargs="+", default=["pi", "pid", "lqg", "hinf"], help="of controllers")
    parser.add_argument("--known", action="store_true", help="designs that know of the look-ahead")
    wanted = parser.parse_args()
    settings = {"least_delay": KNOWN} if wanted.known else {}
    print("| neck | kind | designed on | kg | overshoot [%] | steady rms [deg] | moved [rad] | 50 ms ahead | | |")
    print("|---" * 10 + "|")
    rows = defaultdict(list)
    for name in wanted.necks:
        on = neck(name)
        model = load(Path(OUT) / f"{name}-0-oe.npz")
        both = [replace(on, observer=KalmanSettings(sensor_delay=delay).design(model).block()) for delay in DELAYS]
        for kind, (what, plant) in product(wanted.kinds, (("family", on.family), ("oe", model))):
            controller = design_controller(kind, plant, **settings)
            for payload in JUDGED:
                found = np.array([numbers(item, controller, payload) for item in both])
                rows[kind, what].append(found)
                print(f"| `{name}` | {kind} | {what} | {payload:g} | {cells(found)}", flush=True)
    for (kind, what), runs in rows.items():
        print(f"| mean | {kind} | {what} | | {cells(np.mean(runs, axis=0))}")


if __name__ == "__main__":
    main()
