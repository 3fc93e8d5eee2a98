"""An FMU driven by recorded signals, sample by sample: what its plots and its equality checks need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording

from ._fmu_part import FmuPart, check_outputs

_SAME_SAMPLE_TIME = 1e-6


def drive_fmu(
    path: str | Path,
    inputs: Mapping[str, Vector],
    *,
    parameters: Mapping[str, float] | None = None,
    outputs: tuple[str, ...] | None = None,
    start_time: float = 0.0,
    report: Callable[[float], None] | None = None,
) -> Matrix:
    """Step an FMU through rows of inputs and return its outputs (rows, n_out); row k is at t_k.

    A plant's row 0 holds its outputs at the start, and row k those that the inputs up to row k - 1 caused.
    The rows of an observer or controller hold what it returns at once for the inputs of that row.

    Args:
        path: the FMU.
        inputs: input name -> (rows,); an input that is not here keeps its start value.
        parameters: values by name.
        outputs: names of those to return; all, in the FMU's order, if not given.
        start_time: [s].
        report: called now and then with the done fraction.

    Raises:
        DataError: inputs of different lengths or unknown names.
        FmuError: the FMU refused; the line says why.
    """
    part = FmuPart(path)
    rows = _rows(part, inputs)
    chosen = check_outputs(part, outputs) if outputs is not None else list(range(len(part.outputs)))
    stride = max(1, len(rows) // 100)
    table = np.empty((len(rows), len(part.outputs)))
    plant = part.role == "plant"
    with part:
        now = part.start(start_time, parameters or {})
        for k, row in enumerate(rows):
            after = part.advance(start_time + k * part.sample_time, row) if k + 1 < len(rows) or not plant else now
            table[k] = now if plant else after
            now = after
            if report is not None and (k + 1) % stride == 0:
                report((k + 1) / len(rows))
    return table[:, chosen]


def simulate_fmu_free_run(
    path: str | Path,
    recording: Recording,
    *,
    parameters: Mapping[str, float] | None = None,
    outputs: tuple[str, ...] | None = None,
    report: Callable[[float], None] | None = None,
) -> Matrix:
    """Return the outputs (time, n_out) of a plant FMU run free from a recording's set-points.

    Row k is at the recording's row k; each of its runs starts anew.

    Args:
        path: the FMU.
        recording: whose set-points drive it.
        parameters: values by name, such as `pitch_start` [rad].
        outputs: names of those to return; all if not given.
        report: called now and then with the done fraction.

    Raises:
        DataError: another sample time than the FMU's, or unknown names.
        FmuError: the FMU refused; the line says why.
    """
    part = FmuPart(path)
    if not np.isclose(part.sample_time, recording.sample_time, rtol=_SAME_SAMPLE_TIME):
        raise DataError(
            f"{path}: runs at {part.sample_time:g} s and the recording is at {recording.sample_time:g} s; "
            "resample the recording."
        )
    tables = []
    for run in recording.runs():
        drive = dict(zip(run.robot.set_points, run.set_points.T, strict=True))
        tables.append(
            drive_fmu(path, drive, parameters=parameters, outputs=outputs, start_time=float(run.time[0]), report=report)
        )
    return np.concatenate(tables)


def _rows(part: FmuPart, inputs: Mapping[str, Vector]) -> Matrix:
    names = [port.name for port in part.inputs]
    sizes = {len(column) for column in inputs.values()}
    if len(sizes) != 1 or 0 in sizes:
        raise DataError(f"the inputs must have one common length of at least 1; got {sorted(sizes)}.")
    # What no column gives was not measured, where that is allowed.
    held = [np.nan if port.missing else port.start for port in part.inputs]
    rows = np.tile(np.array(held), (sizes.pop(), 1))
    for name, column in inputs.items():
        if name not in names:
            raise DataError(f"`{name}` is not an input of {part.path}; it has {', '.join(names)}.")
        rows[:, names.index(name)] = column
    return rows
