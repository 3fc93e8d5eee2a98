"""A closed loop on a neck that changes, with the controller that switches by the estimated payload.

`python benchmarks/changing_neck.py [table|payloads] [--necks NECK...] [--cases CASE...] [--cocontraction RAD]`

Of each foreign neck: logs of 100 s of Eq. 22 around a co-contraction of 3 rad with 0, 0.5 and 1 kg; a line of each,
a `greybox` of all three, a detector over it from 200 s of other motion with each, and `switched` at the three. Beside
it stands `first`: its own gains of 0 kg, never switched. Both follow the same random steps of 6 to 20 deg every 4 s
(12 deg from upright at the most) on a noisy sensor, without observer. Printed are the largest overshoot of any step in
% of it, the mean time until 90 % of it are gone, the largest mean error of a step's last second (not while `changed`
slows the reference), the time with a set-point beyond its limit, the payload that is told at the end, and seconds of
`changed`. The angle is the measured one: nobody sees a sensor's bias. Creep: tendon 1 grows by 5 % of 0.11 m in 10
minutes, the others by half of that.

`payloads` prints loops without a detector instead: 0, 0.5 and 1 kg under their own gains, and 0 and 1 kg under those of
the other, with each time of the reference filter. `slack` is the part of the time in which a tendon bears less than
1 mN with 1 kg.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from softneck.core import Matrix, Vector, load
from softneck.design.varying._switched import SwitchedSettings
from softneck.design.varying._varying import VaryingController
from softneck.estimation.changes._change import ChangeDetector
from softneck.estimation.changes._settings import ChangeSettings
from softneck.identification import GreyBox, Model, Rls
from softneck.loop import BlockPart, Loop, LoopResult, NeckFault, Part, RecordingReference, SensorFault, run_loop
from softneck.signals import Recording, signal
from tests.foreign_necks.necks import CHOOSING, NECKS, ForeignNeck, record_under

OUT, TS, LOADS, TAUT = Path("build/changing_neck"), 0.02, (0.0, 0.5, 1.0), 3.0
EVERY, AT = 4.0, 20.0
# 5 % of 0.11 m on a winch of 7.5 mm.
CREEP, CREPT = 0.05 * 0.11 / 0.0075, 600.0
# Loops without a detector: payload, told.
JUDGED = ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0))
TIMES = (0.06, 0.2, 0.4)
CASES = ("nothing", "put on", "taken off", "creep", "bias 2 deg")
MOTIONS = ("steps", "sine", "rotation", "aprbs", "multisine", "mixed")


def moved(neck: str, P: Matrix, payload: float, taut: float, seed: int) -> Recording:
    """Return what a specimen does around a co-contraction, with the payload that it bears."""
    run = record_under(np.clip(P + taut, -6.0, 6.0), specimen(neck), np.full(len(P), payload), seed=seed)
    return run.with_channels(payload=np.full(len(P), payload))


def specimen(neck: str) -> ForeignNeck:
    """Return the neck that is looked at."""
    return ForeignNeck(name=neck, seed=1)


@cache
def logs(neck: str, taut: float) -> list[Recording]:
    """Return what models are made from."""
    return [moved(neck, signal("eq22").set_points[:5000], kg, taut, 1) for kg in LOADS]


@cache
def lines(neck: str, taut: float) -> list[Model]:
    """Return a line of each payload."""
    return [Rls().fit(log) for log in logs(neck, taut)]


def several(neck: str, taut: float) -> Model:
    """Return the model of all payloads, kept for the next time."""
    path = OUT / f"{neck}.{taut:g}.npz"
    if not path.exists():
        OUT.mkdir(parents=True, exist_ok=True)
        GreyBox().fit(logs(neck, taut)).save(path)
    return load(path, role="model")


def detector(neck: str, taut: float) -> ChangeDetector:
    """Return what tells the payload, from other motion than the model's."""
    motions = [signal(name).set_points if name in MOTIONS[:3] else signal(name, duration=40.0, seed=3).set_points
               for name in MOTIONS]  # fmt: skip
    runs = [moved(neck, P, kg, taut, 5) for kg in LOADS for P in motions]
    return ChangeSettings().design(several(neck, taut), runs)


