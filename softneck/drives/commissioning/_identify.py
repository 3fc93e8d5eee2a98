"""From measured moves to findings: a pure function; drives, clocks and files are elsewhere.

Three scales act on what a motor shows: counts of the encoder for a turn (the index pulse tells them alone), gear (tilt
for a turn), and the current's (current for a tension, which goes with the gear as well). What the neck itself gives for
a turn is expected from its virtual plant, or from the other motors, and is known to a part; the scales are looked for
among powers of two first, for that is how they are mistaken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector

from ..bus._file import DrivesFile
from ..bus._objects import ampere
from ..bus._sensor_source import Axes, axes_of, inverse, said_of
from ._features import Features, features
from ._findings import Finding
from ._mounting import FITS, Mounting, explain
from ._moves import HANGS, PULLED, Moves

# How well the moves tell a motor's tilt, or force, for a turn, and how well those of a neck are known before: standard
# deviations, as powers of two (0.15: 11 %, 0.25: 19 %). The motors of the presets differ by 3 to 30 %.
_MOTOR, _NECK = 0.15, 0.25
# A scale this far from a power of two is none: then it is what was measured (0.35: 27 %).
_NO_POWER = 0.35
# Of a rise of some units the slope is known to this part of one.
_SLOPE_TOLERANCE = 0.4
# From one turn of the motor to the next an index comes within this part.
_INDEX_TOLERANCE = 0.02
# A sensor that is late by less than two samples is on time [s]; one whose noise is beyond this tells neither that nor
# gears and currents (the lab's first inclinometer has 0.27 deg, its second 0.04) [rad].
LATE, _NOISY = 0.04, math.radians(0.15)
# Nor does a motor whose tilt for a turn is known worse than to this part: half and twice are 0.7 and 1.4 away.
_SLOPE_LIMIT = 0.25


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected features of drives that are set up as in the file.

    `gain`: tilt for one radian of each tendon's winch [rad/rad]. `force`: current for one radian of each tendon's winch
    [A/rad]. `lag`: of the tilt [s]. `source`: where that is from.
    """

    gain: tuple[float, ...]
    force: tuple[float, ...]
    lag: float
    source: str


