"""Numbers of a recording's quality in the user's words: what is wrong, how much it matters and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix

from ..recording._channels import MOTORS, OUTPUTS, SET_POINTS, file_unit
from ._channel_faults import ChannelQuality, Stretch, count_rows
from ._excitation import BANDWIDTH, INPUTS, Conditioning, Repeat, Spectrum
from ._region import Region

SEVERITIES = ("ok", "note", "warning")
# A loop must stop when the inclinometer is silent for longer (hardware facts); a model may lose as many rows.
_LONG_GAP, _MANY_MISSED = 0.1, 0.05
# Below so many levels in the range a step of the sensor is over 1 % of the motion.
_COARSE = 100.0
# Pair correlation: two motors share half and nine tenths of their variance.
_RELATED, _ALIKE = 0.7, 0.95
# Eq. 22 gives 450, closed-loop steps 10,000; from a million on, what tells two columns apart is below any encoder.
_ILL, _SINGULAR = 1e3, 1e6
# A theta_i or phi_i without power beyond half the bandwidth says nothing of the neck's pole at about 5 1/s.
_SLOW = 0.5 * BANDWIDTH


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that the report says.

    Attributes:
        severity: ok, note (know it) or warning (mend it, or expect a worse model).
        topic: such as "dropouts" or "excitation".
        channel: that it is about, or empty.
        message: one sentence.
        advice: what to do; empty where nothing.
        time: [s] in its run where it is first seen; None where it has no place.
    """

    severity: str
    topic: str
    channel: str
    message: str
    advice: str = ""
    time: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds."""
        return {
            "severity": self.severity,
            "topic": self.topic,
            "channel": self.channel,
            "message": self.message,
            "advice": self.advice,
            "time_s": self.time,
        }

    def __str__(self) -> str:
        about = f"{self.channel}: " if self.channel else ""
        return f"{self.severity}: {about}{self.message}" + (f" {self.advice}" if self.advice else "")


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """What `assess_quality` found; arrays in SI.

    Attributes:
        rows: of the recording.
        sample_time: [s].
        channels: name -> faults of that channel.
        spectrum: of theta_i, phi_i, delta_i.
        conditioning: pitch, roll -> condition of Eq. 21's regressor.
        region: of (theta_i, phi_i, delta_i) that was visited.
        correlation: (3, 3) between the motors' set-points.
        repeats: pairs of runs with the same set-points.
    """

    rows: int
    sample_time: float
    channels: dict[str, ChannelQuality]
    spectrum: Spectrum
    conditioning: dict[str, Conditioning]
    region: Region
    correlation: Matrix
    repeats: tuple[Repeat, ...]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what there is to say, warnings first."""
        return findings(self)

    @property
    def severity(self) -> str:
        """Return the worst severity: ok, note or warning."""
        return max((finding.severity for finding in self.findings), key=SEVERITIES.index)

    def as_dict(self) -> dict[str, Any]:
        """Return what `softneck info --json` holds under `quality`."""
        said = self.findings
        return {
            "severity": self.severity,
            "findings": [finding.as_dict() for finding in said],
            "channels": {name: channel.as_dict() for name, channel in self.channels.items()},
            "bandwidth_rad_s": BANDWIDTH,
            "excitation": self.spectrum.as_dict(),
            "condition": {axis: condition.as_dict() for axis, condition in self.conditioning.items()},
            "region": self.region.as_dict(),
            "correlation": {"channels": SET_POINTS, "matrix": self.correlation},
            "repeats": [repeat.as_dict() for repeat in self.repeats],
        }

    def lines(self) -> tuple[str, ...]:
        """Return the report as lines: the numbers, then one line for each finding."""
        return (*self._numbers(), "", *(str(finding) for finding in self.findings))

    def text(self) -> str:
        """Return the report as text."""
        return "\n".join(self.lines())

    def _numbers(self) -> list[str]:
        low, high = self.region.ranges.T
        lines = [
            f"{name}: {low[i]:+.2f} to {high[i]:+.2f} rad, {_percent(self.spectrum.below_bandwidth[i])} of its power "
            f"below {BANDWIDTH:g} rad/s, real power up to {self.spectrum.highest[i]:.1f} rad/s, "
            f"crest factor {_number(self.spectrum.crest[i])}"
            for i, name in enumerate(INPUTS)
        ]
        noise = ", ".join(f"{axis} {np.degrees(self.channels[axis].noise):.3f} deg" for axis in OUTPUTS)
        condition = ", ".join(f"{axis} {c.number:.3g}" for axis, c in self.conditioning.items())
        r = self.correlation
        lines.append(f"noise (standard deviation): {noise}")
        lines.append(f"condition of Eq. 21's regressor, columns at unit variance: {condition}")
        lines.append(f"correlation of motors 1-2, 1-3, 2-3: {_number(r[0, 1])}, {_number(r[0, 2])}, {_number(r[1, 2])}")
        steps = [
            f"{channel.name} {channel.shown(channel.quantum):.3g}"
            for channel in self.channels.values()
            if channel.quantum is not None
        ]
        if steps:
            lines.append(f"steps between levels: {', '.join(steps)} (units of the file)")
        return lines


