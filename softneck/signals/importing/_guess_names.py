"""The part of a guess that uses column titles, checked against the data if several fit."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace

import numpy as np

from softneck.core import SoftneckError, spelled_unit
from softneck.robot import Robot

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, OUTPUTS, SET_POINTS, parse_column, redefine
from ._clocks import axis_rotations, velocity_period
from ._column_titles import Title, plain
from ._draft import Draft, Pick, column_label
from ._guess_shapes import max_correlation
from ._layout import Column, Quaternion, Term

# `imu.orientation.x`, `quat_w`, `qx`, `rotation[2]`: prefix and component.
_PART = re.compile(r"(?P<of>.*?(?:quat\w*|orientation|attitude|rotation|\bq|_q))[._ \[]?(?P<part>[wxyz])\]?")
_NECK_LAG = 25
# Confidence by names and correlation, and by names alone.
_BY_CORRELATION, _BY_CONVENTION = 0.95, 0.6
# Confidence in measured positions as inputs: correct, but a controller will have set-points.
_STAND_IN = 0.85


def quaternions(draft: Draft) -> None:
    """Take four columns that form a quaternion; they are no other channel."""
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
    """Discard the quaternion if angles were found; else choose the rotations that follow the motors."""
    q = draft.quaternion
    if q is None or draft.has(OUTPUTS) or draft.has(("inclination", "orientation")):
        draft.quaternion = None
        return
    columns = [draft.sniffed.columns[name] for name in (q.w, q.x, q.y, q.z)]
    values = np.column_stack(columns)[:20_000]
    motors, turned = draft.motors(), axis_rotations(values)
    draft.quaternion_why = (
        "turns about the sensor's y and x axes, as in ROS; which is pitch depends on how it is mounted"
    )
    draft.quaternion_sure = _BY_CONVENTION
    if motors is None or len(motors) < 4 * _NECK_LAG:
        return
    found: dict[str, tuple[float, str]] = {}
    for axis, u in zip(OUTPUTS, redefine(motors[: len(values)]).T, strict=False):
        answers = {name: max_correlation(u, np.nan_to_num(turned[name]), _NECK_LAG)[0] for name in turned}
        name = max(answers, key=lambda one: answers[one])
        found[axis] = (answers[name], name)
    (r, pitch), (s, roll) = found["pitch"], found["roll"]
    if min(r, s) > 0.5 and pitch[-1] != roll[-1]:
        draft.quaternion = replace(q, pitch=pitch, roll=roll)
        draft.quaternion_why = (
            f"turns about {pitch} and {roll} of the sensor rise with theta_i and phi_i of the motors (correlation "
            f"{r:.2f}, {s:.2f})"
        )
        draft.quaternion_sure = min(_BY_CORRELATION, 0.2 + min(r, s))


def use_positions_as_inputs(draft: Draft) -> None:
    """Use positions, or integrated velocities, as inputs if no set-points were logged."""
    if any(name in draft.picks for name in SET_POINTS):
        return
    if draft.has(MOTOR_POSITIONS):
        for set_point, there in zip(SET_POINTS, MOTOR_POSITIONS, strict=True):
            pick = draft.picks[there]
            why = f"no set-points were logged, so the positions are the inputs ({pick.why}), without the drives' lag"
            draft.picks[set_point] = replace(pick, why=why, confidence=min(_STAND_IN, pick.confidence))
            # Without a time column the positions and velocities determine the sample time.
            if "time" in draft.picks:
                del draft.picks[there]
    elif draft.has(MOTOR_VELOCITIES):
        for set_point, speed in zip(SET_POINTS, MOTOR_VELOCITIES, strict=True):
            pick = draft.picks[speed]
            why = f"no set-points or positions were logged, so the velocities, summed up, are the inputs ({pick.why})"
            sure = min(_STAND_IN, pick.confidence)
            draft.picks[set_point] = replace(pick, why=why, confidence=sure, integrate=True)


def one_axis(draft: Draft, candidates: list[Column], neck: Robot) -> Robot:
    """Return the neck, or its part in one plane if only one angle was logged and no column may be the other."""
    there = [name for name in OUTPUTS if name in draft.picks]
    if len(there) != 1 or candidates or draft.quaternion is not None or "inclination" in draft.picks:
        return neck
    return neck if neck.outputs.names != OUTPUTS else of_one_output(neck, there[0])


def of_one_output(neck: Robot, axis: str) -> Robot:
    """Return the part of a neck in the plane of one of its outputs."""
    weights = neck.weights()
    table = neck.as_dict()
    table["name"] = f"neck, {axis} only"
    table["outputs"]["names"] = [axis]
    row = [] if weights is None else weights[OUTPUTS.index(axis)].tolist()
    table["directions"] = {"kind": "matrix", "matrix": [row]}
    table.pop("plant", None)
    table.pop("drives", None)
    return Robot.from_dict(table)


# Smallest correlation of a rate with differences of its position.
_MIN_RATE_CORRELATION = 0.9

Family = tuple[Column, Column, Column]


def by_names(draft: Draft) -> None:
    """Take the columns that titles name."""
    own = _own_titles(draft)
    quaternions(draft)
    by_role: dict[str, list[tuple[int, Column]]] = defaultdict(list)
    for column, title in draft.titles.items():
        if column not in own:
            by_role[title.role].append((title.rank, column))
    _time_and_run(draft, by_role)
    positions = _families(draft, "position", own)
    if positions and not draft.has(MOTOR_POSITIONS):
        _take(draft, MOTOR_POSITIONS, positions[0])
    _set_points(draft, own)
    _velocities(draft, own)
    _platform(draft, by_role)
    for role in ("pitch_reference", "roll_reference", "pitch_rate", "roll_rate"):
        if role not in draft.picks and by_role[role]:
            column = min(by_role[role], key=lambda entry: entry[0])[1]
            draft.pick(role, column, draft.titles[column].why)


def _own_titles(draft: Draft) -> set[Column]:
    """Take columns with the titles of a recording."""
    own: set[Column] = set()
    for column in draft.titles:
        try:
            channel, _ = parse_column(str(column))
        except SoftneckError:
            continue
        if channel not in draft.picks:
            unit = str(column)[str(column).rindex("[") + 1 : -1].strip()
            draft.picks[channel] = Pick((Term(column),), "it is titled as in a recording of softneck", unit)
            own.add(column)
    return own


def _time_and_run(draft: Draft, by_role: dict[str, list[tuple[int, Column]]]) -> None:
    _seconds_and_nanoseconds(draft)
    by_role["time"] += [(0, column) for column in draft.sniffed.dates if (0, column) not in by_role["time"]]
    for _, column in sorted(by_role["time"], key=lambda entry: entry[0]):
        step = np.diff(draft.moving.get(column, np.zeros(0)))
        rising = float((step > 0).mean()) if step.size else 0.0
        if draft.sniffed.form.merge and step.size and (step >= 0).all():
            rising = 1.0  # messages of several clocks have one time
        if column in draft.used_columns():
            continue
        if "time" in draft.picks:
            draft.passed_over[column] = f"{column_label(draft.picks['time'].terms[0].column)} names time more clearly"
        elif rising > 0.5:
            why = draft.titles[column].why if column in draft.titles else "it holds dates"
            draft.pick("time", column, f"{why}, and it rises from row to row")
        else:
            draft.passed_over[column] = "it does not rise from row to row, so it is not a time"
    for _, column in by_role["run"]:
        values = draft.sniffed.columns[column]
        if "run" not in draft.picks and np.isfinite(values).all() and np.array_equal(values, np.round(values)):
            draft.pick("run", column, draft.titles[column].why)


def _seconds_and_nanoseconds(draft: Draft) -> None:
    """Take both columns of a ROS 2 stamp, which are a time only together."""

    def of(title: Title) -> str:
        return "" if spelled_unit(title.family) else title.family  # `sec` beside `nanosec` has no other name

    for column, title in draft.titles.items():
        if title.role == "time" and title.unit == "ns":
            whole = [c for c, t in draft.titles.items() if (t.role, of(t), t.unit) == ("time", of(title), "s")]
            if len(whole) == 1 and "time" not in draft.picks:
                terms = (Term(whole[0]), Term(column, 1e-9))
                draft.picks["time"] = Pick(terms, "both parts of a stamp of ROS 2", "s")


def _families(draft: Draft, role: str, own: set[Column]) -> list[Family]:
    """Return triples of columns numbered 1 to 3 or 0 to 2 that share a name, the clearest names first."""
    groups: dict[tuple[int, str], dict[int, Column]] = defaultdict(dict)
    for column, title in draft.titles.items():
        if title.role == role and title.motor is not None and column not in own:
            groups[title.rank, title.family].setdefault(title.motor, column)
    found = [(rank, group) for (rank, _), group in groups.items() if sorted(group) in ([1, 2, 3], [0, 1, 2])]
    ranked = [[group[number] for number in sorted(group)] for _, group in sorted(found, key=lambda entry: entry[0])]
    return [(first, second, third) for first, second, third in ranked]


def _take(draft: Draft, channels: tuple[str, ...], family: Family, more: str = "") -> None:
    for channel, column in zip(channels, family, strict=True):
        draft.pick(channel, column, draft.titles[column].why + more)


def _set_points(draft: Draft, own: set[Column]) -> None:
    """Take the set-points; of several families, the one that the positions follow most closely."""
    families = _families(draft, "set-point", own)
    if not families or draft.has(SET_POINTS):
        return
    if len(families) == 1 or not draft.has(MOTOR_POSITIONS):
        _take(draft, SET_POINTS, families[0])
        return
    scores = [_follow(draft, family) for family in families]
    best = int(np.argmax(scores))
    _take(draft, SET_POINTS, families[best], f", and the positions follow it (correlation {scores[best]:.2f})")
    for family, score in zip(families, scores, strict=True):
        for column in family if family is not families[best] else ():
            draft.passed_over[column] = (
                f"the positions follow {column_label(families[best][0])} and its like more closely than it"
            )
            if score > 0.999 * scores[best]:
                draft.passed_over[column] += ", by little: check"


def _follow(draft: Draft, family: Family) -> float:
    """Return the smallest correlation of the positions with a family; 0 for a constant."""
    pairs = [
        max_correlation(draft.moving[column], draft.values(position), 10)[0] if column in draft.moving else 0.0
        for column, position in zip(family, MOTOR_POSITIONS, strict=True)
    ]
    return min(pairs)


def _velocities(draft: Draft, own: set[Column]) -> None:
    """Take named velocities, or a speed command minus its error if that is the rate of the positions."""
    if draft.has(MOTOR_VELOCITIES):
        return
    named = _families(draft, "velocity", own)
    if named:
        _take(draft, MOTOR_VELOCITIES, named[0])
        return
    if not draft.has(MOTOR_POSITIONS):
        return
    commands = [family for family in _families(draft, "set-point", own) if family[0] not in draft.used_columns()]
    for command in commands:
        for error in _families(draft, "ignored", own):
            if not all(column in draft.moving for column in (*command, *error)):
                continue
            speeds = [draft.moving[c] - draft.moving[e] for c, e in zip(command, error, strict=True)]
            agree = min(
                velocity_period(draft.values(position), speed, draft.runs())[1]
                for position, speed in zip(MOTOR_POSITIONS, speeds, strict=True)
            )
            if agree > _MIN_RATE_CORRELATION:
                why = f"their difference is the rate of the position (correlation {agree:.2f} or more)"
                for channel, c, e in zip(MOTOR_VELOCITIES, command, error, strict=True):
                    draft.picks[channel] = Pick((Term(c), Term(e, -1.0)), why)
                    draft.passed_over.pop(c, None)
                return


def _platform(draft: Draft, by_role: dict[str, list[tuple[int, Column]]]) -> None:
    """Take pitch and roll, or else inclination and orientation."""
    best = {role: _best(draft, by_role[role]) for role in ("pitch", "roll", "inclination", "orientation")}
    for pair in (("pitch", "roll"), ("inclination", "orientation")):
        columns = [best[role] for role in pair]
        if draft.has(("pitch", "roll")) or None in columns:
            continue
        for role, column in zip(pair, columns, strict=True):
            if column is not None and role not in draft.picks:
                draft.pick(role, column, draft.titles[column].why)
        break
    for role in ("pitch", "roll"):
        column = best[role]
        if column is not None and role not in draft.picks and "inclination" not in draft.picks:
            draft.pick(role, column, draft.titles[column].why)
    for role in ("pitch", "roll", "yaw", "inclination", "orientation"):
        for _, column in by_role[role]:
            if column not in draft.used_columns():
                draft.passed_over.setdefault(column, _not_taken(draft, role))


def _best(draft: Draft, entries: list[tuple[int, Column]]) -> Column | None:
    moving = [entry for entry in entries if entry[1] in draft.moving]
    return min(moving or entries, key=lambda entry: entry[0])[1] if entries else None


def _not_taken(draft: Draft, role: str) -> str:
    if role == "yaw":
        return "yaw is not a channel of a recording; where your second axis is yaw, write it as `roll` with its sign"
    taken = role if role in draft.picks else "pitch"
    return (
        f"{column_label(draft.picks[taken].terms[0].column)} was taken"
        if taken in draft.picks
        else "the other angle of its pair is missing"
    )
