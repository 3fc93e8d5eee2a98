"""The controllers of `earns_its_place.py`: kind by foreign neck, judged on the neck itself, also at a payload unseen.

Of each specimen what docs/howto/payloads.md says: around the co-contraction that its tendons want, 80 s of Eq. 22 and
small and large multisines with 0 and 1 kg: a family, a line of 0 kg for `adaptive`, and a grey box of Eq. 22 with both,
over which `mpc` and `nmpc` have an observer. Kinds have their defaults, and hold that co-contraction. Judged with 0,
0.5 and 1 kg by what a noisy sensor measures: steps of 10 deg of pitch and of roll, a circle of 12 deg at 1.2 rad/s, and
the step of pitch again with twice the tilt (a gain margin of 2). The score is the rms error of the worst circle [deg];
a seed is missed where a step overshoots by more than 5 % or twice the gain does not come to rest. `ahead` is the same
where the circle is known beforehand: a kind with `/preview` sees it, the others are given it earlier by what suits
them best.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from benchmarks.earns_its_place import SEEDS, Cell
from benchmarks.mpc_following import AT, CIRCLE_S, PREVIEW, SETTLED, STEP, STEP_S, circle
from benchmarks.promises import AMPLITUDES, LARGEST, Sensed
from softneck.core import KINDS, Vector, resolve
from softneck.core._kinds import kinds_of
from softneck.design import NmpcSettings
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings, NonlinearObserver
from softneck.identification import Family, FamilySettings, GreyBox, Model, OutputError
from softneck.loop import BlockPart, Loop, LoopResult, Part, RobotReference, metrics, run_loop
from softneck.loop._references import AheadReference
from softneck.signals import (
    Excitation,
    Recording,
    SetPointLimits,
    concatenate,
    multisine_experiments,
    prepare,
    signal,
)
from tests.foreign_necks.necks import ForeignNeck, record_under

# What `custom` is made of is one's own.
KINDS_JUDGED = (*(kind for kind in kinds_of("controller") if kind != "custom"), "mpc/preview", "nmpc/preview")
# Of `benchmarks/promises.py`: the least co-contraction at which a neck with 1 kg is heard [rad].
TAUT = {"chain": 4.0, "column": 3.0, "spring": 1.0, "foam": 3.0}
RECORDED, JUDGED, MISSED, OVERSHOOT = (0.0, 1.0), (0.0, 0.5, 1.0), math.inf, 5.0
# What is called oscillation, peak to peak in the last 2 s [deg].
OSCILLATES = 2.0


def cells(robots: list[str], kinds: list[str]) -> Iterator[Cell]:
    """Yield all there is to compute."""
    return (Cell(robot, kind, seed, "loops") for robot in robots for seed in SEEDS for kind in kinds)


def recorded(robot: str, excitation: Excitation, seed: int, kg: float) -> Recording:
    """Return a recording of a specimen around its co-contraction, which says its payload."""
    around = replace(excitation, set_points=excitation.set_points + TAUT[robot])
    played, _ = prepare(around, SetPointLimits(position=LARGEST))
    load = np.full(len(played.set_points), kg)
    run = record_under(played.set_points, ForeignNeck(name=robot, seed=seed), load, seed=10 * seed + round(10 * kg))
    return run.with_channels(payload=load)


@lru_cache(1)
def eq22(robot: str, seed: int) -> list[Recording]:
    """Return 80 s of Eq. 22 with each payload."""
    return [recorded(robot, signal("eq22", duration=80.0), seed, kg) for kg in RECORDED]


@lru_cache(1)
def family(robot: str, seed: int) -> Family:
    """Return the uncertain linear plant of Eq. 22 and of small and large multisines with each payload."""
    played = [
        concatenate([recorded(robot, run, seed, kg) for run in
                     multisine_experiments(amplitude=amplitude, band=(0.5, 25.0), seed=seed)])
        for amplitude in AMPLITUDES for kg in RECORDED
    ]  # fmt: skip
    return FamilySettings().fit([*eq22(robot, seed), *played])


@lru_cache(1)
def observed(robot: str, seed: int) -> tuple[Model, NonlinearObserver]:
    """Return a grey box of both payloads, and the observer over it."""
    several = GreyBox().fit(eq22(robot, seed))
    return several, KalmanSettings().design(several)


def designed(cell: Cell) -> tuple[Any, NonlinearObserver | None]:
    """Return the controller with its defaults, its tendons as taut as they were recorded, and the loop's observer."""
    kind, _, preview = cell.kind.partition("/")
    where, ahead = (cell.robot, cell.seed), PREVIEW if preview else 0.0
    if kind == "mpc":
        # A wish, as the default is: a limit that cannot be kept would be given up with all others.
        wish = MpcNumbers(preview=ahead, wish=TAUT[cell.robot], payload_tautness=0.0)
        return wish.over(observed(*where)[1]).design(family(*where)), observed(*where)[1]
    if kind == "nmpc":
        settings = NmpcSettings(minimum_tautness=TAUT[cell.robot], preview=ahead)
        return settings.over(observed(*where)[1]).design(observed(*where)[0]), observed(*where)[1]
    plant = OutputError().fit(eq22(*where)[0]) if kind == "adaptive" else family(*where)
    return resolve(KINDS[kind].settings)(least_cocontraction=TAUT[cell.robot]).design(plant), None


