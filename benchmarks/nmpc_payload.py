"""Print why nonlinear predictive control loses to linear as soon as there is payload: one thing changed at a time.

`python benchmarks/nmpc_payload.py [--necks NECK...] [--kind play] [--told|--ahead] [--seed N]`: the circle of 12 deg at
1.2 rad/s of `mpc_following.py`, and a step of 18 deg of pitch over 8 s, rms of the worse axis [deg], under 0 and 1 kg.
`mpc` is over the family, `nmpc` over models of 80 s of Eq. 22, around zero or pulled taut by 2 rad of co-contraction.
`--told`: over a `greybox` of 0, 0.5 and 1 kg, pulled taut, that is told its payload, against linear ones as taut
(`rise_s` of 0.2 and 0.15; with preview the default), and the circle with preview. `--ahead`: the same over one observer
for all, over the `greybox`, that looks 50 ms ahead, which all designs know.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from mpc_following import (
    AT,
    CIRCLE_S,
    JUDGED,
    OURS,
    OUT,
    PAYLOADS,
    PREVIEW,
    SETTLED,
    STEP_S,
    Specimen,
    circle,
    neck,
    rms_deg,
    run,
)
from payload import told

from softneck.core import KINDS, load, resolve
from softneck.design import MpcSettings
from softneck.design.predictive._nmpc import NmpcNumbers
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings
from softneck.identification import GreyBox
from softneck.loop import BlockPart, Loop, run_loop
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant import record as record_own
from softneck.signals import Recording, signal
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

TAUT = 2.0
# Of an observer over a nonlinear model [s].
LOOK = 0.05
# As quick as the linear one's defaults.
QUICK = NmpcNumbers(bandwidth=12.0, reference_time=0.05)
LARGE = math.radians(18.0)


def recorded(name: str, payload: float, common: float) -> Recording:
    """Return 80 s of Eq. 22 around a co-contraction [rad]."""
    excitation = signal("eq22", duration=80.0)
    excitation = replace(excitation, set_points=excitation.set_points + common)
    if name in OURS:
        return record_own(excitation, VirtualNeck(NeckParameters.preset(name)), seed=6, payload=payload)
    return record(excitation, ForeignNeck(name=name), seed=6, payload=payload)


def errors(on: Specimen, controllers: list[Any], common: float, seed: int = 0) -> list[float]:
    """Return the rms errors of circle and large step under each payload and a co-contraction [rad].

    Args:
        on: the neck.
        controllers: one for each payload of `JUDGED`.
        common: co-contraction that is asked for.
        seed: of the sensor's noise.
    """

    def around(time: float, /) -> tuple[float, float, float]:
        return *circle(time)[:2], common

    def stepped(time: float, /) -> tuple[float, float, float]:
        return LARGE if time >= AT else 0.0, 0.0, common

    found = []
    for reference, duration, since in ((around, CIRCLE_S, SETTLED), (stepped, AT + STEP_S, AT)):
        for controller, kg in zip(controllers, JUDGED, strict=True):
            loop = Loop(plant=BlockPart(on.block(seed)), controller=BlockPart(controller.block()),
                        observer=BlockPart(on.observer), reference=reference, duration=duration,
                        plant_inputs={"payload": kg})  # fmt: skip
            found.append(rms_deg(run_loop(loop), reference, since))
    return found


def rows(name: str, kind: str) -> Iterator[tuple[str, list[float]]]:
    """Yield the errors by what was changed."""
    on = neck(name)
    fit = resolve(KINDS[kind].settings)().fit
    slack, taut = ([recorded(name, kg, common) for kg in JUDGED] for common in (0.0, TAUT))
    for what, settings, common in (
        ("`mpc`, defaults", MpcSettings(), 0.0),
        ("`mpc` that lets tendons hang", MpcSettings(minimum_tautness=None), 0.0),
        ("`mpc`, 2 rad of co-contraction", MpcSettings(), TAUT),
        ("`mpc`, 2 rad, `rise_s=0.2`", MpcSettings(rise_s=0.2), TAUT),
    ):
        yield what, errors(on, [settings.design(on.family)] * 2, common)
    hanging, pulled = fit(slack[0]), fit(taut[0])
    wish = replace(QUICK, minimum_tautness=0.5)
    for what, settings, models, common in (
        ("`nmpc`, model of 0 kg", QUICK, [hanging] * 2, 0.0),
        ("the same, model of the payload", QUICK, [hanging, fit(slack[1])], 0.0),
        ("the same, 2 rad of co-contraction", QUICK, [hanging] * 2, TAUT),
        ("the same, `minimum_tautness=0.5`", wish, [hanging] * 2, 0.0),
        ("`nmpc`, model of 0 kg pulled taut, 2 rad", QUICK, [pulled] * 2, TAUT),
        ("the same, model of the payload", QUICK, [pulled, fit(taut[1])], TAUT),
        ("the same, one model of both payloads", QUICK, [fit(taut)] * 2, TAUT),
        ("the same, model of 0 kg, `minimum_tautness=2`", replace(QUICK, minimum_tautness=2.0), [pulled] * 2, 0.0),
        ("the same, window of 3 samples", replace(QUICK, window=3), [pulled] * 2, TAUT),
    ):
        yield what, errors(on, [settings.design(model) for model in models], common)


def rows_told(name: str, look: float = 0.0, seed: int = 0) -> Iterator[tuple[str, list[float]]]:
    """Yield the errors of controllers that know the payload, by how taut tendons are; `look` is their look-ahead."""
    on, file = neck(name), OUT / f"{name}-taut-greybox.npz"
    if not file.exists():
        GreyBox().fit([recorded(name, kg, TAUT) for kg in PAYLOADS]).save(file, force=True)
    several: Any = load(file)
    models = [told(several, kg) for kg in JUDGED]
    if look > 0.0:
        on = replace(on, observer=KalmanSettings().design(several).block())
    for taut in (TAUT, 3.5):
        wish = MpcNumbers(wish=taut, look_ahead=look)
        ahead = replace(wish, preview=PREVIEW).design(on.family)
        # With less dead time as quick as it was is not as quick as it could be.
        for bandwidth in (QUICK.bandwidth, *((20.0,) if look > 0.0 else ())):
            pulled = replace(QUICK, minimum_tautness=taut, look_ahead=look, bandwidth=bandwidth)
            which = f", {bandwidth:g} rad/s" if look > 0.0 else ""
            yield f"`nmpc`, payload told, {taut:g} rad{which}", [
                *errors(on, [pulled.design(model) for model in models], 0.0, seed),
                *previewed(on, [replace(pulled, preview=PREVIEW).design(model) for model in models], seed),
            ]  # fmt: skip
        known = previewed(on, [ahead] * 2, seed)
        for rise in (0.2, 0.15):
            quick = replace(wish, rise_s=rise).design(on.family)
            yield f"`mpc`, {taut:g} rad, `rise_s={rise:g}`", [*errors(on, [quick] * 2, 0.0, seed), *known]


def previewed(on: Specimen, controllers: list[Any], seed: int) -> list[float]:
    """Return the rms errors of the circle under each payload where it is known ahead [deg]."""
    return [
        rms_deg(run(on, item, circle, CIRCLE_S, kg, seed), circle, SETTLED)
        for item, kg in zip(controllers, JUDGED, strict=True)
    ]  # fmt: skip


def main() -> None:
    """Print a table for each neck."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=(*CHOOSING, *OURS), default=["chain", "column", "spring"])
    parser.add_argument("--kind", default="play", help="of model (play)")
    parser.add_argument("--told", action="store_true", help="controllers that know the payload")
    parser.add_argument("--ahead", action="store_true", help="the same, over an observer that looks ahead")
    parser.add_argument("--seed", type=int, default=0, help="of the sensor's noise (0)")
    options = parser.parse_args()
    knows = options.told or options.ahead
    for name in options.necks:
        columns = ("circle", "step", *(("ahead",) if knows else ()))
        heads = [f"{what}, {kg:g} kg" for what in columns for kg in JUDGED]
        print(f"\n| `{name}` | {' | '.join(heads)} |\n|{'---|' * (1 + len(heads))}")
        for what, found in (
            rows_told(name, LOOK if options.ahead else 0.0, options.seed) if knows else rows(name, options.kind)
        ):
            print(f"| {what} | " + " | ".join(f"{value:.2f}" for value in found) + " |", flush=True)


if __name__ == "__main__":
    main()
