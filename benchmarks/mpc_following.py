"""Print how fast and how closely `mpc` with its defaults follows on necks that nobody tuned to.

`python benchmarks/mpc_following.py [--necks NECK...] [--set KEY=VALUE...] [--observer|--told|--inclined] [--seed N]`:
on a family of 80 s of Eq. 22 at 0, 0.5 and 1 kg, with the observer's defaults, sequential order, judged on the true
angle. Steps of 10 deg of pitch and of roll; a circle of 12 deg at 1.2 rad/s, rms of the worse axis after the first
turn, without and with preview. `python benchmarks/leave_one_neck_out.py mpc.taut_pole` (and the other `mpc.` settings)
chooses by the same runs. With `payload_tautness` the observer is over a `greybox` of the same recordings and estimates
the payload, which `--told` tells instead. With `--observer` it is so in any case, and the design knows it
(`softneck design mpc FAMILY --observer OBSERVER`); `--late` tells it how late the sensor is. `--inclined` prints what
is left to schedule over the inclination: steps of 5 deg of pitch from 0, 5, 10 and 15 deg. Families and models are kept
in `build/mpc_following`.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import Vector, load
from softneck.design import MpcController
from softneck.design.linear._axis_loop import rise_time
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings, NonlinearObserver
from softneck.identification import Family, FamilySettings, GreyBox, OutputError
from softneck.loop import BlockPart, Loop, LoopResult, Reference, RobotReference, metrics, run_loop
from softneck.loop._references import AheadReference
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant import record as record_own
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

OUT = Path("build/mpc_following")
OURS = ("paper", "rough", "lab")
AXES = ("pitch", "roll")
PAYLOADS = (0.0, 0.5, 1.0)
JUDGED = (0.0, 1.0)
STEP, AT, STEP_S = math.radians(10.0), 2.0, 8.0
TILT, TURN, CIRCLE_S = math.radians(12.0), 1.2, 20.0
# Three seconds of rise, then one turn.
SETTLED = 3.0 + 2.0 * math.pi / TURN
PREVIEW = 0.6
INCLINATIONS, INCLINED = (0.0, 5.0, 10.0, 15.0), math.radians(5.0)
# An overshoot of so much counts as much as twice the error [%].
_COSTLY = 10.0


@dataclass(frozen=True, slots=True)
class Specimen:
    """A neck to be followed on.

    Attributes:
        name: of its files.
        block: the neck as a plant, from the seed of its noise.
        recorded: its recordings, one for each payload.
        family: what they tell.
        observer: of the loop.
        late: how late the sensor is said to be [s]; None: as the robot's file has it.
    """

    name: str
    block: Callable[[int], Block]
    recorded: Callable[[], list[Recording]]
    family: Family
    observer: Block
    late: float | None = None

    def watched(self, controller: MpcController) -> Block:
        """Return the observer of a loop: one that tells the payload to a controller that asks for it."""
        asks = any(port.name == "payload" for port in controller.block().inputs)
        return self.estimates_payload().block() if asks else self.observer

    def estimates_payload(self) -> NonlinearObserver:
        """Return the default observer over a `greybox` of all payloads."""
        file = OUT / f"{self.name}-greybox.npz"
        if not file.exists():
            GreyBox().fit(self.recorded()).save(file, force=True)
        settings = KalmanSettings() if self.late is None else KalmanSettings(sensor_delay=self.late)
        return settings.design(load(file))


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What a controller did under one payload.

    Attributes:
        overshoot, rise, steady: the worst of the steps of both axes [%], [s], [deg].
        step: rms errors of both steps, from the step on [deg].
        circle, ahead: rms errors of the circle without and with preview [deg].
    """

    overshoot: float
    rise: float
    steady: float
    step: float
    circle: float
    ahead: float

    @property
    def score(self) -> float:
        """Geometric mean of the errors; overshoot counts on top."""
        return (self.step * self.circle * self.ahead) ** (1.0 / 3.0) * (1.0 + self.overshoot / _COSTLY)


def circle(time: float, /) -> tuple[float, float, float]:
    """Return pitch, roll and co-contraction of the circle at `time` [s]."""
    tilt = TILT * min(1.0, time / 3.0)
    return tilt * math.cos(TURN * time), tilt * math.sin(TURN * time), 0.0


