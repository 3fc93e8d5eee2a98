"""What the moves would show if all were as the files say: the same moves on the virtual plant that stands for it."""

from __future__ import annotations

from dataclasses import replace

from softneck.plant import NeckParameters

from ..bus._file import DrivesFile
from ..bus._link import VirtualLink
from ..running._bus_loop import Session
from ..running._virtual import physics_of, simulated_neck
from ._identify import Expected, seen_by
from ._measure import SAMPLE_TIME, measure
from ._moves import Guards


def expected_of(file: DrivesFile, guards: Guards, neck: NeckParameters | None = None) -> Expected | None:
    """Return what the virtual plant of the robot shows with drives as `file` has them; None where there is none.

    Args:
        file: as believed.
        guards: as for the moves themselves.
        neck: physics of the virtual plant; None: those that the robot names.
    """
    physics = physics_of(file.moves, neck)
    if physics is None:
        return None
    # A sensor that sits as it should, next to no noise; every drive as the first, for a mistake would be in it as well.
    physics = physics.replace(noise_std=1e-6, noise_quantum=0.0, drift_std=0.0, dropout_rate=0.0)
    file = replace(file, sensor_axes=())
    link = VirtualLink(simulated_neck(file, physics, sample_time=SAMPLE_TIME, homed=False))
    moves, _ = measure(Session(file=file, link=link), guards, motors=tuple(range(1, len(file.drives) + 1)))
    return seen_by(moves, file, "the virtual plant, with drives as the file has them")
