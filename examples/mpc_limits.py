"""Predictive control at its limits: an angle that must not be exceeded, slow motors, and tendons that stay taut.

The virtual neck is asked for 18 deg of pitch and then for -18 deg, its angles limited to 12 deg, its motors to 4 rad/s.
Drawn: the angle with what was planned now and then, the motors, the tautness of each tendon, and which limits were
active when.

Run it with `python examples/mpc_limits.py [FOLDER]`; the picture is written to FOLDER, by default `build`.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softneck.core import Matrix, Vector
from softneck.design import MpcSettings
from softneck.estimation import AxisPlant, LinearNeck
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plots import Chart, Curve, Level, Panel, chart_figure

# Motor that one radian of the neck takes up [rad/rad].
LEVER = 6.93
TS = 0.02
# Eq. 31 of the paper, sampled: exp(-0.08 s) 27.691/(s + 5.293) deg/rad.
_A = math.exp(-5.293 * TS)
TILT = AxisPlant(np.array([math.radians(27.691) / 5.293 * (1.0 - _A)]), np.array([1.0, -_A]), 4, TS).tf()
LIMIT = math.radians(12.0)
SLEW = 4.0
TAUT = -0.2
COLOURS = ("#0072b2", "#d55e00", "#009e73")
KINDS = ("slew", "angle", "tautness")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What happened, sample by sample.

    Attributes:
        reference, pitch: (time,) [rad].
        motors, tautness: (time, 3) [rad].
        active: (time, 3) whether a limit of each of `KINDS` was active.
        plans: sample -> predicted pitch from then on [rad].
    """

    reference: Vector
    pitch: Vector
    motors: Matrix
    tautness: Matrix
    active: Matrix
    plans: dict[int, Vector]


def run(rows: int = 300) -> Run:
    """Close the loop over the virtual neck, by hand: plant, then controller."""
    # Eq. 31 is what the paper identified; on our neck it is 20 % off, which the controller must find out.
    settings = MpcSettings(angle_limit=LIMIT, minimum_tautness=TAUT)
    controller = settings.design(LinearNeck(pitch=TILT, roll=TILT))
    part, neck = controller.part(), BlockPart(VirtualNeck(NeckParameters.paper()).block(noise_seed=1))
    names = [port.name for port in neck.outputs]
    seen = neck.start(0.0, {})
    motors, lever = part.start(0.0, {"slew_limit": SLEW}), LEVER * controller.arrays[8][:2].T
    plant_inputs = np.array([port.start for port in neck.inputs])
    log, plans = [], {}
    for k in range(rows):
        reference = math.radians(18.0) * (0.0 if k < 25 else 1.0 if k < 160 else -1.0)
        angles = seen[[names.index("pitch_measured"), names.index("roll_measured")]]
        where = seen[[names.index(f"motor_position_{j}") for j in (1, 2, 3)]]
        motors = part.advance(k * TS, np.array([reference, 0.0, 0.0, *angles, *where, 1.0, 1.0]))
        info = part.info
        if k in (30, 40, 165, 180):
            plans[k] = info.angles[:, 0]
        active = [any(line.startswith(kind) for line in info.active) for kind in KINDS]
        log.append([reference, seen[names.index("pitch")], *motors, *(motors - lever @ angles), *active])
        plant_inputs[:3] = motors
        seen = neck.advance(k * TS, plant_inputs)
    table = np.array(log)
    return Run(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8], table[:, 8:], plans)


def chart(done: Run) -> Chart:
    """Return the picture as plain data."""
    t = np.arange(done.pitch.size) * TS
    angles = [
        Curve(t, np.degrees(done.reference), "asked", "#888888", "step"),
        *(
            # A plan made in sample k begins a sample and a dead time of four samples later.
            Curve(
                (k + 6 + np.arange(plan.size)) * TS, np.degrees(plan), "planned" if k == 30 else "", "#cc79a7", "dashed"
            )
            for k, plan in done.plans.items()
        ),
        Curve(t, np.degrees(done.pitch), "pitch", COLOURS[0], width=1.6),
    ]
    bars = [
        Curve(t, np.where(done.active[:, i] > 0.5, float(i), np.nan), kind, COLOURS[i], "points", width=2.0)
        for i, kind in enumerate(KINDS)
    ]
    limits = (Level(math.degrees(LIMIT), "limit"), Level(-math.degrees(LIMIT)))
    three = [(j, COLOURS[j - 1]) for j in (1, 2, 3)]
    return Chart(
        title="Predictive control at its limits",
        panels=(
            Panel(tuple(angles), "pitch [deg]", levels=limits),
            Panel(tuple(Curve(t, done.motors[:, j - 1], f"motor {j}", c, "step") for j, c in three), "set-point [rad]"),
            Panel(
                tuple(Curve(t, done.tautness[:, j - 1], f"tendon {j}", c) for j, c in three),
                "tautness [rad]",
                levels=(Level(TAUT, "least"),),
            ),
            Panel(tuple(bars), "active limits"),
        ),
        x_label="time [s]",
    )


def main(folder: Path) -> None:
    """Run, draw, and say what was kept."""
    done = run()
    folder.mkdir(parents=True, exist_ok=True)
    chart_figure(chart(done)).savefig(folder / "mpc_limits.png", dpi=110)
    moves = np.abs(np.diff(done.motors, axis=0)).max() / TS
    print(f"largest pitch {np.degrees(np.abs(done.pitch)).max():.2f} deg (limit {math.degrees(LIMIT):g}), "
          f"fastest motor {moves:.2f} rad/s (limit {SLEW:g}), least tautness {done.tautness.min():.2f} rad "
          f"(limit {TAUT:g})")  # fmt: skip
    for kind, column in zip(KINDS, done.active.T, strict=True):
        print(f"{kind} limits were active in {100.0 * column.mean():.0f} % of the samples")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("build"))
