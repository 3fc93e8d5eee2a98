"""A robot bent by tendons in three dimensions, in one HTML file without network or library."""

from __future__ import annotations

import html
import json
from importlib.resources import files

import numpy as np

from softneck.core import DataError, Matrix, to_si
from softneck.robot import Robot
from softneck.signals import Recording, file_unit

# Link length and attachment radius of the lab's neck [m] (hardware facts); other robots are drawn with the same ones.
LINK_LENGTH, ATTACHMENT_RADIUS = 0.107, 0.052
# [s] Shortest time between frames: a screen shows no more of this neck than 50 Hz.
_FRAME_TIME = 0.02


def neck_view(recording: Recording, *, title: str = "The neck") -> str:
    """Return an HTML page that animates the first run of a recording or simulation result.

    The angles give the bend of a link of constant curvature (one angle: in a plane); `compression` shortens it if
    recorded. Tendons are coloured by `tension_1..` if recorded, else by the motors.

    Raises:
        DataError: no sample of the angles, a tilt beyond 90 deg, or another kind of robot.
    """
    if why := why_not_drawn(recording.robot):
        raise DataError(why)
    run = recording.runs()[0]
    keep = slice(None, None, max(1, round(_FRAME_TIME / run.sample_time)))
    angles = _fill_missed(run.outputs[keep], run.robot)
    unit = file_unit(run.robot.set_points[0], run.robot)
    tensions = [f"tension_{j + 1}" for j in range(len(run.robot.motors.names))]
    taut = all(name in run.channels for name in tensions)
    pulls = np.maximum(run.motor_positions / to_si(unit)[0], 0.0)
    if taut:
        pulls = np.nan_to_num(np.column_stack([run.channels[name] for name in tensions]))
    compression = np.nan_to_num(run.channels.get("compression", np.zeros(len(run))))
    frames = {
        "time": _round(run.time[keep] - run.time[0], 4),
        "bend": _round(bend_of(np.column_stack([angles, np.zeros(len(angles))])[:, :2]), 5),
        "angles": _round(np.degrees(angles), 2),
        "compression": _round(compression[keep], 6),
        "pull": _round(pulls[keep], 3),
        "unit": "N" if taut else unit,
        "names": run.robot.outputs.names,
        "tendons": run.robot.directions.angles_for(run.robot.outputs.names),
        "length": LINK_LENGTH,
        "radius": ATTACHMENT_RADIUS,
    }
    template = files("softneck.plots").joinpath("_neck3d.html").read_text(encoding="utf-8")
    # JSON permits `<\/`; a bare `</` would end the script.
    data = json.dumps(frames).replace("</", "<\\/")
    return template.replace("@@TITLE@@", html.escape(title)).replace("@@DATA@@", data)


def why_not_drawn(robot: Robot) -> str:
    """Return why `robot` has no view in 3-D; empty if it has one."""
    if robot.directions.kind == "tendons" and to_si(robot.outputs.unit)[1] == "rad":
        return ""
    return f"robot {robot.label()} has no view in 3-D: only robots bent by tendons at known angles have one."


def bend_of(angles: Matrix) -> Matrix:
    """Return the bending vectors (time, 2) [rad] of a link whose end is at pitch and roll (time, 2) [rad].

    The platform's normal is (tan pitch, tan roll, 1), normalised; the vector has its direction, and its angle from the
    vertical as length.
    """
    lean = np.tan(angles)
    size = np.hypot(lean[:, 0], lean[:, 1])
    # atan(x) / x, with its limit for the straight neck.
    factor = np.divide(np.arctan(size), size, out=np.ones_like(size), where=size > 1e-12)
    return lean * factor[:, None]


def _fill_missed(angles: Matrix, robot: Robot) -> Matrix:
    """Hold the last sample for missed ones; the first sample fills missed ones before it."""
    good = np.isfinite(angles).all(axis=1)
    if not good.any():
        raise DataError(f"the recording has no sample of {' and '.join(robot.outputs.names)} to draw.")
    if np.abs(angles[good]).max() >= np.pi / 2:
        names = " or ".join(robot.outputs.names)
        raise DataError(f"{names} exceeds 90 deg; a neck does not bend so far. Are the angles in degrees?")
    last = np.maximum.accumulate(np.where(good, np.arange(good.size), int(np.argmax(good))))
    return angles[last]


def _round(values: np.ndarray, digits: int) -> list:
    return np.round(values, digits).tolist()