def findings(quality: Quality) -> tuple[Finding, ...]:
    """Return all that there is to say, warnings first; a topic without fault says "ok" once."""
    said = [finding for channel in quality.channels.values() for finding in _channel(channel, quality.sample_time)]
    said += [*_excitation(quality), *_conditioning(quality), *_region(quality), *_correlation(quality)]
    said += _repeats(quality)
    topics = {finding.topic for finding in said if finding.severity != "ok"}
    said += [Finding("ok", topic, "", text) for topic, text in _CLEAN.items() if topic not in topics]
    return tuple(sorted(said, key=lambda finding: -SEVERITIES.index(finding.severity)))


_CLEAN = {
    "dropouts": "no sample is missing.",
    "frozen": "no channel stands still while its input moves.",
    "clipping": "no channel has flat tops.",
    "outliers": "no spikes in angles and motor positions.",
    "quantisation": "every channel has more than 100 levels in its range.",
    "excitation": f"pitch and roll are excited up to the bandwidth of {BANDWIDTH:g} rad/s.",
    "regressors": "the columns of Eq. 21's regressor can be told apart.",
    "correlation": "the motors move independently enough.",
}


def _channel(channel: ChannelQuality, sample_time: float) -> Iterator[Finding]:
    if channel.missed_rows == channel.rows:
        advice = "Take it out of the file, or log it."
        severity = "warning" if channel.name in OUTPUTS else "note"
        yield Finding(severity, "dropouts", channel.name, "has no sample at all.", advice)
        return
    if channel.missed:
        yield _dropouts(channel, sample_time)
    if channel.lowest == channel.highest and channel.name in (*SET_POINTS, *OUTPUTS):
        message = f"never leaves {_value(channel, channel.lowest)}."
        advice = "Move it: nothing about it can be identified."
        yield Finding("warning", "excitation", channel.name, message, advice)
    if channel.frozen:
        message = (
            f"repeats one value for 20 samples or more while its input moves, {_places(channel.frozen)}; "
            f"longest {max(s.rows for s in channel.frozen) * sample_time:.2f} s."
        )
        advice = "Check the sensor and its line, and leave those rows empty."
        yield Finding("warning", "frozen", channel.name, message, advice, channel.frozen[0].time)
    if channel.clipped:
        yield _clipping(channel)
    if channel.outliers:
        message = f"has spikes of one or two samples, {_places(channel.outliers)}."
        advice = "Leave those samples empty; set membership in particular bends its bounds to them."
        yield Finding("warning", "outliers", channel.name, message, advice, channel.outliers[0].time)
    yield from _resolution(channel)


def _dropouts(channel: ChannelQuality, sample_time: float) -> Finding:
    longest = max(channel.missed, key=lambda stretch: stretch.rows)
    share, seconds = channel.missed_rows / channel.rows, longest.rows * sample_time
    message = (
        f"misses {channel.missed_rows} of {channel.rows} samples ({100 * share:.2g} %) in {len(channel.missed)} "
        f"stretch(es); the longest is {seconds:.2f} s at t = {longest.time:.2f} s."
    )
    if share > _MANY_MISSED or seconds > _LONG_GAP:
        advice = "Identification leaves these rows out; beyond 0.1 s a control loop would have stopped: check the line."
        return Finding("warning", "dropouts", channel.name, message, advice, longest.time)
    return Finding("note", "dropouts", channel.name, message, "Identification leaves these rows out.", longest.time)


def _clipping(channel: ChannelQuality) -> Finding:
    rows, time = count_rows(channel.clipped), channel.clipped[0].time
    if channel.command:
        message = f"rests at its own extreme again and again ({100 * rows / channel.rows:.2g} % of the rows)."
        return Finding("note", "clipping", channel.name, message, "Check whether a limit cut it off.", time)
    message = f"has flat tops at the edge of its range, {_places(channel.clipped)}."
    advice = "Widen the sensor's range or move less; leave those rows empty."
    return Finding("warning", "clipping", channel.name, message, advice, time)