def controller(neck: str, taut: float, reference_time: float | None = None) -> VaryingController:
    """Return the controller of lines at each payload."""
    settings = SwitchedSettings(payloads=LOADS, least_cocontraction=taut, observer=False)
    if reference_time is not None:
        settings = replace(settings, reference_time=reference_time)
    return settings.design(lines(neck, taut))


@dataclass(frozen=True, slots=True)
class Creeping:
    """A plant whose tendons grow: what a winch winds up beyond that arrives."""

    part: BlockPart

    @property
    def inputs(self):
        """Of the plant."""
        return self.part.inputs

    @property
    def outputs(self):
        """Of the plant."""
        return self.part.outputs

    @property
    def sample_time(self) -> float:
        """Of the plant [s]."""
        return self.part.sample_time

    @property
    def role(self) -> str:
        """Of the plant."""
        return self.part.role

    def start(self, time: float, parameters: dict[str, float]) -> Vector:
        """Begin with tendons as they were."""
        return self.part.start(time, parameters)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step the plant with motors that are behind by what their tendons have grown."""
        grown = CREEP * min(1.0, time / CREPT) * np.array([1.0, 0.5, 0.5])
        less = inputs.copy()
        less[:3] -= grown
        found = self.part.advance(time, less)
        at = [port.name for port in self.outputs].index("motor_position_1")
        # The encoder sits on the motor.
        found[at : at + 3] += grown
        return found

    def close(self) -> None:
        """Do nothing."""


def targets(seconds: float) -> Matrix:
    """Return a tilt (steps, 2) [rad] for every `EVERY`, each a step of at least 6 deg from the one before."""
    rng, found = np.random.default_rng(7), [np.zeros(2)]
    while len(found) < round(seconds / EVERY):
        angle, size = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(0.0, 12.0))
        there = size * np.array([np.cos(angle), np.sin(angle)])
        if np.radians(6.0) <= np.linalg.norm(there - found[-1]) <= np.radians(20.0):
            found.append(there)
    return np.array(found)


def run(
    neck: str, case: str, judged: VaryingController, watch: ChangeDetector, *, taut: float, told: bool
) -> LoopResult:
    """Return a closed loop."""
    seconds = CREPT if case == "creep" else 60.0
    block = specimen(neck).block(noise_seed=11)
    plant: Part = Creeping(BlockPart(block)) if case == "creep" else BlockPart(block)  # pyright: ignore[reportAssignmentType]
    faults = {
        "put on": (NeckFault(start=AT, values={"payload": 1.0}),),
        "taken off": (NeckFault(start=0.0, duration=AT, values={"payload": 1.0}),),
        "bias 2 deg": (SensorFault(kind="bias", start=AT, axis="pitch", size=np.radians(2.0)),),
    }
    unsaid = {} if told else {"controller": {"payload": 0.0}}
    return run_loop(Loop(
        plant=plant, controller=BlockPart(judged.block()), duration=seconds, faults=faults.get(case, ()),
        reference=asked_for(seconds, taut), others={"watch": BlockPart(watch.block())}, other_inputs=unsaid,
    ))  # fmt: skip


def undisturbed(neck: str, judged: VaryingController, taut: float, payload: float, told: float) -> LoopResult:
    """Return a closed loop under one payload, with another told."""
    return run_loop(Loop(
        plant=BlockPart(specimen(neck).block(noise_seed=11)), controller=BlockPart(judged.block()), duration=60.0,
        faults=(NeckFault(start=0.0, values={"payload": payload}),) if payload else (), reference=asked_for(60.0, taut),
        other_inputs={"controller": {"payload": told, "changed": 0.0}},
    ))  # fmt: skip


def payloads(neck: str, taut: float, time: float) -> Vector:
    """Print what loops without a detector are worth, and return the largest overshoot [%] and the mean rise [s]."""
    judged = controller(neck, taut, time)
    loops = [undisturbed(neck, judged, taut, *case) for case in JUDGED]
    over, rise = np.array([overshoot_and_rise(loop, 60.0) for loop in loops]).T
    tension = np.column_stack([loops[2][f"tension_{j}"] for j in (1, 2, 3)])
    print(f"{neck:8}{taut:5.1f} rad{time:6.2f} s: overshoot "
          + "".join(f"{x:6.1f}" for x in over) + " %, 90 % after " + "".join(f"{x:6.2f}" for x in rise)
          + f" s, slack {(tension < 1e-3).any(axis=1).mean():5.2f}", flush=True)  # fmt: skip
    return np.array([over.max(), rise.mean()])


def asked_for(seconds: float, taut: float) -> RecordingReference:
    """Return the reference."""
    wanted = targets(seconds)
    return RecordingReference(time=np.arange(len(wanted)) * EVERY, pitch=wanted[:, 0], roll=wanted[:, 1],
                              cocontraction=np.full(len(wanted), taut))  # fmt: skip


def parts(found: LoopResult, seconds: float) -> list[tuple[Matrix, Vector]]:
    """Return how far the neck went of each step (time,), and how far from its end it was in its last second [rad]."""
    y = np.column_stack([found["pitch_measured"], found["roll_measured"]])
    wanted, rows, each = targets(seconds), round(EVERY / TS), []
    for k in range(2, len(wanted)):
        way, part = wanted[k] - wanted[k - 1], y[k * rows : (k + 1) * rows]
        each.append(((part - wanted[k - 1]) @ way / float(way @ way), part[-50:].mean(axis=0) - wanted[k]))
    return each


def overshoot_and_rise(found: LoopResult, seconds: float) -> tuple[float, float]:
    """Return the largest overshoot [%], and the mean time until 90 % of a step are gone [s]."""
    gone = [part for part, _ in parts(found, seconds)]
    rises = [float(np.argmax(part >= 0.9)) * TS if part.max() >= 0.9 else EVERY for part in gone]
    return 100.0 * (max(float(part.max()) for part in gone) - 1.0), float(np.mean(rises))


def judge(found: LoopResult, seconds: float) -> str:
    """Return what a loop is worth."""
    (over, rise), rows = overshoot_and_rise(found, seconds), round(EVERY / TS)
    slowed = found["changed"] > 0.5
    off = [float(np.degrees(np.linalg.norm(away))) for k, (_, away) in enumerate(parts(found, seconds), start=2)
           if not slowed[(k - 1) * rows : (k + 1) * rows].any()]  # fmt: skip
    P = np.column_stack([found[f"motor_setpoint_{j}"] for j in (1, 2, 3)])
    beyond = float((np.abs(P) > 6.0 + 1e-9).any(axis=1).sum()) * TS
    return (f"{over:10.1f} %{rise:8.2f} s{max(off, default=0.0):8.2f} deg{beyond:8.1f} s"
            f"{found['payload'][-1]:9.2f} kg{float(slowed.sum()) * TS:9.1f} s")  # fmt: skip


def main() -> None:
    """Print the table, or the loops without a detector."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", nargs="?", choices=["table", "payloads"], default="table")
    parser.add_argument("--necks", nargs="*", choices=NECKS, default=list(CHOOSING))
    parser.add_argument("--cases", nargs="*", choices=CASES, default=CASES)
    parser.add_argument("--cocontraction", type=float, default=TAUT, metavar="RAD", help="%(default)s unless said")
    asked = parser.parse_args()
    taut = asked.cocontraction
    if asked.what == "payloads":
        for neck in asked.necks:
            for time in TIMES:
                payloads(neck, taut, time)
        return
    for neck in asked.necks:
        judged, watch = controller(neck, taut), detector(neck, taut)
        print(
            f"{neck:22}{'overshoot':>12}{'rise':>10}{'error':>12}{'beyond':>10}{'payload':>12}{'changed':>11}",
            flush=True,
        )
        for case in asked.cases:
            for told in (True, False) if case in ("put on", "taken off") else (True,):
                found = run(neck, case, judged, watch, taut=taut, told=told)
                name = f"{case}, {'switched' if told else 'first'}"
                print(f"{name:22}{judge(found, CREPT if case == 'creep' else 60.0)}", flush=True)


if __name__ == "__main__":
    main()