def controller_cell(cell: Cell) -> dict[str, Any]:
    """Return the worst of what the neck does over all payloads."""
    controller, observer = designed(cell)

    def run(reference: Any, duration: float, kg: float, gain: float = 1.0) -> LoopResult:
        sensed = Sensed(ForeignNeck(name=cell.robot, seed=cell.seed).block(noise_seed=cell.seed + 7))
        plant: Any = sensed if gain == 1.0 else _Louder(sensed, gain)
        given = AheadReference(reference, PREVIEW) if "/" in cell.kind else reference
        return run_loop(Loop(plant=plant, controller=BlockPart(controller.block()), reference=given,
                             observer=None if observer is None else BlockPart(observer.block()), duration=duration,
                             plant_inputs={"payload": kg}))  # fmt: skip

    overshoot, rise, swings, around, ahead = [], [], [], [], []
    for kg in JUDGED:
        for axis, sizes in (("pitch", (STEP, 0.0)), ("roll", (0.0, STEP))):
            found = metrics(run(RobotReference(kind="step", values=sizes, at=AT), AT + STEP_S, kg))[axis]
            overshoot.append(found["overshoot_pct"] or 0.0)
            rise.append(found["rise_s"] or STEP_S)
        loud = run(RobotReference(kind="step", values=(STEP, 0.0), at=AT), AT + STEP_S, kg, 2.0)
        swings.append(max(float(np.ptp(np.degrees(loud[axis][-100:]))) for axis in ("pitch", "roll")))
        turned = run(circle, CIRCLE_S, kg)
        errors = [_distance(turned, lead) for lead in range(0, 30 if "/" not in cell.kind else 1)]
        around.append(errors[0])
        ahead.append(errors)
    best = np.max(ahead, axis=0).min()  # one lead for all payloads
    holds = max(overshoot) <= OVERSHOOT and max(swings) <= OSCILLATES
    return {
        "score": max(around) if holds else MISSED, "ahead": float(best) if holds else MISSED, "circle": max(around),
        "known ahead": float(best), "overshoot": max(overshoot), "rise": max(rise), "swing": max(swings),
    }  # fmt: skip


def _distance(result: LoopResult, lead: int) -> float:
    """Return the rms error of the worse axis from the circle of `lead` samples before [deg]."""
    late = np.flatnonzero(result.time >= SETTLED)
    wanted = np.array([circle(t)[:2] for t in result.time[late - lead]])
    errors = np.column_stack([result[axis] for axis in ("pitch", "roll")])[late] - wanted
    return float(np.degrees(np.sqrt(np.mean(errors**2, axis=0)).max()))


class _Louder:
    """A plant whose tilt answers `gain` times as much: the tilt in the set-points is multiplied, their mean is not.

    The motors that it shows are those of the set-points it was given: to a controller they follow as ever.
    """

    def __init__(self, plant: Part, gain: float) -> None:
        """Wrap `plant`."""
        self.inputs, self.outputs, self.role = plant.inputs, plant.outputs, plant.role
        self.sample_time = plant.sample_time
        self._plant, self._gain = plant, gain
        names = [port.name for port in plant.outputs]
        self._motors = [names.index(f"motor_position_{j}") for j in (1, 2, 3)]
        self.close = plant.close

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Begin a run."""
        return self._shown(self._plant.start(time, parameters))

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once."""
        mean = inputs[:3].mean()
        return self._shown(
            self._plant.advance(time, np.concatenate([mean + self._gain * (inputs[:3] - mean), inputs[3:]]))
        )

    def _shown(self, outputs: Vector) -> Vector:
        motors = outputs[self._motors]
        outputs[self._motors] = motors.mean() + (motors - motors.mean()) / self._gain
        return outputs