@dataclass(frozen=True, slots=True)
class Scale:
    """Ratios of one motor's values to those of the drives file; 1 if correct or not measurable."""

    lines: float = 1.0
    gear: float = 1.0
    peak: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The result of the moves.

    Attributes:
        findings: what is not as the files say.
        motors: of each motor what was seen, None where nothing was.
        scales: of each motor.
        mounting: which motors pull which tendons and how the sensor sits; None where it cannot be told.
        late: how much later than expected the sensor is [s]; NaN where it cannot be told.
        noise: of the sensor, standard deviation of an output [rad].
        quiet: whether the noise let gears, currents and lateness be judged.
    """

    findings: tuple[Finding, ...]
    motors: tuple[Features | None, ...]
    scales: tuple[Scale, ...]
    mounting: Mounting | None
    late: float
    noise: float
    quiet: bool


def identify(
    moves: Moves, file: DrivesFile, expected: Expected | None, *, types: Mapping[int, float] | None = None
) -> Identified:
    """Compare `moves` with `file` and return the result.

    Args:
        moves: as measured.
        file: what was believed when they were.
        expected: what they would show if it were right; None: motors are compared with each other only, and a
            mistake that all of them share does not show.
        types: motor, from 1 on -> peak current by the drive's type [A], where that is public.
    """
    count = len(file.drives)
    seen = tuple(None if (moved := moves.of(j)) is None else features(moved) for j in range(1, count + 1))
    mounting, turned = _mounting(seen, file)
    order = range(count) if mounting is None else mounting.order
    lags = [one.lag for one in seen if one is not None and math.isfinite(one.lag) and one.error < _SLOPE_LIMIT]
    noises = [one.noise for one in seen if one is not None]
    noise = float(np.median(noises)) if noises else math.nan
    quiet = noise < _NOISY
    scales = _scales(seen, file, expected, types or {}, order, quiet=quiet)
    late = float(np.median(lags)) - expected.lag if lags and quiet and expected is not None else math.nan
    findings = [*_still_motors(moves, count), *_signs(seen, file), *_scale_findings(scales, file, seen), *turned]
    findings += [Finding(
        "unclear", f"its tilt for a turn is known to {100.0 * one.error:.0f} % only: gear, current and lateness were "
        "not judged", "Does its tendon slide, is the sensor loose? Put it right and commission it anew.", (j,),
    ) for j, one in enumerate(seen, start=1) if quiet and one is not None and one.error >= _SLOPE_LIMIT]  # fmt: skip
    if noises and not quiet:
        findings.append(Finding(
            "sensor noise", f"{math.degrees(noise):.2f} deg at rest, {math.degrees(_NOISY):.2f} at most: gears, "
            "currents and lateness were not judged", "Commission with a quieter inclinometer, or let this one average "
            "longer.",
        ))  # fmt: skip
    if late > LATE:
        findings.append(Finding(
            "sensor late", f"{1e3 * late:.0f} ms later than expected", "Look at its filter, its rate and the line to "
            "it; a controller needs the delay that is proposed.",
        ))  # fmt: skip
    return Identified(tuple(findings), seen, scales, mounting, late, noise, quiet)


def seen_by(moves: Moves, file: DrivesFile, source: str) -> Expected | None:
    """Return the expected features from moves of correct drives, for `identify`; None if none pulled."""
    per_motor = []
    for moved in moves.motors:
        one, entry = features(moved), file.drives[moved.motor - 1]
        if one is not None:
            counts = abs(entry.scale.counts_per_radian)
            per_motor.append((one.gain * counts, one.force * counts * ampere(entry, file.profile), one.lag))
    if len(per_motor) < len(file.drives):
        return None
    gains, forces, lags = zip(*per_motor, strict=True)
    return Expected(gains, forces, float(np.median(lags)), source)


# -- scales -------------------------------------------------------------------------------------------------------


def _scales(
    seen: Sequence[Features | None],
    file: DrivesFile,
    expected: Expected | None,
    types: Mapping[int, float],
    order: Sequence[int],
    *,
    quiet: bool,
) -> tuple[Scale, ...]:
    """Return the scales of each motor: lines by the index, gear by the tilt, then the current's by the force."""
    rows = [(j, one, file.drives[j]) for j, one in enumerate(seen)
            if one is not None and one.gain > 0.0 < one.force and one.error < _SLOPE_LIMIT]  # fmt: skip
    scales = [Scale() for _ in seen]
    for j, one, entry in rows:
        lines = one.turn / entry.scale.counts_per_turn
        scales[j] = Scale(lines=lines if one.turn and abs(lines - 1.0) > _INDEX_TOLERANCE else 1.0)
    known = [(abs(entry.scale.counts_per_radian), ampere(entry, file.profile)) for _, _, entry in rows]
    gains = np.array([one.gain * counts for (_, one, _), (counts, _) in zip(rows, known, strict=True)])
    forces = np.array([one.force * counts * unit for (_, one, _), (counts, unit) in zip(rows, known, strict=True)])
    lines = np.array([scales[j].lines for j, _, _ in rows])
    if not rows or not quiet:
        return tuple(_by_type(scale, file, j, types.get(j)) for j, scale in enumerate(scales, start=1))
    # gain = expected / (lines gear), force = expected / (lines gear^2 peak)
    tendons = [order[j] for j, _, _ in rows]
    errors = np.array([math.hypot(_MOTOR, one.error / math.log(2.0)) for _, one, _ in rows])
    gears = factors(_logs(gains, expected and expected.gain, tendons) - np.log2(lines), errors)
    peaks = _logs(forces, expected and expected.force, tendons) - np.log2(lines) - 2.0 * np.log2(gears)
    # A current comes in whole units, of which there are few.
    coarse = np.array(
        [math.hypot(_MOTOR, _SLOPE_TOLERANCE / max(one.rise, _SLOPE_TOLERANCE) / math.log(2.0)) for _, one, _ in rows]
    )
    # What a ds402 drive tells is relative to its motor's rated current (6075h), which it knows itself.
    shown = np.ones(len(rows)) if file.profile == "ds402" else factors(peaks, coarse)
    for (j, _, _), gear, peak in zip(rows, gears, shown, strict=True):
        scales[j] = replace(scales[j], gear=float(gear), peak=float(peak))
    return tuple(_by_type(scale, file, j, types.get(j)) for j, scale in enumerate(scales, start=1))


