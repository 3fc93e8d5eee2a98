"""Print how predictive control keeps its limits and follows on the virtual neck, payload by payload.

`python benchmarks/mpc_neck.py [NAME...] [--seeds 2] [--payloads 0 0.25 0.5 0.75 1] [--parts limits steady rotation]`:
preset `paper` with the 3DM inclinometer and its observer, sequential order, judged on the true angle and on where the
motors are. All is identified on that neck from Eq. 22 at 0, 0.5 and 1 kg, 80 s each.

- limits: pitch and roll limited to 15 deg, tautness to -0.2 rad; steps to the limit, to the other limit, to 20 deg
  (beyond it) and back, along orientations of 0, 45, 90 and 225 deg.
- steady: 10 deg under the same limits, rms error over the last two seconds, same orientations.
- rotation: the angles that the paper's test 3 makes of the neck without payload, rms after the first turn.

Another controller gets its row by an entry in `CONTROLLERS`: a function from "limits", "steady" or "rotation" to
anything with `block()` or `part()`; a `preview` [s] that it has is fed. Entries are designed in the process that runs
them, once for each part.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import neck_table
import numpy as np
from scipy.ndimage import gaussian_filter1d

from softneck.core import Matrix, Vector
from softneck.design import PiSettings
from softneck.design.predictive._nmpc import NmpcNumbers
from softneck.design.predictive._plant import TAUTNESS_LEVER
from softneck.design.predictive._settings import MpcNumbers
from softneck.identification import Network
from softneck.loop import BlockPart, Loop, LoopResult, RecordingReference, run_loop
from softneck.loop._references import AheadReference
from softneck.plant import VirtualNeck, record
from softneck.signals import TENDON_ANGLES, redefinition_matrix, signal
from tests.oracles.neck_table import NeckSteps

TS = 0.02
LIMIT = math.radians(15.0)
TAUTNESS = -0.2
LEVER = TAUTNESS_LEVER * redefinition_matrix(TENDON_ANGLES)[:2].T
SLEW, POSITION = 12.5, 6.0
ORIENTATIONS = (0.0, 45.0, 90.0, 225.0)
PARTS = ("limits", "steady", "rotation")
# Part of the first turn of test 3: three seconds of rise, then one turn at 1.2 rad/s.
SETTLED = 3.0 + 2.0 * math.pi / 1.2

SOFT: dict[str, Any] = {"angle_limit": LIMIT, "minimum_tautness": TAUTNESS}
# Chosen on the rotation at 0, 0.5 and 1 kg with one seed: a tautness below -0.1 rad lets the tendons hang at 1 kg, one
# above it meets the drives' current limit at 0 kg.
FOLLOWING: dict[str, Any] = {
    "preview": 0.6, "max_sensitivity": 2.2, "reference_time": 0.05, "minimum_tautness": -0.1,
}  # fmt: skip


def pi(_part: str) -> Any:
    """Return the simplest controller, which knows no limits: for comparison."""
    return PiSettings().design(neck_table.identified_model("paper"))


def mpc(part: str) -> Any:
    """Return linear predictive control on the family over the payloads."""
    settings = MpcNumbers(**(FOLLOWING if part == "rotation" else SOFT))
    return settings.design(neck_table.family("paper"))


def nmpc(part: str) -> Any:
    """Return nonlinear predictive control over a network of the neck without payload; it knows no tautness."""
    following: dict[str, Any] = {"preview": 0.6, "bandwidth": 12.0, "reference_time": 0.05}
    asked: dict[str, Any] = following if part == "rotation" else {"angle_limit": LIMIT}
    settings = NmpcNumbers(**asked)
    return settings.design(Network().fit(neck_table.recordings("paper")[0]))


CONTROLLERS: dict[str, Callable[[str], Any]] = {"pi": pi, "mpc": mpc, "nmpc": nmpc}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """The worst over all runs of a controller, a part and a payload; beyond a limit is positive.

    Attributes:
        name, part: of whom.
        payload: [kg].
        angle: largest angle beyond its limit [deg]; negative is room.
        taut: largest lack of tautness of a motor where it is [rad].
        position: set-points beyond theirs [rad].
        slew: beyond theirs [rad/s].
        steady: rms error of an axis at the end [deg].
        rotation: rms error of an axis after the first turn [deg].
    """

    name: str
    part: str
    payload: float
    angle: float
    taut: float
    position: float
    slew: float
    steady: float = math.nan
    rotation: float = math.nan


@dataclass(frozen=True, slots=True)
class Steps:
    """Levels along one orientation, held for some seconds each; a function of time as references are.

    `levels` are what the axis that leans most is asked for [rad].
    """

    levels: tuple[float, ...]
    orientation: float
    hold: float = 3.0

    def __call__(self, time: float, /) -> tuple[float, float, float]:
        """Return pitch, roll and co-contraction at `time` [s]."""
        level = self.levels[min(len(self.levels) - 1, int((time + 1e-9) / self.hold))]
        pitch, roll = math.cos(self.orientation), math.sin(self.orientation)
        most = max(abs(pitch), abs(roll))
        return level * pitch / most, level * roll / most, 0.0


@cache
def rotation() -> RecordingReference:
    """Return the angles of test 3 on the neck without payload, free of noise (smoothed over 60 ms)."""
    rec = record(signal("rotation"), VirtualNeck(NeckSteps().parameters()), seed=1)
    pitch, roll = (gaussian_filter1d(np.asarray(rec.channels[axis]), 3.0) for axis in ("pitch", "roll"))
    return RecordingReference(np.column_stack([rec.time, pitch, roll, np.zeros_like(pitch)]))


def runs(part: str, seeds: int) -> list[tuple[Any, float, int]]:
    """Return reference, duration [s] and seed of every run of a part."""
    if part == "rotation":
        return [(rotation(), 30.0, 5 + seed) for seed in range(seeds)]
    levels = (0.0, LIMIT, -LIMIT, math.radians(20.0), 0.0) if part == "limits" else (0.0, math.radians(10.0))
    hold = 3.0 if part == "limits" else 4.0
    references = [Steps(levels, math.radians(angle), hold) for angle in ORIENTATIONS]
    return [(each, hold * len(levels), 10 * i + s) for i, each in enumerate(references) for s in range(seeds)]


def run(controller: Any, reference: Any, duration: float, payload: float, seed: int) -> LoopResult:
    """Close the loop once."""
    preview = float(getattr(controller, "preview", 0.0))
    return run_loop(
        Loop(
            plant=BlockPart(VirtualNeck(NeckSteps().parameters()).block(noise_seed=seed)),
            observer=BlockPart(neck_table.observer("paper").block()),
            controller=BlockPart(controller.block()) if hasattr(controller, "block") else controller.part(),
            reference=AheadReference(reference, preview) if preview > 0.0 else reference,
            duration=duration,
            plant_inputs={"payload": payload},
        )
    )


def judged(name: str, part: str, payload: float, done: list[tuple[Any, LoopResult]]) -> Row:
    """Return the worst of some runs."""
    angle = taut = position = slew = -math.inf
    errors = []
    for reference, result in done:
        lean: Matrix = np.column_stack([result.angle("pitch"), result.angle("roll")])
        motors, asked = (
            np.column_stack([result[f"motor_{what}_{j}"] for j in (1, 2, 3)]) for what in ("position", "setpoint")
        )
        angle = max(angle, float(np.degrees(np.abs(lean).max() - LIMIT)))
        taut = max(taut, float((TAUTNESS - (motors - lean @ LEVER.T)).max()))
        position = max(position, float(np.abs(asked).max()) - POSITION)
        slew = max(slew, float(np.abs(np.diff(asked, axis=0, prepend=0.0)).max()) / TS - SLEW)
        late = result.time >= (SETTLED if part == "rotation" else result.time[-1] - 2.0)
        wanted = np.array([reference(t)[:2] for t in result.time[late]])
        errors.append(rms_deg(lean[late] - wanted))
    worst = max(errors)
    if part == "rotation":
        return Row(name=name, part=part, payload=payload, angle=math.nan, taut=math.nan, position=position, slew=slew,
                   rotation=worst)  # fmt: skip
    steady = worst if part == "steady" else math.nan
    return Row(
        name=name, part=part, payload=payload, angle=angle, taut=taut, position=position, slew=slew, steady=steady
    )


def rms_deg(errors: Matrix) -> float:
    """Return the larger rms of two columns, from rad in degrees."""
    columns: Vector = np.sqrt(np.mean(errors**2, axis=0))
    return float(np.degrees(columns.max()))


def rows_of(job: tuple[str, str, tuple[float, ...], int]) -> list[Row]:
    """Return the rows of one controller in one part."""
    name, part, payloads, seeds = job
    controller = CONTROLLERS[name](part)
    rows = []
    for payload in payloads:
        done = [(reference, run(controller, reference, T, payload, seed)) for reference, T, seed in runs(part, seeds)]
        rows.append(judged(name, part, payload, done))
    return rows


def cell(value: float, places: int) -> str:
    """Return a number as text, nothing for none."""
    return "" if math.isnan(value) else f"{value:.{places}f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(CONTROLLERS)}; all if none is named")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--payloads", type=float, nargs="*", default=[0.0, 0.25, 0.5, 0.75, 1.0])
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=PARTS)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in CONTROLLERS]
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; there are {', '.join(CONTROLLERS)}")
    begin = time.perf_counter()
    jobs = [
        (name, part, tuple(options.payloads), options.seeds)
        for part in options.parts for name in options.names or CONTROLLERS
    ]  # fmt: skip
    print("beyond a limit is positive, room is negative; wanted: none beyond, steady <= 0.2 deg, rotation <= 1 deg")
    print("| part | controller | kg | angle [deg] | tautness [rad] | position [rad] | slew [rad/s] | steady rms [deg] "
          "| rotation rms [deg] |")  # fmt: skip
    with ProcessPoolExecutor(max_workers=min(options.workers, len(jobs))) as pool:
        for rows in pool.map(rows_of, jobs):
            for r in rows:
                figures = (
                    cell(r.angle, 2), cell(r.taut, 2), cell(r.position, 2), cell(r.slew, 2), cell(r.steady, 3),
                    cell(r.rotation, 2),
                )  # fmt: skip
                print(f"| {r.part} | {r.name} | {r.payload:g} | " + " | ".join(figures) + " |", flush=True)
    print(f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
