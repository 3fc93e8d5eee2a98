"""What a robot's file does not say of its sensor and the recordings tell: proposed, and marked as not sure."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path

import tomli_w

from softneck.core import atomic_write, to_si
from softneck.core._budget import settings_text
from softneck.robot import Robot
from softneck.signals.recording._recording import Recording

from ..shared._console import note

# Of a channel without noise, in parts of its range: a sensor of 1,000 levels.
_QUIET = 1e-3


def propose_sensor(file: Path, recordings: Sequence[Recording]) -> list[str]:
    """Add to a robot's file what its table [sensor] lacks, and return the keys; nothing where it says all."""
    robot, table = Robot.read(file), tomllib.loads(settings_text(file))
    told = robot.as_dict().get("sensor", {})
    found = {
        "noise_std": (_noise(robot, recordings), 80, "white noise of the recordings, by their fourth differences"),
        "delay_s": (0.0, 50, "the recordings tell only the sum with the plant's dead time, which takes all of it"),
        "rate_hz": (_digits(1.0 / recordings[0].sample_time), 80, "one measurement a sample of the recordings"),
    }
    proposed = {key: entry for key, entry in found.items() if key not in told}
    if not proposed:
        return []
    lines = [f"# NOT SURE ({sure} %): {why}\n{key} = {value}\n" for key, (value, sure, why) in proposed.items()]
    text = file.read_text(encoding="utf-8")
    if "sensor" in table and "\n[sensor]" in f"\n{text}":
        head, mark, rest = f"\n{text}".partition("\n[sensor]")
        first, end, after = rest.partition("\n")
        text = f"{head}{mark}{first}{end}{''.join(lines)}{after}".lstrip("\n")
    else:
        text = f"{text.rstrip()}\n\n[sensor]\n{''.join(lines)}"
    try:
        tomllib.loads(text)
    except ValueError:  # [sensor] stood in another form, such as `sensor.delay_s = 0.1`
        sensor = table.get("sensor", {}) | {key: value for key, (value, *_) in proposed.items()}
        text = tomli_w.dumps(table | {"sensor": sensor})
    with atomic_write(file, force=True) as temporary:
        temporary.write_text(text, encoding="utf-8")
    said = ", ".join(f"{key} = {value:g}" for key, (value, *_) in proposed.items())
    note(f"not sure: {file} does not tell the sensor, so {said} is taken from the recordings; correct it there")
    return list(proposed)


def _noise(robot: Robot, recordings: Sequence[Recording]) -> float:
    """Return the largest noise of an output, in the unit of the robot's outputs."""
    from softneck.signals.quality._channel_faults import check_channel

    levels = []
    for recording in recordings:
        for name in robot.outputs.names:
            channel = check_channel(recording, name)
            # A coarse sensor is as uncertain as its steps are wide, a clean one at least as a tenth of a percent.
            steps = (channel.quantum or 0.0) / math.sqrt(12.0)
            noise = 0.0 if math.isnan(channel.noise) else channel.noise
            levels.append(max(noise, steps) or _QUIET * (channel.highest - channel.lowest))
    return _digits(max(levels) / to_si(robot.outputs.unit)[0])


def _digits(value: float) -> float:
    return float(f"{value:.3g}")