def specimen(name: str, recorded: Callable[[Excitation, int, float], Recording], block: Callable[[int], Block]
             ) -> Specimen:  # fmt: skip
    """Return a neck with all that is known of it, from a function of signal, seed and payload [kg]; kept."""

    def recordings() -> list[Recording]:
        excitation = signal("eq22", duration=80.0)
        return [recorded(excitation, 6 + i, kg) for i, kg in enumerate(PAYLOADS)]

    files = [OUT / f"{name}-{what}.npz" for what in ("family", "oe")]
    if not all(file.exists() for file in files):
        OUT.mkdir(parents=True, exist_ok=True)
        runs = recordings()
        for file, found in zip(files, (FamilySettings().fit(runs), OutputError().fit(runs[0])), strict=True):
            found.save(file, force=True)
    family, model = (load(file) for file in files)
    return Specimen(name, block, recordings, family, KalmanSettings().design(model).block())


def neck(name: str, number: int = 0) -> Specimen:
    """Return one of our necks or of the foreign ones, its specimen `number`."""
    if name in OURS:
        parameters = NeckParameters.preset(name)
        if number:
            parameters = parameters.sample(np.random.default_rng(number))
        own = VirtualNeck(parameters)
        return specimen(
            f"{name}-{number}",
            lambda excitation, seed, kg: record_own(excitation, own, seed=seed, payload=kg),
            lambda seed: own.block(noise_seed=seed),
        )
    foreign = ForeignNeck(name=name, seed=number)
    return specimen(
        f"{name}-{number}",
        lambda excitation, seed, kg: record(excitation, foreign, seed=seed, payload=kg),
        lambda seed: foreign.block(noise_seed=seed),
    )


def run(on: Specimen, controller: MpcController, reference: Reference, duration: float, payload: float,
        seed: int = 0) -> LoopResult:  # fmt: skip
    """Close the loop once."""
    told = AheadReference(reference, controller.preview) if controller.preview > 0.0 else reference
    return run_loop(
        Loop(
            plant=BlockPart(on.block(seed)), controller=BlockPart(controller.block()),
            observer=BlockPart(on.watched(controller)), reference=told, duration=duration,
            plant_inputs={"payload": payload},
        )
    )  # fmt: skip


def followed(on: Specimen, settings: MpcNumbers, payload: float, seed: int = 0) -> Followed:
    """Return what the controller of these settings does under a payload [kg]."""
    plain = settings.design(on.family)
    same = replace(settings, preview=PREVIEW, bandwidth=plain.design["bandwidth_rad_s"])
    stepped = [_step(on, plain, axis, payload, seed) for axis in AXES]
    around = [rms_deg(run(on, item, circle, CIRCLE_S, payload, seed), circle, SETTLED) for item in
              (plain, same.design(on.family))]  # fmt: skip
    overshoot, rise, steady, errors = np.array(stepped).T
    return Followed(
        overshoot=float(overshoot.max()), rise=float(rise.max()), steady=float(steady.max()),
        step=float(np.sqrt(np.mean(errors**2))), circle=around[0], ahead=around[1],
    )  # fmt: skip


def _step(on: Specimen, controller: MpcController, axis: str, payload: float, seed: int) -> list[float]:
    """Return overshoot [%], rise [s], steady rms and rms error from the step on [deg]."""
    reference = RobotReference(kind="step", values=tuple(STEP * (axis == each) for each in AXES), at=AT)
    result = run(on, controller, reference, AT + STEP_S, payload, seed)
    found = metrics(result)
    steady = max(float(found[each]["steady_rms_deg"] or 0.0) for each in AXES)
    values = [found[axis][name] for name in ("overshoot_pct", "rise_s")]
    # A step that never rises took all the time there was.
    return [float(values[0] or 0.0), float(STEP_S if values[1] is None else values[1]), steady,
            rms_deg(result, reference, AT)]  # fmt: skip