def _resolution(channel: ChannelQuality) -> Iterator[Finding]:
    if channel.levels is not None and channel.levels < _COARSE and channel.quantum is not None:
        message = f"has steps of {_value(channel, channel.quantum)}, only {channel.levels:.0f} in its whole range."
        advice = "Log more digits, or use a finer sensor."
        yield Finding("warning" if channel.name in OUTPUTS else "note", "quantisation", channel.name, message, advice)
    if channel.name in OUTPUTS and channel.repeats > 0.3:
        message = f"repeats its last value in {100 * channel.repeats:.0f} % of the samples."
        advice = "Its sensor is slower than the log: log at the sensor's rate."
        yield Finding("note", "quantisation", channel.name, message, advice)


def _excitation(quality: Quality) -> Iterator[Finding]:
    spectrum = quality.spectrum
    for i, axis in enumerate(OUTPUTS):
        highest, share = spectrum.highest[i], spectrum.below_bandwidth[i]
        if highest < BANDWIDTH - 0.2:  # a line of the spectrum is 0.15 rad/s wide
            message = (
                f"moves {axis} with real power up to {highest:.1f} rad/s only; the neck's bandwidth is "
                f"{BANDWIDTH:g} rad/s."
            )
            advice = "Add a faster signal (multisine, aprbs, mixed): a model is guesswork beyond."
            yield Finding("warning" if highest < _SLOW else "note", "excitation", INPUTS[i], message, advice)
        elif share < 0.5:
            message = (
                f"has {100 * (1 - share):.0f} % of its power above {BANDWIDTH:g} rad/s, where the neck hardly moves."
            )
            advice = "Move more slowly, or take the chatter out of the loop that made it."
            yield Finding("note", "excitation", INPUTS[i], message, advice)
    low, high = quality.region.ranges[2]
    if not high - low > 0.5:
        message = "hardly changes (co-contraction, the mean of the motors): its effect cannot be identified."
        advice = "Play `mixed`, which has co-contraction moves, if stiffness matters."
        yield Finding("note", "co-contraction", "delta_i", message, advice)


def _conditioning(quality: Quality) -> Iterator[Finding]:
    worst = max(quality.conditioning.values(), key=lambda condition: condition.number)
    if worst.rows < len(worst.columns):
        yield Finding("warning", "regressors", "", "too few rows for a regressor of Eq. 21.", "Record longer.")
    elif worst.number > _ILL:
        size = f"{worst.number:.2g}" if np.isfinite(worst.number) else "infinite (columns depend on each other)"
        message = (
            f"the condition of Eq. 21's regressor is {size}; least told apart: {', '.join(worst.weakest) or 'all'}."
        )
        advice = "A linear model in theta_i and phi_i needs no more; others want motors that move independently."
        yield Finding("warning" if worst.number > _SINGULAR else "note", "regressors", "", message, advice)


def _region(quality: Quality) -> Iterator[Finding]:
    region = quality.region
    message = (
        f"visited {100 * region.tilt_coverage:.0f} % of the theta_i, phi_i and {100 * region.delta_coverage:.0f} % of "
        f"the delta_i that motors of +-{region.limit:g} rad reach."
    )
    yield Finding("ok", "region", "", message, "Models know nothing outside.")
    if region.never:
        message = f"never visited: {', '.join(region.never)}."
        advice = "The paper's models failed there (section 7.4.2); add `mixed` or `steps` if your use needs them."
        yield Finding("note", "region", "", message, advice)


def _correlation(quality: Quality) -> Iterator[Finding]:
    for i, j in ((0, 1), (0, 2), (1, 2)):
        r = quality.correlation[i, j]
        if abs(r) > _RELATED:
            message = f"motors {MOTORS[i]} and {MOTORS[j]} move together (correlation {r:.2f})."
            advice = "Their effects cannot be told apart well; move them independently."
            yield Finding("warning" if abs(r) > _ALIKE else "note", "correlation", "", message, advice)


def _repeats(quality: Quality) -> Iterator[Finding]:
    if quality.repeats:
        pitch, roll = np.degrees(np.nanmean([repeat.rms for repeat in quality.repeats], axis=0))
        message = (
            f"{len(quality.repeats)} pair(s) of runs have the same set-points and differ by {pitch:.2f} deg in pitch "
            f"and {roll:.2f} deg in roll (rms / sqrt 2)."
        )
        yield Finding("ok", "repeats", "", message, "No model can predict better than that.")


def _places(stretches: tuple[Stretch, ...]) -> str:
    times = ", ".join(f"{stretch.time:.2f}" for stretch in stretches[:3])
    more = ", ..." if len(stretches) > 3 else ""
    return f"{len(stretches)} time(s), {count_rows(stretches)} row(s), at t = {times}{more} s"


def _value(channel: ChannelQuality, value: float) -> str:
    return f"{channel.shown(value):.3g} {file_unit(channel.name)}"


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"