def _by_type(scale: Scale, file: DrivesFile, motor: int, peak: float | None) -> Scale:
    """Return `scale` with the current's by the drive's type, where that is public."""
    return scale if peak is None else replace(scale, peak=peak / file.drives[motor - 1].scale.peak_current)


def _logs(values: Vector, expected: Sequence[float] | None, tendons: Sequence[int]) -> Vector:
    """Return by which power of two values are less than expected of their tendons, or than most of them."""
    wanted = np.median(values) if expected is None else np.array(expected)[tendons]
    return np.log2(wanted / values)


def factors(powers: Vector, errors: Vector | float = _MOTOR) -> Vector:
    """Return the factors of measured `powers` of two: whole powers, apart from a common factor and noise.

    The most probable ones: c is what all share (the neck is not quite the expected one), k the whole powers, and
    `sum((powers - c - k)^2 / errors^2) + (c / neck)^2`, and one for each mistake, is least. One mistake is a k that is
    not zero, or one that all motors share.
    """
    best = (math.inf, 0.0)
    for c in np.linspace(-0.5, 0.5, 101):
        k = np.round(powers - c)
        mistakes = min(np.count_nonzero(k), 1 + np.count_nonzero(k != k[0]))
        cost = float(np.sum(((powers - c - k) / errors) ** 2) + (c / _NECK) ** 2 + mistakes)
        best = min(best, (cost, float(c)))
    # Against most of them: one that is no power of two is not to shift what all share.
    left = powers - float(np.median(powers - np.round(powers - best[1])))
    whole = np.round(left)
    none = np.abs(left - whole) > np.maximum(_NO_POWER, 2.0 * np.asarray(errors))
    return 2.0 ** np.where(none, left, whole)


def _scale_findings(scales: Sequence[Scale], file: DrivesFile, seen: Sequence[Features | None]) -> list[Finding]:
    findings = []
    for j, (scale, entry) in enumerate(zip(scales, file.drives, strict=True), start=1):
        one = seen[j - 1]
        if scale.lines != 1.0 and one is not None:
            text = f"{one.turn} counts for a turn by the index, {entry.scale.counts_per_turn:g} by the drives file"
            findings.append(Finding("encoder lines", text, "Take the proposed `encoder_counts`.", (j,),
                                    factor=scale.lines))  # fmt: skip
        if scale.gear != 1.0:
            lines = one is not None and not one.turn
            text = f"{_times(scale.gear)} the {entry.scale.gear:.4g} of the drives file, by the tilt for a turn"
            instead = ("encoder lines: no index came, so that both look alike",) if lines else ()
            findings.append(Finding("gear", text, "Look at the motor's label; take the proposed `gear`.", (j,), instead,
                                    scale.gear))  # fmt: skip
        if scale.peak != 1.0:
            text = f"{_times(scale.peak)} the {entry.scale.peak_current:g} A of the drives file, from slack to taut"
            findings.append(Finding("current scale", text, "Look at the drive's label; take the proposed "
                                    "`peak_current_A`.", (j,), factor=scale.peak))  # fmt: skip
    return findings


def _times(factor: float) -> str:
    return {2.0: "twice", 0.5: "half", 4.0: "four times", 0.25: "a quarter of"}.get(factor, f"{factor:.2f} times")


# -- signs, tendons, sensor ----------------------------------------------------------------------------------------


def _signs(seen: Sequence[Features | None], file: DrivesFile) -> list[Finding]:
    found = []
    for j, (one, entry) in enumerate(zip(seen, file.drives, strict=True), start=1):
        if one is not None and (one.pull < 0) != entry.scale.reversed:
            way = "rise" if one.pull > 0 else "fall"
            found.append(Finding("reversed", f"it pulls while the counts {way}", "Take the proposed `reversed`.", (j,)))
    return found


