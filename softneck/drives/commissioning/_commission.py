"""Commissioning: scan, small guarded moves, their results, and corrected files."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w

from softneck.core import (
    CheckFailedError,
    OutputFileError,
    SettingsError,
    refuse_existing,
    require_whole,
    to_si,
    write_text,
)
from softneck.plant import NeckParameters
from softneck.robot import Robot

from ..bus._file import DrivesFile
from ..bus._link import VirtualLink
from ..bus._objects import ampere
from ..bus._read import drives_table
from ..running._bus_loop import RunEnd, Session
from ..running._preflight import scan
from ..simulated._springs import SimulatedSprings
from ._findings import Finding, fatal, known_before, require_answers, with_type_currents
from ._identify import LATE, Expected, Identified, apply_findings, identify
from ._measure import expected_of, measure
from ._moves import PULLED, Guards, Moves

DRIVES, ROBOT = "drives.toml", "robot.toml"
_FILE_HEAD = "# Proposed by `softneck drives commission`; read it before it is used.\n"


@dataclass(frozen=True, slots=True, eq=False)
class Commissioned:
    """The result of a commissioning.

    Attributes:
        believed: the drives file as it was given.
        findings: what is not as it says, or as the robot file says.
        moves: as measured; None where nothing moved.
        identified: what they say; None where nothing moved.
        expected: what was expected of them; None where no virtual plant stands for the robot.
        file, robot: that would be right, as far as it is known.
        ended: how the run on the drives ended; None where there was none.
    """

    believed: DrivesFile
    findings: tuple[Finding, ...]
    moves: Moves | None
    identified: Identified | None
    expected: Expected | None
    file: DrivesFile
    robot: Robot
    ended: RunEnd | None = None

    @property
    def holds(self) -> bool:
        """Whether everything was checked and agrees with the files."""
        return not self.findings

    def require(self) -> None:
        """Raise CheckFailedError with the findings in one line."""
        if self.ended is not None and self.ended.master.supervisor.rehome:
            self.ended.require()
        if self.findings:
            told = "; ".join(str(one) for one in self.findings)
            raise CheckFailedError(f"{len(self.findings)} finding(s): {told}.")

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives commission`."""
        nothing = {"late_s": math.nan, "noise_deg": math.nan, "quiet": False}
        found = self.identified
        sensor = nothing if found is None else {
            "late_s": found.late, "noise_deg": math.degrees(found.noise), "quiet": found.quiet,
        }  # fmt: skip
        return {
            "holds": self.holds,
            "findings": [one.table() for one in self.findings],
            "motors": [] if found is None else [motor_table(self, j) for j in range(1, len(found.motors) + 1)],
            "sensor": {**sensor, "axes": list(self.file.sensor_axes), "delay_s": self.robot.delay_s},
            "expected": None if self.expected is None else self.expected.source,
            "stopped": "" if self.moves is None else self.moves.stopped,
            **({} if self.ended is None else self.ended.table()),
        }


def motor_table(result: Commissioned, motor: int) -> dict[str, Any]:
    """Return the result of motor `motor` of the given drives file, from 1 on, in SI units."""
    found, entry = result.identified, result.believed.drives[motor - 1]
    one = None if found is None else found.motors[motor - 1]
    table: dict[str, Any] = {"motor": motor, "node": entry.node, "outcome": "not moved"}
    if result.moves is not None and (moved := result.moves.of(motor)) is not None:
        table["outcome"] = moved.outcome
    if found is None or one is None:
        return table
    right = next(made for made in result.file.drives if made.node == entry.node)
    counts, unit = abs(right.scale.counts_per_radian), ampere(right, result.file.profile)
    neck = result.file.neck
    newton = unit * neck.torque_constant * neck.efficiency * right.scale.gear / neck.winch_radius
    return table | {
        "tendon": motor if found.mounting is None else found.mounting.order[motor - 1] + 1,
        "reversed": right.scale.reversed,
        "gear": right.scale.gear,
        "encoder_counts": right.scale.counts_per_turn,
        "peak_current_A": right.scale.peak_current,
        "index": one.turn > 0,
        "slack_rad": max(0.0, one.slack / counts),
        "friction_A": one.friction * unit,
        "friction_N": one.friction * newton,
        "tilt_deg_per_rad": math.degrees(one.gain * counts),
        "tilt_error": one.error,
        "tension_N_per_rad": one.force * counts * newton,
        "direction": one.direction.tolist(),
        "lag_s": one.lag,
    }


