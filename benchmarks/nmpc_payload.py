"""Print why nonlinear predictive control loses to linear as soon as there is payload: one thing changed at a time.

`python benchmarks/nmpc_payload.py [--necks NECK...] [--kind play]`: circle of 12 deg at 1.2 rad/s as in
`mpc_following.py`, rms of the worse axis [deg], under 0 and 1 kg. Rows: linear `mpc` with its defaults; `nmpc` over a
model of Eq. 22 without payload; the same with the model of the payload that is there; with its tendons kept taut by
2 rad of co-contraction; with both; and all that with a slower or a quicker disturbance.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from mpc_following import CIRCLE_S, JUDGED, OURS, SETTLED, Specimen, circle, neck, rms_deg

from softneck.core import KINDS, resolve
from softneck.design import MpcSettings, NmpcSettings
from softneck.loop import BlockPart, Loop, Reference, run_loop
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant import record as record_own
from softneck.signals import Recording, signal
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

TAUT = 2.0
# As quick as the linear one's defaults.
QUICK = NmpcSettings(bandwidth=12.0, reference_time=0.05)


def recorded(name: str, payload: float, common: float) -> Recording:
    """Return 80 s of Eq. 22 around a co-contraction [rad]."""
    excitation = signal("eq22", duration=80.0)
    excitation = replace(excitation, set_points=excitation.set_points + common)
    if name in OURS:
        return record_own(excitation, VirtualNeck(NeckParameters.preset(name)), seed=6, payload=payload)
    return record(excitation, ForeignNeck(name=name), seed=6, payload=payload)


def error(on: Specimen, controller: Any, payload: float, common: float) -> float:
    """Return the rms error of the circle under a payload [kg] and a co-contraction [rad]."""

    def around(time: float, /) -> tuple[float, float, float]:
        return *circle(time)[:2], common

    reference: Reference = around
    loop = Loop(plant=BlockPart(on.block(0)), controller=BlockPart(controller.block()),
                observer=BlockPart(on.observer), reference=reference, duration=CIRCLE_S,
                plant_inputs={"payload": payload})  # fmt: skip
    return rms_deg(run_loop(loop), reference, SETTLED)


def rows(name: str, kind: str) -> dict[str, list[float]]:
    """Return the errors at each payload, by what was changed."""
    on = neck(name)
    fit = resolve(KINDS[kind].settings)().fit
    models = {(kg, common): fit(recorded(name, kg, common)) for kg in JUDGED for common in (0.0, TAUT)}
    linear = MpcSettings().design(on.family)
    slack = MpcSettings(minimum_tautness=None).design(on.family)
    slow, quick = replace(QUICK, disturbance_time=1.0), replace(QUICK, window=3)

    def each(settings: NmpcSettings, common: float, *, known: bool) -> list[float]:
        return [error(on, settings.design(models[kg if known else 0.0, common]), kg, common) for kg in JUDGED]

    return {
        "`mpc`, defaults": [error(on, linear, kg, 0.0) for kg in JUDGED],
        "`mpc` that lets tendons hang": [error(on, slack, kg, 0.0) for kg in JUDGED],
        f"`mpc`, defaults, {TAUT:g} rad of co-contraction": [error(on, linear, kg, TAUT) for kg in JUDGED],
        "`nmpc`, model of 0 kg": each(QUICK, 0.0, known=False),
        "`nmpc`, model of the payload": each(QUICK, 0.0, known=True),
        f"`nmpc`, model of 0 kg, {TAUT:g} rad": each(QUICK, TAUT, known=False),
        f"`nmpc`, model of the payload, {TAUT:g} rad": each(QUICK, TAUT, known=True),
        "the same, disturbance of 1 s": each(slow, TAUT, known=True),
        "the same, window of 3 samples": each(quick, TAUT, known=True),
    }


def main() -> None:
    """Print a table for each neck."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=(*CHOOSING, *OURS), default=["chain", "column", "spring"])
    parser.add_argument("--kind", default="play", help="of model (play)")
    options = parser.parse_args()
    for name in options.necks:
        print(f"\n| `{name}` | " + " | ".join(f"{kg:g} kg" for kg in JUDGED) + " |\n|---|---|---|")
        for what, errors in rows(name, options.kind).items():
            print(f"| {what} | " + " | ".join(f"{value:.2f}" for value in errors) + " |", flush=True)


if __name__ == "__main__":
    main()
