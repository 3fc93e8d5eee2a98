"""Print every kind of controller on the virtual neck: worst and median of 15 deg steps.

`python benchmarks/neck_table.py [KIND...] [--workers 2] [--cases]`: orientations 0, 45 and 90 deg with payloads of 0 to
1 kg, preset `paper` with the 3DM inclinometer and its observer, sequential order, judged on the true angle. Each kind
is designed, with its defaults or the settings below, on what was identified on that neck. `--neck`, `--seed`,
`--size-deg`, `--payloads` and `--orientations-deg` ask for another neck and other steps than those the settings were
chosen on.
"""

from __future__ import annotations

import argparse
import math
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from typing import Any

from softneck.core import KINDS, SoftneckError, resolve
from softneck.core._kinds import kinds_of
from softneck.estimation import KalmanObserver, KalmanSettings
from softneck.identification import Family, FamilySettings, Model, Rls
from softneck.plant import VirtualNeck, record
from softneck.signals import Recording, signal
from tests.oracles.neck_table import FIGURES, NECK_HEAD, NeckRow, NeckSteps, neck_row, table_cells

# What a kind is designed on, where its own default is not the family over the payloads.
ON_MODEL: set[str] = set()
# What the defaults leave to the user: the co-contraction that keeps tendons taut under 1 kg, how far set-points may run
# ahead of the motors, and how much of a step the reference filter holds back.
TAUT: dict[str, Any] = {"least_cocontraction": 0.6}
QUICK: dict[str, Any] = {**TAUT, "lead_limit": 0.8, "reference_time": 0.12}
# Settings other than the defaults, by kind; a kind that is not named gets its defaults.
SETTINGS: dict[str, dict[str, Any]] = {
    "pi": QUICK,
    "adaptive": {**TAUT, "lead_limit": 1.0},
    "hinf": {**TAUT, "lead_limit": 1.2, "reference_time": 0.08},
    "pid": {**TAUT, "lead_limit": 0.8, "reference_time": 0.25},
    "fopi": {**TAUT, "lead_limit": 0.8, "reference_time": 0.14},
    "lqg": {**TAUT, "lead_limit": 0.8, "reference_time": 0.16},
    "mpc": {},
}

# Kinds that nothing can be designed for here, and why.
LEFT_OUT = {"custom": "it is made of a controller of one's own"}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", help="kinds of controller; all if none is named")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cases", action="store_true", help="print every case as well")
    usual = NeckSteps()
    parser.add_argument("--neck", default=usual.neck, help="preset or neck file")
    parser.add_argument("--seed", type=int, default=usual.seed, help="of the sensor's noise in the first run")
    parser.add_argument("--size-deg", type=float, default=math.degrees(usual.size))
    parser.add_argument("--payloads", type=float, nargs="+", default=usual.payloads, metavar="KG")
    parser.add_argument(
        "--orientations-deg", type=float, nargs="+", default=[math.degrees(o) for o in usual.orientations]
    )
    options = parser.parse_args()
    steps = NeckSteps(
        neck=options.neck,
        seed=options.seed,
        size=math.radians(options.size_deg),
        payloads=tuple(options.payloads),
        orientations=tuple(math.radians(angle) for angle in options.orientations_deg),
    )
    kinds = options.kinds or list(kinds_of("controller"))
    begin = time.perf_counter()
    with ProcessPoolExecutor(max_workers=min(options.workers, len(kinds))) as pool:
        rows = list(pool.map(partial(row_of, steps=steps), kinds))
    bounds = ", ".join(f"{name} <= {bound:g} {unit}" for name, (_, bound, unit) in FIGURES.items())
    print(f"worst (median) of {len(steps.cases())} cases; bounds: {bounds}")
    for cells in (NECK_HEAD, *table_cells(rows)):
        print("| " + " | ".join(cells) + " |")
    if options.cases:
        print_cases(rows)
    print(f"{time.perf_counter() - begin:.1f} s")


def row_of(kind: str, steps: NeckSteps) -> NeckRow:
    """Return the row of one kind, designed on what was identified, over `steps`."""
    if kind in LEFT_OUT:
        return NeckRow(name=kind, skipped=LEFT_OUT[kind])
    try:
        settings = resolve(KINDS[kind].settings)(**SETTINGS.get(kind, {}))
        controller = settings.design(identified_model(steps.neck) if kind in ON_MODEL else family(steps.neck))
        return neck_row(kind, controller, observer(steps.neck), steps)
    except SoftneckError as error:
        return NeckRow(name=kind, skipped=str(error))


@cache
def recordings(name: str) -> list[Recording]:
    """Return Eq. 22 on that neck, 80 s at each of three payloads."""
    neck = VirtualNeck(NeckSteps(neck=name).parameters())
    return [
        record(signal("eq22"), neck, seed=100 + i, payload=payload).rows(0, 4000)
        for i, payload in enumerate((0.0, 0.5, 1.0))
    ]


@cache
def identified_model(name: str) -> Model:
    """Return the linear model without payload."""
    return Rls(max_delay=0.2).fit(recordings(name)[0])


@cache
def family(name: str) -> Family:
    """Return the uncertain plant over the payloads."""
    return FamilySettings().fit(recordings(name))


@cache
def observer(name: str) -> KalmanObserver:
    """Return the inclinometer's observer."""
    return KalmanSettings(sensor="3dm-gx5-10").design(identified_model(name))


def print_cases(rows: list[NeckRow]) -> None:
    """Print every run of every controller."""
    for row in rows:
        for case in row.cases:
            print(
                f"{row.name} {math.degrees(case.orientation):3.0f} deg {case.payload:.1f} kg: "
                f"{case.overshoot:5.1f} % {case.rise:.2f} s {case.steady:.3f} deg"
            )


if __name__ == "__main__":
    main()
