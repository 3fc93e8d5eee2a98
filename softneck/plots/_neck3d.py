"""A robot bent by tendons in three dimensions: link, tendons coloured by tension and platform, in one HTML file.

The page needs no network and no library: a canvas and a short renderer that it carries along.
"""

from __future__ import annotations

import html
import json
from importlib.resources import files

import numpy as np

from softneck.core import DataError, Matrix, to_si
from softneck.robot import Robot
from softneck.signals import Recording, file_unit

# The lab's neck (hardware facts): link length and attachment radius [m]; robots of other sizes are drawn alike.
LINK_LENGTH, ATTACHMENT_RADIUS = 0.107, 0.052
# Samples a page carries at most per second; 50 Hz is more than a screen shows of this neck.
_FRAME_TIME = 0.02


def neck_view(recording: Recording, *, title: str = "The neck") -> str:
    """Return an HTML page that plays the neck, or another robot bent by tendons, of a recording or simulation result.

    The two angles (one: in a plane) give the bend of a link of constant curvature; `compression` shortens it where it
    was recorded. Tendons are coloured by `tension_1..` where those were recorded, else by the motors.

    Args:
        recording: its first run is played.
        title: of the page.

    Raises:
        DataError: no sample of the angles, a tilt beyond 90 deg, or a robot that is not bent by tendons.
    """
    if why := not_drawn(recording.robot):
        raise DataError(why)
    run = recording.runs()[0]
    keep = slice(None, None, max(1, round(_FRAME_TIME / run.sample_time)))
    angles = _held(run.outputs[keep], run.robot)
    unit = file_unit(run.robot.set_points[0], run.robot)
    tensions = [f"tension_{j + 1}" for j in range(len(run.robot.motors.names))]
    taut = all(name in run.channels for name in tensions)
    pulls = np.maximum(run.motor_positions / to_si(unit)[0], 0.0)
    if taut:
        pulls = np.nan_to_num(np.column_stack([run.channels[name] for name in tensions]))
    compression = np.nan_to_num(run.channels.get("compression", np.zeros(len(run))))
    frames = {
        "time": _rounded(run.time[keep] - run.time[0], 4),
        "bend": _rounded(bend_of(np.column_stack([angles, np.zeros(len(angles))])[:, :2]), 5),
        "angles": _rounded(np.degrees(angles), 2),
        "compression": _rounded(compression[keep], 6),
        "pull": _rounded(pulls[keep], 3),
        "unit": "N" if taut else unit,
        "names": run.robot.outputs.names,
        "tendons": run.robot.directions.angles_deg,
        "length": LINK_LENGTH,
        "radius": ATTACHMENT_RADIUS,
    }
    template = files("softneck.plots").joinpath("_neck3d.html").read_text(encoding="utf-8")
    # `</` inside a script would end it; in JSON `<\/` is the same text.
    data = json.dumps(frames).replace("</", "<\\/")
    return template.replace("@@TITLE@@", html.escape(title)).replace("@@DATA@@", data)


def not_drawn(robot: Robot) -> str:
    """Return in a line why `robot` has no view; empty where it has one."""
    if robot.directions.kind == "tendons" and to_si(robot.outputs.unit)[1] == "rad":
        return ""
    return f"robot {robot.label()} has no view in 3-D: it is drawn of robots that tendons at known angles bend."


def bend_of(angles: Matrix) -> Matrix:
    """Return the bending vectors (time, 2) [rad] of a link whose end is at pitch and roll (time, 2) [rad].

    The platform's normal is (tan pitch, tan roll, 1), normalised; the vector points where it leans and is
    as long as its angle from the vertical.
    """
    lean = np.tan(angles)
    size = np.hypot(lean[:, 0], lean[:, 1])
    # atan(x) / x, with its limit at the straight neck.
    factor = np.divide(np.arctan(size), size, out=np.ones_like(size), where=size > 1e-12)
    return lean * factor[:, None]


def _held(angles: Matrix, robot: Robot) -> Matrix:
    """Fill missed samples with the last one before (the first one after, at the start)."""
    good = np.isfinite(angles).all(axis=1)
    if not good.any():
        raise DataError(f"the recording has no sample of {' and '.join(robot.outputs.names)} to draw.")
    if np.abs(angles[good]).max() >= np.pi / 2:
        names = " or ".join(robot.outputs.names)
        raise DataError(f"{names} exceeds 90 deg; a neck does not bend so far. Are the angles in degrees?")
    last = np.maximum.accumulate(np.where(good, np.arange(good.size), int(np.argmax(good))))
    return angles[last]


def _rounded(values: np.ndarray, digits: int) -> list:
    return np.round(values, digits).tolist()
