"""What a guess does where a log lacks what recordings have: no set-points, a quaternion for angles, one axis only."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace

import numpy as np

from softneck.robot import Robot

from ..recording._channels import MOTOR_POSITIONS, MOTORS, OUTPUTS, SET_POINTS
from ..recording._redefinition import redefine
from ._column_shapes import lagged
from ._draft import Draft
from ._layout import Column, Quaternion
from ._tilt import turns
from ._title_words import plain

_VELOCITIES = tuple(f"motor_velocity_{j}" for j in MOTORS)
# `imu.orientation.x`, `quat_w`, `qx`, `rotation[2]`: what it is of, and which part.
_PART = re.compile(r"(?P<of>.*?(?:quat\w*|orientation|attitude|rotation|\bq|_q))[._ \[]?(?P<part>[wxyz])\]?")
_NECK_LAG = 25
# Names and the motors' answer agree, or names alone.
_SURE, _BY_CONVENTION = 0.95, 0.6
# What was logged takes the place of what was asked for: true, but another input than a controller will have.
_STAND_IN = 0.85


def quaternions(draft: Draft) -> None:
    """Take four columns that are a quaternion, and pass them over as anything else."""
    groups: dict[str, dict[str, Column]] = defaultdict(dict)
    for column in draft.titles:
        match = _PART.fullmatch(plain(str(column)).strip())
        if match is not None:
            groups[match["of"]][match["part"]] = column
    whole = [parts for parts in groups.values() if set(parts) == set("wxyz")]
    for parts in whole:
        for name, column in parts.items():
            draft.passed_over[column] = f"it is `{name}` of a quaternion"
            draft.titles[column] = replace(draft.titles[column], role="quaternion")
    if whole:
        parts = whole[0]
        draft.quaternion = Quaternion(parts["w"], parts["x"], parts["y"], parts["z"])


def drop_or_turn_quaternion(draft: Draft) -> None:
    """Leave a quaternion out where angles were found; else find which of its turns answer the motors."""
    q = draft.quaternion
    if q is None or draft.has(OUTPUTS) or draft.has(("inclination", "orientation")):
        draft.quaternion = None
        return
    columns = [draft.sniffed.columns[name] for name in (q.w, q.x, q.y, q.z)]
    values = np.column_stack(columns)[:20_000]
    motors, turned = draft.motors(), turns(values)
    draft.quaternion_why = (
        "turns about the sensor's y and x axes, as in ROS; which is pitch depends on how it is mounted"
    )
    draft.quaternion_sure = _BY_CONVENTION
    if motors is None or len(motors) < 4 * _NECK_LAG:
        return
    found: dict[str, tuple[float, str]] = {}
    for axis, u in zip(OUTPUTS, redefine(motors[: len(values)]).T, strict=False):
        answers = {name: lagged(u, np.nan_to_num(turned[name]), _NECK_LAG)[0] for name in turned}
        name = max(answers, key=lambda one: answers[one])
        found[axis] = (answers[name], name)
    (r, pitch), (s, roll) = found["pitch"], found["roll"]
    if min(r, s) > 0.5 and pitch[-1] != roll[-1]:
        draft.quaternion = replace(q, pitch=pitch, roll=roll)
        draft.quaternion_why = (
            f"turns about {pitch} and {roll} of the sensor rise with theta_i and phi_i of the motors (correlation "
            f"{r:.2f}, {s:.2f})"
        )
        draft.quaternion_sure = min(_SURE, 0.2 + min(r, s))


def stand_ins(draft: Draft) -> None:
    """Take positions, or sums of velocities, as inputs where no set-points were logged, and say so."""
    if any(name in draft.picks for name in SET_POINTS):
        return
    if draft.has(MOTOR_POSITIONS):
        for asked, there in zip(SET_POINTS, MOTOR_POSITIONS, strict=True):
            pick = draft.picks[there]
            why = f"no set-points were logged, so the positions are the inputs ({pick.why}), without the drives' lag"
            draft.picks[asked] = replace(pick, why=why, confidence=min(_STAND_IN, pick.confidence))
            # Positions and velocities tell the sample time where nothing else does.
            if "time" in draft.picks:
                del draft.picks[there]
    elif draft.has(_VELOCITIES):
        for asked, speed in zip(SET_POINTS, _VELOCITIES, strict=True):
            pick = draft.picks[speed]
            why = f"no set-points or positions were logged, so the velocities, summed up, are the inputs ({pick.why})"
            sure = min(_STAND_IN, pick.confidence)
            draft.picks[asked] = replace(pick, why=why, confidence=sure, integrate=True)


def one_axis(draft: Draft, candidates: list[Column], neck: Robot) -> Robot:
    """Return the neck, or the part of it that bends in the one plane that was logged.

    It is a part only where no column could be the other angle; its channels are those of a neck but for that.
    """
    there = [name for name in OUTPUTS if name in draft.picks]
    if len(there) != 1 or candidates or draft.quaternion is not None or "inclination" in draft.picks:
        return neck
    weights = neck.weights()
    table = neck.as_dict()
    table["name"] = f"neck, {there[0]} only"
    table["outputs"]["names"] = there
    row = [] if weights is None else weights[OUTPUTS.index(there[0])].tolist()
    table["directions"] = {"kind": "matrix", "matrix": [row]}
    table.pop("plant", None)
    table.pop("drives", None)
    return Robot.from_dict(table)