def _still_motors(moves: Moves, count: int) -> list[Finding]:
    found = []
    for j in range(1, count + 1):
        moved = moves.of(j)
        if moved is None:
            why = moves.stopped or "it was left out"
            found.append(Finding("not moved", why, f"Look at the cause, then go on with --motor {j}.", (j,)))
        elif moved.outcome == HANGS:
            found.append(Finding("hangs", "no tendon got taut within the travel", "Tighten it by hand, or raise "
                                 "--travel; is the motor's coupling tight?", (j,)))  # fmt: skip
        elif moved.outcome != PULLED or features(moved) is None:
            found.append(Finding("no tilt", "its current rises as under tension, and the sensor sees nothing", "Is the "
                                 "sensor fixed to the neck, is the tendon caught?", (j,)))  # fmt: skip
    return found


def _mounting(seen: Sequence[Features | None], file: DrivesFile) -> tuple[Mounting | None, list[Finding]]:
    """Return the simplest mounting that explains the measured directions, and its findings."""
    weights = file.weights
    if not weights or not any(seen):
        return None, []
    tendons: Matrix = np.array(weights)
    nothing = np.full(len(weights), np.nan)
    found = explain(np.array([nothing if one is None else one.direction for one in seen]), tendons)
    best, outputs = found[0], file.moves.outputs.names
    if best.off > FITS:
        text = f"off by {math.degrees(best.off):.0f} deg whatever motors and axes are exchanged"
        return None, [Finding("directions", text, "Are the angles of the robot file those of the tendons?")]
    told = [_mounting_findings(one, outputs) for one in found]
    others = tuple(" and ".join(f"{one.name}: {one.text}" for one in other) for other in told[1:])
    return best, [replace(one, instead=others) for one in told[0]]


def _mounting_findings(mounting: Mounting, outputs: Sequence[str]) -> list[Finding]:
    found = []
    moved = [j for j, k in enumerate(mounting.order) if j != k]
    if moved:
        text = ", ".join(f"motor {j + 1} pulls tendon {mounting.order[j] + 1}" for j in moved)
        found.append(Finding("exchanged motors", text, "Take the proposed order of drives, or exchange the tendons.",
                             tuple(j + 1 for j in moved)))  # fmt: skip
    if any(number != k for k, (number, _) in enumerate(mounting.axes)):
        text = ", ".join(f"{outputs[k]} is {outputs[n]}" for k, (n, _) in enumerate(mounting.axes) if n != k)
        found.append(Finding("sensor axes", text, "Take the proposed `axes`, or turn the sensor."))
    turned = [outputs[k] for k, (_, sign) in enumerate(mounting.axes) if sign < 0.0]
    if turned:
        found.append(Finding("sensor sign", f"{', '.join(turned)} reversed", "Take the proposed `axes`, or turn the "
                             "sensor."))  # fmt: skip
    return found


def apply_findings(file: DrivesFile, found: Identified) -> DrivesFile:
    """Return the drives file with all that was found put right."""
    entries = []
    for entry, one, scale in zip(file.drives, found.motors, found.scales, strict=True):
        old = entry.scale
        made = replace(
            old, gear=old.gear * scale.gear, peak_current=old.peak_current * scale.peak,
            counts_per_turn=old.counts_per_turn if scale.lines == 1.0 or one is None else float(one.turn),
            reversed=old.reversed if one is None else one.pull < 0,
        )  # fmt: skip
        entries.append(replace(entry, scale=made))
    if found.mounting is None:
        return replace(file, drives=tuple(entries))
    order = found.mounting.order
    drives = tuple(entries[order.index(tendon)] for tendon in range(len(order)))
    outputs = file.moves.outputs.names
    before = axes_of(file.sensor_axes, outputs)
    axes: Axes = tuple((before[n][0], sign * before[n][1]) for n, sign in inverse(found.mounting.axes))
    return replace(file, drives=drives, sensor_axes=said_of(axes, outputs))
