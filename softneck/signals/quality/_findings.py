"""The quality report of a recording: findings on its channels and on its excitation."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, ReprMixin, one_blas_thread, require_positive, to_si
from softneck.robot import TIME_CONSTANT, Robot, Scaling

from ..recording._recording import Recording
from ._channel_faults import ChannelQuality, Segment, check_channel, count_rows
from ._drift import Drift, find_drifts
from ._excitation import BANDWIDTH, Spectrum, correlation, independent_motions, lightly_damped, spectrum
from ._followed import Mode

SEVERITIES = ("ok", "note", "warning")
# A loop must stop if the inclinometer is silent for longer (hardware facts), half a time constant of the neck; a model
# may lose as many rows.
_LONG_GAP, _MANY_MISSED = 0.1, 0.05
# Of the scaled co-contraction, -6 to 6: the effect of less is lost in noise.
_LEAST_COCONTRACTION = 0.5
# With fewer levels a step of the sensor is over 1 % of the motion.
_MIN_LEVELS = 100.0
# Correlation at which two motors share half and nine tenths of their variance.
_CORRELATED, _COLLINEAR = 0.7, 0.95
# An input without power beyond half the bandwidth does not excite the neck's pole at about 5 1/s. The power reaches
# the bandwidth up to one line of the spectrum, which is 0.15 of the neck's 4 rad/s wide.
_SLOW_SHARE, _REACHED_SHARE = 0.5, 0.95


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of the report.

    `severity`: ok, note (for information) or warning (fix it, or expect a worse model). `topic`: such as "dropouts" or
    "excitation". `advice`: what to do; may be empty. `time`: [s] of the first place in its run; None without a place.
    """

    severity: str
    topic: str
    channel: str
    message: str
    advice: str = ""
    time: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values."""
        values = asdict(self)
        return {**values, "time_s": values.pop("time")}

    def __str__(self) -> str:
        about = f"{self.channel}: " if self.channel else ""
        return f"{self.severity}: {about}{self.message}" + (f" {self.advice}" if self.advice else "")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Quality(ReprMixin):
    """The result of `assess_quality`; arrays in SI.

    Attributes:
        sample_time: [s].
        channels: name -> faults of that channel.
        spectrum: of the redefined inputs, or of the set-points of a robot without directions.
        directions: number of directions of the set-points, by `independent_motions`.
        correlation: (motors, motors) of the set-points.
        modes: output -> its lightly damped mode, if it has one that the motors excite.
        drifts: output -> its drift, if it has one.
    """

    robot: Robot
    rows: int
    sample_time: float
    channels: dict[str, ChannelQuality]
    spectrum: Spectrum
    directions: int
    correlation: Matrix
    modes: dict[str, Mode]
    drifts: dict[str, Drift]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return all findings, warnings first; a topic without a fault gives one "ok"."""
        found = [finding for channel in self.channels.values() for finding in _channel(channel, self)]
        found += [*_excitation(self), *_directions(self), *_ranges(self), *_correlation(self)]
        for name, mode in self.modes.items():
            said = f"is lightly damped: the motors make it {mode}."
            found.append(Finding("note", "damping", name, said, "Identify it with two poles or more."))
        for name, drift in self.drifts.items():
            change = _value(self.channels[name], drift.change)
            said = f"drifts by {change} in its longest run, {100.0 * drift.share:.0f} % of its other motion."
            advice = "No model over the motors follows that: find its cause, and record again."
            found.append(Finding("warning", "drift", name, said, advice))
        topics = {finding.topic for finding in found if finding.severity != "ok"}
        moved, bandwidth = ", ".join(self.spectrum.inputs), self.spectrum.bandwidth
        clean = _CLEAN | {"excitation": f"{moved} move up to the bandwidth of {bandwidth:.3g} rad/s."}
        found += [Finding("ok", topic, "", text) for topic, text in clean.items() if topic not in topics]
        return tuple(sorted(found, key=lambda finding: -SEVERITIES.index(finding.severity)))

    @property
    def severity(self) -> str:
        """Return the worst severity: ok, note or warning."""
        return max((finding.severity for finding in self.findings), key=SEVERITIES.index)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values of `softneck info --json` under `quality`."""
        found = self.findings
        return {
            "severity": self.severity,
            "findings": [finding.as_dict() for finding in found],
            "channels": {name: channel.as_dict() for name, channel in self.channels.items()},
            "bandwidth_rad_s": self.spectrum.bandwidth,
            "excitation": self.spectrum.as_dict(),
            "directions": self.directions,
            "correlation": {"channels": self.robot.set_points, "matrix": self.correlation},
            "modes": {
                name: {"frequency_rad_s": mode.frequency, "damping": mode.damping} for name, mode in self.modes.items()
            },
            "drifts": {
                name: {"change": self.channels[name].in_file_unit(drift.change), "share": drift.share}
                for name, drift in self.drifts.items()
            },
        }

    def lines(self) -> tuple[str, ...]:
        """Return the report as lines: the numbers, then the findings."""
        return (*self.numbers(), "", *(str(finding) for finding in self.findings))

    def text(self) -> str:
        """Return the report as text."""
        return "\n".join(self.lines())

    def numbers(self) -> list[str]:
        """Return a line for each input, then noise, correlation and steps."""
        spectrum, unit = self.spectrum, self.robot.outputs.display_unit
        lines = []
        of_input = self.robot.motors.unit
        ranges = (spectrum.ranges / to_si(of_input)[0]).tolist()
        for i, (name, (low, high)) in enumerate(zip(spectrum.inputs, ranges, strict=True)):
            power = f"{_percent(spectrum.below_bandwidth[i])} of its power below {spectrum.bandwidth:.3g} rad/s, "
            power += f"real power up to {spectrum.highest[i]:.3g} rad/s, "
            judged = "" if np.isnan(spectrum.bandwidth) else power
            crest = _number(spectrum.crest[i])
            lines.append(f"{name}: {low:+.3g} to {high:+.3g} {of_input}, {judged}crest factor {crest}")
        measured = [self.channels[name] for name in self.robot.outputs.names]
        noise = ", ".join(f"{channel.name} {channel.in_file_unit(channel.noise):.3g} {unit}" for channel in measured)
        lines.append(f"noise (standard deviation): {noise}")
        if pairs := _pairs(self):
            names = [name.removeprefix("motor_") for name in self.robot.motors.names]
            which = ", ".join(f"{names[i]}-{names[j]}" for i, j in pairs)
            lines.append(f"correlation of motors {which}: {', '.join(_number(self.correlation[p]) for p in pairs)}")
        steps = [
            f"{channel.name} {channel.in_file_unit(channel.quantum):.3g}"
            for channel in self.channels.values()
            if channel.quantum is not None
        ]
        if steps:
            lines.append(f"steps between levels: {', '.join(steps)} (units of the file)")
        return lines


@one_blas_thread
def assess_quality(recording: Recording, *, bandwidth: float | None = None) -> Quality:
    """Assess a recording's channels and the excitation by its inputs; no check crosses the border of two runs.

    Args:
        bandwidth: of the outputs [rad/s]; None derives it from the robot's time constant (neck: 4, section 3.1).
            Without either the spectrum is not judged.

    Raises:
        SettingsError: the bandwidth is not positive.
    """
    if bandwidth is None:
        bandwidth = BANDWIDTH * TIME_CONSTANT / (recording.robot.time_constant_s or np.nan)
    else:
        require_positive("bandwidth", bandwidth, "rad/s")
    return Quality(
        robot=recording.robot,
        rows=len(recording),
        sample_time=recording.sample_time,
        channels={name: check_channel(recording, name) for name in recording.channels},
        spectrum=spectrum(recording, bandwidth),
        directions=independent_motions(recording),
        correlation=correlation(recording),
        modes=lightly_damped(recording),
        drifts=find_drifts(recording),
    )


_CLEAN = {
    "dropouts": "no sample is missing.",
    "frozen": "no channel is constant while its input moves.",
    "clipping": "no channel has flat tops.",
    "outliers": "no spikes in outputs and motor positions.",
    "drift": "no output drifts on its own.",
    "quantisation": "every channel has more than 100 levels in its range.",
    "directions": "the motors move in as many directions as there are.",
    "correlation": "the motors move independently enough.",
}


# Fault of a channel -> topic, message and advice.
_FAULTS = {
    "frozen": (
        "frozen",
        "repeats one value for 20 samples or more while its input moves, {places}; longest {longest:.2f} s.",
        "Check the sensor and its line, and leave those rows empty.",
    ),
    "clipped": (
        "clipping",
        "has flat tops at the edge of its range, {places}.",
        "Widen the sensor's range or move less; leave those rows empty.",
    ),
    "outliers": (
        "outliers",
        "has spikes of one or two samples, {places}.",
        "Leave those samples empty; a single spike widens the bounds of set membership.",
    ),
}


def _channel(channel: ChannelQuality, quality: Quality) -> Iterator[Finding]:
    outputs = quality.robot.outputs.names
    if channel.missed_rows == channel.rows:
        advice = "Remove it from the file, or log it."
        severity = "warning" if channel.name in outputs else "note"
        yield Finding(severity, "dropouts", channel.name, "has no sample at all.", advice)
        return
    if channel.missed:
        yield _dropouts(channel, quality)
    if channel.lowest == channel.highest and channel.name in (*quality.robot.set_points, *outputs):
        message = f"never leaves {_value(channel, channel.lowest)}."
        advice = "Move it: no model can be identified from a constant."
        yield Finding("warning", "excitation", channel.name, message, advice)
    for fault, (topic, message, advice) in _FAULTS.items():
        if found := getattr(channel, fault):
            longest = max(segment.rows for segment in found) * quality.sample_time
            message = message.format(places=_places(found), longest=longest)
            yield Finding("warning", topic, channel.name, message, advice, found[0].time)
    if channel.wraps:
        message = f"jumps by a full turn at {channel.wraps} row(s)."
        advice = "Unwrap it: softneck import LOG --guess does so."
        yield Finding("warning", "outliers", channel.name, message, advice)
    yield from _resolution(channel, outputs)


def _dropouts(channel: ChannelQuality, quality: Quality) -> Finding:
    gap = _LONG_GAP * BANDWIDTH / quality.spectrum.bandwidth  # scaled by the robot's time constant
    longest = max(channel.missed, key=lambda segment: segment.rows)
    share, seconds = channel.missed_rows / channel.rows, longest.rows * quality.sample_time
    message = (
        f"misses {channel.missed_rows} of {channel.rows} samples ({100 * share:.2g} %) in {len(channel.missed)} "
        f"gap(s); the longest is {seconds:.2f} s at t = {longest.time:.2f} s."
    )
    if share > _MANY_MISSED or seconds > gap:
        stop = "" if np.isnan(gap) else f"; beyond {gap:.2g} s a control loop would have stopped"
        advice = f"Identification leaves these rows out{stop}: check the line."
        return Finding("warning", "dropouts", channel.name, message, advice, longest.time)
    return Finding("note", "dropouts", channel.name, message, "Identification leaves these rows out.", longest.time)


def _resolution(channel: ChannelQuality, outputs: tuple[str, ...]) -> Iterator[Finding]:
    if channel.levels is not None and channel.levels < _MIN_LEVELS and channel.quantum is not None:
        message = f"has steps of {_value(channel, channel.quantum)}, only {channel.levels:.0f} in its whole range."
        advice = "Log more digits, or use a finer sensor."
        yield Finding("warning" if channel.name in outputs else "note", "quantisation", channel.name, message, advice)
    if channel.name in outputs and channel.repeats > 0.3:
        message = f"repeats its last value in {100 * channel.repeats:.0f} % of the samples."
        advice = "Its sensor is slower than the log: log at the sensor's rate."
        yield Finding("note", "quantisation", channel.name, message, advice)


def _excitation(quality: Quality) -> Iterator[Finding]:
    common = quality.robot.cocontraction_name
    least = _LEAST_COCONTRACTION * Scaling.of(quality.robot).motor_unit
    if np.isnan(quality.spectrum.bandwidth):
        message = "the bandwidth of the outputs is unknown: the spectrum is not judged."
        yield Finding("note", "excitation", "", message)
    for i in () if np.isnan(quality.spectrum.bandwidth) else range(len(quality.spectrum.inputs)):
        if quality.spectrum.inputs[i] != common:
            yield from _power(quality.spectrum, i)
    if common in quality.spectrum.inputs and not np.ptp(quality.spectrum.ranges[-1]) > least:
        message = "hardly changes (co-contraction, the mean of the motors): its effect cannot be identified."
        advice = "Play `mixed`, which has co-contraction moves, if stiffness matters."
        yield Finding("note", "co-contraction", common, message, advice)


def _power(spectrum: Spectrum, i: int) -> Iterator[Finding]:
    name, limit = spectrum.inputs[i], spectrum.bandwidth
    highest, share = spectrum.highest[i], spectrum.below_bandwidth[i]
    if highest < _REACHED_SHARE * limit:
        message = f"moves with real power up to {highest:.2g} rad/s only; the robot's bandwidth is "
        advice = "Add a faster signal (multisine, aprbs, mixed): a model is a guess beyond."
        severity = "warning" if highest < _SLOW_SHARE * limit else "note"
        yield Finding(severity, "excitation", name, f"{message}{limit:.3g} rad/s.", advice)
    elif share < 0.5:
        above = f"{100 * (1 - share):.0f} % of its power above {limit:.3g} rad/s"
        advice = "Move more slowly, or remove the chatter of the loop that made it."
        yield Finding("note", "excitation", name, f"has {above}, where the robot hardly moves.", advice)


def _directions(quality: Quality) -> Iterator[Finding]:
    motors = len(quality.robot.set_points)
    if 0 < quality.directions < motors:
        message = f"the motors move along {quality.directions} direction(s) only, of {motors}."
        advice = "This is enough for a linear model in the redefined inputs; other models need independent motors."
        yield Finding("note", "directions", "", message, advice)


def _ranges(quality: Quality) -> Iterator[Finding]:
    """Yield the share of its range that each motor visited."""
    motors = quality.robot.motors
    if motors.setpoint_min is None or motors.setpoint_max is None:
        return
    channels = [quality.channels[name] for name in quality.robot.set_points]
    ends = zip(channels, motors.setpoint_min, motors.setpoint_max, strict=True)
    shares = [f"{100 * c.in_file_unit(c.highest - c.lowest) / (high - low):.0f} % by {c.name}" for c, low, high in ends]
    message = f"visited of each motor's range: {', '.join(shares)}."
    yield Finding("ok", "region", "", message, "Models are extrapolating outside.")


def _pairs(quality: Quality) -> list[tuple[int, int]]:
    return list(itertools.combinations(range(len(quality.correlation)), 2))


def _correlation(quality: Quality) -> Iterator[Finding]:
    for i, j in _pairs(quality):
        r = quality.correlation[i, j]
        if abs(r) > _CORRELATED:
            names = [quality.robot.motors.names[k].removeprefix("motor_") for k in (i, j)]
            message = f"motors {names[0]} and {names[1]} move together (correlation {r:.2f})."
            advice = "Their effects cannot be separated well; move them independently."
            yield Finding("warning" if abs(r) > _COLLINEAR else "note", "correlation", "", message, advice)


def _places(segments: tuple[Segment, ...]) -> str:
    times = ", ".join(f"{segment.time:.2f}" for segment in segments[:3])
    more = ", ..." if len(segments) > 3 else ""
    return f"{len(segments)} time(s), {count_rows(segments)} row(s), at t = {times}{more} s"


def _value(channel: ChannelQuality, value: float) -> str:
    return f"{channel.in_file_unit(value):.3g} {channel.unit}"


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"
