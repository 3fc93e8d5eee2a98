"""A small neck whose truth is known, and where things lie: what the tests build their recordings from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import Matrix, Vector
from softneck.identification import Model
from softneck.identification.uncertainty._guarded import Base, Guarded
from softneck.runtime import Block
from softneck.signals import SET_POINTS, Recording, signal
from softneck.signals.recording._channels import MOTOR_POSITIONS

ROOT = Path(__file__).parents[1]
LAYOUTS = ROOT / "examples" / "layouts"
TS = 0.02


def slow_but(values: Iterable[Any], short: Iterable[Any], nightly: Iterable[Any] = ()) -> list[Any]:
    """Return `values` as parameters of a test.

    `make test` runs `short`, `make slow` the others, but for those of `nightly`, for which CI has no time.
    """
    values, short, nightly = list(values), set(short), set(nightly)
    assert short | nightly <= set(values), (short | nightly) - set(values)
    marks = {value: (pytest.mark.slow, *([pytest.mark.nightly] if value in nightly else [])) for value in values}
    return [value if value in short else pytest.param(value, marks=marks[value]) for value in values]


def with_starts(block: Block, **starts: float) -> Block:
    """Return the same block with other start values of its parameters."""
    ports = tuple(replace(port, start=starts.pop(port.name, port.start)) for port in block.parameters)
    assert not starts
    return replace(block, parameters=ports)


@dataclass(frozen=True, slots=True)
class Truth:
    """`y(k+1) = pole y(k) + gain u(k-delay)` per axis, and `m(k+1) = a m(k) + (1-a) s(k+1-d)` per motor."""

    pole: tuple[float, float] = (0.88, 0.92)
    gain: tuple[float, float] = (0.011, 0.008)
    delay: tuple[int, int] = (3, 4)
    drive_pole: tuple[float, float, float] = (0.5, 0.6, 0.7)
    drive_delay: tuple[int, int, int] = (1, 2, 3)


TRUTH = Truth()


def first_order(u: Vector, pole: float, gain: float, delay: int) -> Vector:
    """The plain loop of `Truth` from rest, y(0) = 0, with u = u(0) before the record."""
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = pole * y[k] + gain * u[max(k - delay, 0)]
    return y


def drive_positions(set_points: Matrix, truth: Truth = TRUTH) -> Matrix:
    """The plain loop of the drives, at rest at their first set-point."""
    m = np.empty_like(set_points)
    m[0] = set_points[0]
    for j in range(3):
        a, d = truth.drive_pole[j], truth.drive_delay[j]
        for k in range(len(m) - 1):
            held = set_points[k + 1 - d, j] if k + 1 - d >= 0 else m[0, j]
            m[k + 1, j] = a * m[k, j] + (1 - a) * held
    return m


def recording_from(
    set_points: Matrix, *, truth: Truth = TRUTH, noise: float = 0.0, seed: int = 0, positions: bool = False
) -> Recording:
    """A recording of the synthetic neck; theta_i and phi_i are written out here, not taken from the code."""
    P1, P2, P3 = set_points.T
    inputs = (P1 - 0.5 * (P2 + P3), np.sqrt(0.75) * (P2 - P3))
    rng = np.random.default_rng(seed)
    y = np.column_stack([first_order(inputs[i], truth.pole[i], truth.gain[i], truth.delay[i]) for i in range(2)])
    y += noise * rng.standard_normal(y.shape)
    channels = dict(zip(SET_POINTS, set_points.T, strict=True))
    channels |= {"pitch": y[:, 0], "roll": y[:, 1]}
    if positions:
        channels |= dict(zip(MOTOR_POSITIONS, drive_positions(set_points, truth).T, strict=True))
    return Recording(np.arange(len(y)) * TS, TS, channels)


def neck_recording(
    rows: int = 2400, *, seed: int = 1, noise: float = 5e-4, positions: bool = True, truth: Truth = TRUTH
) -> Recording:
    """The synthetic neck under an amplitude-modulated PRBS that starts at rest."""
    set_points = signal("aprbs", duration=rows * TS, seed=seed).set_points.copy()
    set_points[:10] = 0.0
    return recording_from(set_points, truth=truth, noise=noise, seed=seed, positions=positions)


def short_neck() -> Recording:
    """The 500 rows on which the shared small models are trained."""
    return neck_recording(500, seed=3, noise=1e-3)


def guarded_of(members: list[Model], recording: Recording) -> Model:
    """A model that holds `members`, the first of them its base too."""
    outputs = len(recording.robot.outputs.names)
    base = Base(members[0], np.full(outputs, 0.01), np.full(outputs, 90.0))
    return Guarded(of="play").around(base, members, recording)


def with_time(recording: Recording, time: Vector, run: np.ndarray | None = None) -> Recording:
    """The same samples at other times."""
    return Recording(time, recording.sample_time, recording.channels, recording.run if run is None else run)


def csv_lines(recording: Recording, rows: int = 150) -> list[str]:
    """The lines of the CSV form, written by hand: a header and the rows without motor positions."""
    lines = ["time [s],motor_setpoint_1 [rad],motor_setpoint_2 [rad],motor_setpoint_3 [rad],pitch [deg],roll [deg]"]
    angles = np.degrees(recording.outputs)
    for k in range(rows):
        cells = (recording.time[k], *recording.set_points[k], *angles[k])
        lines.append(",".join(repr(float(cell)) for cell in cells))
    return lines


def changed(lines: list[str], row: int, column: int, text: str) -> list[str]:
    """The lines with one cell replaced; row 0 is the first after the header, -1 the header itself."""
    cells = lines[row + 1].split(",")
    cells[column] = text
    return [*lines[: row + 1], ",".join(cells), *lines[row + 2 :]]