def commission(
    session: Session,
    *,
    guards: Guards | None = None,
    neck: NeckParameters | None = None,
    motors: Sequence[int] = (),
    report: Callable[[float, str], None] | None = None,
    where: str = "the bus",
) -> Commissioned:
    """Find out how drives, tendons and sensor are really set up, by moves of some degrees that are guarded.

    Before the first motion all devices on the bus are identified; two devices with one number, or a missing drive, end
    it. Then each motor in turn is led out of its slack until the neck tilts by a degree.

    Args:
        session: on which drives; its drives file is what is believed.
        guards: limits of the moves; None: as slow as the gain in [watch] asks for.
        neck: the virtual plant to compare with; None: the one that the robot names.
        motors: those that move, from 1 on; () for all.
        report: called now and then with the done fraction and a word.
        where: the bus, for messages.

    Raises:
        CheckFailedError: nobody answers, or the pre-flight failed; nothing moved.
        BusError: the bus takes no frames.
        SettingsError: no such motor, or springs in the place of the robot.
    """
    file, count = session.file, len(session.file.drives)
    if isinstance(session.link, VirtualLink) and isinstance(session.link.neck, SimulatedSprings):
        raise SettingsError(
            f"robot {file.moves.label()} has no virtual plant, and the springs that stand in for it pull both "
            "ways: moves say nothing of them. Give it one: [plant] neck in the robot file."
        )
    for motor in motors:
        require_whole("--motor", motor, 1, count)
    guards = Guards.of(file.watch.gain) if guards is None else guards
    found = scan(session.link, bit_rate=file.bit_rate)
    require_answers(found, where)
    told = known_before(file, found)
    if fatal(told):
        return Commissioned(file, tuple(told), None, None, None, file, file.moves)
    # Whose type says what its current is relative to is led by that from the first move on.
    believed, peaks = with_type_currents(file, found)
    moves, ended = measure(replace(session, file=believed), guards, motors=motors or range(1, count + 1), report=report)
    pulled = any(moved.outcome == PULLED for moved in moves.motors)
    expected = expected_of(believed, guards, neck) if pulled else None
    seen = identify(moves, believed, expected, types=peaks)
    right = apply_findings(believed, seen)
    return Commissioned(
        file, (*told, *seen.findings), moves, seen, expected, right, _robot(right, seen, expected), ended
    )


def _robot(file: DrivesFile, found: Identified, expected: Expected | None) -> Robot:
    """Return the robot file with the measured sensor values and the proposed drives file."""
    robot = file.moves
    motors = robot.motors
    if min(motors.sign) < 0.0:
        signs = tuple(-1.0 if entry.scale.reversed else 1.0 for entry in file.drives)
        motors = replace(motors, sign=signs)
    noise, delay = robot.noise_std, robot.delay_s
    if math.isfinite(found.noise):
        noise = float(f"{found.noise / to_si(robot.outputs.unit)[0]:.2g}")
    if expected is not None and found.late > LATE:
        delay = round((delay or 0.0) + found.late, 3)
    neck = robot.neck
    if neck is not None and robot.folder is not None and Path(robot.folder / neck).is_file():
        neck = str((robot.folder / neck).resolve())
    return replace(robot, motors=motors, noise_std=noise, delay_s=delay, neck=neck, drives="drives.toml")


def require_folder(folder: Path, *, force: bool) -> None:
    """Raise where the files of a commissioning could not be written; before anything moves.

    Raises OutputFileError: a file exists and not `force`, or the folder cannot be written.
    """
    for name in (DRIVES, ROBOT):
        refuse_existing(folder / name, force=force)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFileError(
            f"{folder}: cannot be written: {error.strerror}. Choose another folder; nothing was sent."
        ) from error


def write_files(folder: Path, result: Commissioned, *, force: bool) -> dict[str, str]:
    """Write the proposed drives and robot file; return name -> path. Without moves there are none."""
    if result.moves is None:
        return {}
    # All in memory before the first is written.
    texts = {DRIVES: tomli_w.dumps(drives_table(result.file)), ROBOT: tomli_w.dumps(result.robot.as_dict())}
    for name, text in texts.items():
        write_text(folder / name, _FILE_HEAD + text, force=force)
    return {Path(name).stem: str(folder / name) for name in texts}
