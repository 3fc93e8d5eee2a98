"""A layout proposed from a log: `softneck import --guess`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from softneck.core import DataError, ReprMixin
from softneck.robot import Robot

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, NECK, OUTPUTS, SET_POINTS
from ..recording._redefinition import redefine
from ..recording._resampling import jitter
from ._clocks import SampleTime, estimate_sample_time
from ._column_shapes import lagged
from ._doubts import (
    ONE_AXIS,
    SURE,
    Doubt,
    doubts_of,
    duplicates_doubt,
    jitter_doubt,
    one_axis_doubt,
    percent,
    settled,
    sign_doubt,
)
from ._draft import Draft, say
from ._guess_names import by_names, drop_or_turn_quaternion, one_axis, stand_ins
from ._guess_shapes import by_shapes
from ._guess_units import Unit, nominal_step, units
from ._layout import Column, Layout, Source, Term, layout_toml
from ._table_format import sniff

_NO_CHANNELS = ("time", "run", "inclination", "orientation")
# Half a second at 20 ms: the platform answers within it.
_NECK_LAG = 25


@dataclass(frozen=True, slots=True, repr=False)
class Guess(ReprMixin):
    """A layout that was proposed for a log, with the reason for each line.

    Attributes:
        layout: as far as it goes.
        text: the same as TOML, with a remark on each line and what is still open at its end.
        lines: what was taken for what, and why; what was left out, and why; what is not sure.
        missing: what a recording needs and was not found, each with its candidates and the layout's line for it.
        doubts: what is less than 90 % sure, the least sure first.
    """

    layout: Layout
    text: str
    lines: tuple[str, ...]
    missing: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()
    _remarks: Mapping[str, str] = field(default_factory=dict, repr=False)
    _head: str = field(default="", repr=False)

    def settled(self, doubt: Doubt, choice: str | None = None) -> Guess:
        """Return the guess where one of its doubts was settled: as it was taken, or by another of its choices.

        Raises:
            SettingsError: not one of its choices.
        """
        layout = self.layout if choice is None else settled(self.layout, doubt, choice)
        said = f"{doubt.about}: {choice or doubt.taken}, as was answered"
        remarks = {**self._remarks, **dict.fromkeys(doubt.channels, said)}
        return self._written(layout, remarks, self.missing, tuple(one for one in self.doubts if one is not doubt))

    def with_sample_time(self, sample_time: float) -> Guess:
        """Return the guess of a log without a clock, at a sample time [s] that the user knows."""
        missing = tuple(line for line in self.missing if not line.startswith(_NO_CLOCK))
        remarks = {**self._remarks, "sample_time": "as was answered"}
        return self._written(replace(self.layout, sample_time=sample_time), remarks, missing, self.doubts)

    def _written(
        self, layout: Layout, remarks: Mapping[str, str], missing: tuple[str, ...], doubts: tuple[Doubt, ...]
    ) -> Guess:
        text = self._head + layout_toml(layout, remarks=remarks, open_ends=[f"MISSING {line}" for line in missing])
        return replace(self, layout=layout, text=text, missing=missing, doubts=doubts, _remarks=remarks)


_NO_CLOCK = "the sample time"
# Candidates that a line of what is missing names; the page and the notes have all.
_SHOWN = 3
_NO_MOTORS = "no column is of a motor; record their set-points, positions or velocities too"


def guess_layout(path: str | Path, *, robot: Robot = NECK) -> Guess:
    """Return a layout for a log of which nothing is known: a text, spreadsheet, Parquet, MAT or MCAP file.

    Args:
        path: the log.
        robot: the neck that it is of, for its motors' range.

    Raises:
        FileFormatError: no such file, or no table.
        DataError: a table of fewer columns than a recording needs.
    """
    # Damaged logs hold infinities; sums of them are no news to the user.
    with np.errstate(all="ignore"):
        return _guess(Path(path), robot)


def _guess(path: Path, neck: Robot) -> Guess:
    draft = Draft(sniff(path))
    by_names(draft)
    by_shapes(draft)
    stand_ins(draft)
    drop_or_turn_quaternion(draft)
    draft.order()
    found = units(draft)
    moved = all(name in draft.picks for name in SET_POINTS)
    robot = one_axis(draft, _other_axis(draft), neck) if moved else neck
    check_lines, sign_doubts = _checks(draft)
    layout, clock_lines, clock_doubts = _clocked(draft, found, _layout(draft, found, robot))
    missing = _missing(draft, layout)
    other_doubts = [*sign_doubts, *([one_axis_doubt(robot.outputs.names[0])] if robot is not neck else [])]
    doubts = sorted([*doubts_of(draft, found), *clock_doubts, *other_doubts], key=lambda doubt: doubt.confidence)
    remarks = {name: _why(draft, found, name) for name in draft.picks}
    remarks |= {doubt.channels[0]: f"{remarks[doubt.channels[0]]}; NOT SURE: {doubt}" for doubt in other_doubts}
    remarks["file"] = "; ".join(line.removeprefix("file: ") for line in draft.sniffed.lines)
    remarks["sample_time"] = "; ".join([*clock_lines, *(f"NOT SURE: {doubt}" for doubt in clock_doubts)])
    remarks["quaternion"] = _marked(draft.quaternion_sure) + draft.quaternion_why
    lines = [*draft.sniffed.lines, *(_line(draft, found, name) for name in draft.picks), *clock_lines]
    if draft.quaternion is not None:
        lines.append(
            _doubted(f"pitch and roll from a quaternion: because {draft.quaternion_why}", draft.quaternion_sure)
        )
    if layout.merge:
        lines.append("rows of several clocks, because set-points have empty cells: merged at the rows of the outputs")
    lines += [f"not sure: {doubt}" for doubt in doubts if doubt.about == ONE_AXIS]
    lines += [f"not sure: {doubt.why} ({percent(doubt.confidence)} sure of {doubt.taken})" for doubt in clock_doubts]
    lines += [*check_lines, *_left_out(draft)]
    head = f"# Proposed by `softneck import --guess` for {path.name!r}; edit it.\n\n"
    return Guess(layout, "", tuple(lines), missing, tuple(doubts), remarks, head)._written(
        layout, remarks, missing, tuple(doubts)
    )


def _layout(draft: Draft, found: dict[str, Unit], robot: Robot) -> Layout:
    def source(name: str) -> Source:
        pick, unit = draft.picks[name], found[name]
        terms = tuple(Term(term.column, unit.factor * term.factor) for term in pick.terms)
        return Source(terms, unit.name, pick.sign, pick.integrate)

    tilt = "inclination" in draft.picks and "orientation" in draft.picks
    asked = [term.column for name in SET_POINTS if name in draft.picks for term in draft.picks[name].terms]
    absent = {name for name in draft.picks if any(name.startswith(axis) for axis in OUTPUTS)
              and not name.startswith(robot.outputs.names)}  # fmt: skip
    return replace(
        draft.sniffed.form,
        # A set-point is never missed, as a measurement may be: where it is not said it holds.
        merge=draft.sniffed.form.merge and any(draft.sniffed.lacks(column) for column in asked),
        channels={name: source(name) for name in draft.picks if name not in _NO_CHANNELS and name not in absent},
        inclination=source("inclination") if tilt else None,
        orientation=source("orientation") if tilt else None,
        quaternion=draft.quaternion,
        time=source("time") if "time" in draft.picks else None,
        run=draft.picks["run"].terms[0].column if "run" in draft.picks else None,
        robot=robot,
    )


def _clocked(draft: Draft, found: dict[str, Unit], layout: Layout) -> tuple[Layout, list[str], list[Doubt]]:
    """Return the layout with its sample time, restarts and duplicates, why, and what is not sure of it."""
    lines: list[str] = []
    doubts: list[Doubt] = []
    if "time" in draft.picks:
        column = draft.picks["time"].terms[0].column
        step = np.diff(draft.sniffed.columns[column])
        one = len(draft.picks["time"].terms) == 1
        if "run" not in draft.picks and one and (step < 0).any():
            layout = replace(layout, new_run_at_restart=True)
            lines.append(f"runs: a new one at each restart, because time goes back {(step < 0).sum()} time(s)")
        if one and (step == 0).any():
            layout = replace(layout, duplicates="first")
            if not layout.merge:
                doubts.append(duplicates_doubt(int((step == 0).sum()), int(np.argmax(step == 0)) + 1))
        if one and not layout.merge and (limits := jitter(draft.values("time"))) is not None:
            scale = nominal_step(draft, found) / limits[2]
            doubts.append(jitter_doubt(*(scale * limit for limit in limits)))
    speed = _estimated(draft, found)
    if speed is None:
        return layout, lines, doubts
    if layout.time is None:
        rounded = round(speed.value, 3)
        value = rounded if rounded > 0 and not speed.contradicts(rounded) else float(f"{speed.value:.4g}")
        lines.append(f"sample time {1e3 * value:g} ms, because positions and velocities agree at {speed}")
        return replace(layout, sample_time=value), lines, doubts
    nominal = nominal_step(draft, found)
    if speed.contradicts(nominal):
        lines.append(f"sample time estimated, because positions and velocities agree at {speed}, "
                     f"not at the {1e3 * nominal:g} ms of the time column")  # fmt: skip
        return replace(layout, estimate=True), lines, doubts
    return layout, lines, doubts


def _estimated(draft: Draft, found: dict[str, Unit]) -> SampleTime | None:
    names = [name for name in (*MOTOR_POSITIONS, *MOTOR_VELOCITIES) if name in draft.picks]
    factors = {"deg": np.pi / 180, "deg/s": np.pi / 180, "rpm": np.pi / 30}
    channels = {name: factors.get(found[name].name, 1.0) * draft.values(name) for name in names}
    try:
        return estimate_sample_time(channels, draft.runs())
    except DataError:
        return None


def _sure(draft: Draft, found: dict[str, Unit], name: str) -> float:
    """Return how sure a channel is: of its column and of its unit, whichever is less."""
    return min(draft.picks[name].confidence, found[name].confidence if name in found else 1.0)


def _why(draft: Draft, found: dict[str, Unit], name: str) -> str:
    unit = f"; [{found[name].name}], because {found[name].why}" if name in found else ""
    return f"{_marked(_sure(draft, found, name))}{draft.picks[name].why}{unit}"


def _marked(sure: float) -> str:
    return "" if sure >= SURE else f"NOT SURE ({percent(sure)}): "


def _doubted(line: str, sure: float) -> str:
    return line if sure >= SURE else f"not sure: {line}; {percent(sure)} sure"


def _line(draft: Draft, found: dict[str, Unit], name: str) -> str:
    pick = draft.picks[name]
    columns = " and ".join(say(term.column) for term in pick.terms)
    unit = f" [{found[name].name}]" if name in found else ""
    reason = f"{pick.why}; {found[name].why}" if name in found else pick.why
    return _doubted(f"{name} from {columns}{unit}: because {reason}", _sure(draft, found, name))


def _checks(draft: Draft) -> tuple[list[str], list[Doubt]]:
    """Say whether the platform rises with the redefined inputs, as the signs of the public face ask.

    An angle that falls is turned round, which is the more likely answer, and marked as doubtful.
    """
    motors, platform = draft.motors(), draft.platform()
    if motors is None or not platform or len(motors) < 4 * _NECK_LAG:
        return [], []
    inputs, lines, doubts = redefine(motors), [], []
    for axis, u, name in (("pitch", inputs[:, 0], "theta_i"), ("roll", inputs[:, 1], "phi_i")):
        if axis not in platform:
            continue
        r, _ = lagged(u, platform[axis], _NECK_LAG)
        if r >= -0.5:
            lines.append(f"check: {axis} and {name} of the motors have correlation {r:.2f}")
            continue
        falls = f"not sure: {axis} falls as {name} rises (correlation {r:.2f})"
        if axis not in draft.picks:  # of a tilt, which has no sign of its own
            lines.append(f"{falls}; is the order of the motors right?")
            continue
        pick = draft.picks[axis]
        draft.picks[axis] = replace(pick, sign=-pick.sign)
        lines.append(f"{falls}: turned round; if that is wrong, write `sign = {pick.sign:g}`")
        doubts.append(sign_doubt(axis, name, r))
    return lines, doubts


def _left_out(draft: Draft) -> list[str]:
    lines = [f"ignored: {say(column)}: because it holds words" for column in draft.sniffed.words]
    q = draft.quaternion
    used = draft.used() | (set() if q is None else {q.w, q.x, q.y, q.z})
    for column in draft.sniffed.columns:
        if column in used:
            continue
        title = draft.titles.get(column)
        if np.isnan(draft.sniffed.columns[column]).all():
            reason = "it is empty"
        elif column in draft.passed_over:
            reason = draft.passed_over[column]
        elif title is not None and title.role == "ignored":
            reason = title.why
        elif column not in draft.moving:
            reason = "it never changes"
        elif title is not None and title.role != "unknown":
            reason = f"{title.why}, but a set of three motors or a better name was not found with it"
        else:
            reason = ("its name says nothing, and " if title else "") + "nothing in its data tells what it is"
        lines.append(f"ignored: {say(column)}: because {reason}")
    return lines


def _other_axis(draft: Draft) -> list[Column]:
    """Return the columns that may be an angle of the platform that was not found."""
    roles = ("yaw", "inclination", "orientation")
    named = [c for c, title in draft.titles.items() if title.role in roles and c not in draft.used()]
    return [*named, *(c for c in draft.free() if c not in named)]


def _missing(draft: Draft, layout: Layout) -> tuple[str, ...]:
    """Return what a recording needs and the layout does not give, each with the line that would do it."""
    lines = []
    absent = [name for name in SET_POINTS if name not in draft.picks]
    if absent:
        names = "motor_setpoint_1..3" if len(absent) == 3 else ", ".join(absent)
        free = draft.free()
        lines.append(f"{names}: {_to_name(absent[0], free, 'rad') if free else _NO_MOTORS}")
    axes = [name for name in layout.robot.outputs.names if name not in draft.picks]
    if axes and layout.inclination is None and layout.quaternion is None:
        lines.append(f"{', '.join(axes)}: {_to_name(axes[0], _other_axis(draft), 'deg')}")
    if layout.time is None and layout.sample_time is None:
        lines.append(f"{_NO_CLOCK}: no column rises by equal steps; say `--sample-time S`")
    return tuple(lines)


def _to_name(channel: str, candidates: list[Column], unit: str) -> str:
    """Return the layout's line that names a channel, and the first columns that it may be."""
    if not candidates:
        return "no column is left that moves; record it too"
    shown = ", ".join(repr(column) for column in candidates[:_SHOWN]) + (", ..." if candidates[_SHOWN:] else "")
    return f"is it {shown}? Write `{channel} = {{ column = {_toml(candidates[0])}, unit = '{unit}' }}`"


def _toml(column: Column) -> str:
    return f"'{column}'" if isinstance(column, str) else str(column)