def rms_deg(result: LoopResult, reference: Reference, since: float) -> float:
    """Return the rms error of the worse axis from a time [s] on [deg]."""
    late = result.time >= since
    wanted = np.array([reference(t)[:2] for t in result.time[late]])
    errors = np.column_stack([result.angle(axis) for axis in AXES])[late] - wanted
    return float(np.degrees(np.sqrt(np.mean(errors**2, axis=0)).max()))


def told(settings: MpcNumbers, payload: float) -> MpcNumbers:
    """Return the settings of a controller that knows its payload [kg] without an observer: to the bit the same."""
    more, least = (settings.payload_tautness or 0.0) * payload, settings.minimum_tautness
    if least is None or more == 0.0:
        return settings
    # A wish stays one, a limit a limit.
    if isinstance(least, str):
        return replace(settings, payload_tautness=0.0, wish=settings.wish + more)
    return replace(settings, payload_tautness=0.0, minimum_tautness=least + more)


def inclined(on: Specimen, controller: MpcController, payload: float, seed: int = 0) -> list[tuple[float, float]]:
    """Return overshoot [%] and rise [s] of a step of 5 deg of pitch from each inclination."""
    found = []
    for least in INCLINATIONS:
        reference = inclination_step(math.radians(least))
        result = run(on, controller, reference, AT + STEP_S, payload, seed)
        y = (result.angle("pitch")[result.time >= AT] - math.radians(least)) / INCLINED
        found.append((100.0 * (float(y.max()) - 1.0), rise_time(y, result.sample_time)))
    return found


def inclination_step(least: float) -> Reference:
    """Return a reference that goes to `least` [rad] at the start and steps from there at `AT`."""

    def reference(time: float, /) -> tuple[float, float, float]:
        return least + (INCLINED if time >= AT else 0.0), 0.0, 0.0

    return reference


def scores(on: Specimen, candidates: list[Any]) -> Vector:
    """Return the mean score of each candidate's settings over the payloads, which are told: less is better."""
    found: dict[tuple[str, float], float] = {}
    for settings, payload in itertools.product(candidates, JUDGED):
        same = told(settings, payload)
        if (repr(same), payload) not in found:
            found[repr(same), payload] = followed(on, same, payload).score
    return np.array([
        np.mean([found[repr(told(settings, payload)), payload] for payload in JUDGED]) for settings in candidates
    ])  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    everywhere = (*CHOOSING, *OURS)
    parser.add_argument("--necks", nargs="+", choices=everywhere, default=everywhere, help=", ".join(everywhere))
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings other than the defaults")
    parser.add_argument("--observer", action="store_true", help="a design that knows its observer, over a `greybox`")
    parser.add_argument("--late", type=float, help="with --observer: how late the sensor is said to be [s]")
    parser.add_argument("--told", action="store_true", help="tell the payload, in the place of an estimate")
    parser.add_argument("--inclined", action="store_true", help="steps of 5 deg from several inclinations instead")
    parser.add_argument("--seed", type=int, default=0, help="of the sensor's noise (0)")
    options = parser.parse_args()
    changed = {
        key: None if value == "None" else float(value) for key, value in (item.split("=") for item in options.set)
    }
    settings = MpcNumbers(**changed)  # type: ignore[arg-type]
    heads = ("neck", "kg", "overshoot [%]", "rise [s]", "steady rms [deg]", "circle [deg]", "with preview [deg]")
    if options.inclined:
        heads = ("neck", "kg", *(f"from {least:g} deg: overshoot [%], rise [s]" for least in INCLINATIONS))
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for name in options.necks:
        on = replace(neck(name), late=options.late)
        asked = settings
        if options.observer:
            eyes = on.estimates_payload()
            on, asked = replace(on, observer=eyes.block()), settings.over(eyes)
        for payload in JUDGED:
            if options.inclined:
                cells = [f"{over:.0f}, {rise:.2f}" for over, rise in inclined(on, asked.design(on.family), payload)]
            else:
                f = followed(on, told(asked, payload) if options.told else asked, payload, options.seed)
                cells = [f"{f.overshoot:.0f}", f"{f.rise:.2f}", f"{f.steady:.2f}", f"{f.circle:.1f}", f"{f.ahead:.1f}"]
            print(f"| `{name}` | {payload:g} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
