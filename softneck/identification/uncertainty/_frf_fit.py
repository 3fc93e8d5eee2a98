"""From recordings to a frequency response: which inputs moved, which runs are periodic, which were in a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_one_of
from softneck.robot import Robot
from softneck.signals import Recording, redefine
from softneck.signals.recording._files import RecordingLike, opened_recording

from ..linear._oe import SOURCES
from ._frf import FrequencyResponse
from ._local_polynomial import Spectrum, local_polynomial, spectrum
from ._periodic import Periods, period_of, periods, robust
from ._spectra import Response

# Runs shorter than this have too few frequencies for a window of the local polynomials.
_ROWS = 200
# Samples that the sensor missed are filled by straight lines; more of them than this would be inventing an answer.
_MISSED = 0.1
# An input that moves less than this part of the largest is at rest.
_MOVES = 1e-3
# Realisations are of one class of input where their sizes agree within this factor.
_ALIKE = 1.5
_FREQUENCIES = 100
_STILL = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One run: inputs (time, q), outputs (time, m), references (time, m) of a closed loop or None."""

    inputs: Matrix
    outputs: Matrix
    references: Matrix | None
    missed: int


def frequency_response(recordings: RecordingLike, *, source: str = "set_points") -> FrequencyResponse:
    """Return the nonparametric response from inputs to outputs, with covariance and coherence.

    Runs of periodic multisines (at least two realisations, each of as many orthogonal experiments as inputs move) are
    taken by the robust method, which tells noise and nonlinear distortion apart; anything else by local polynomials.
    Recordings with a reference were in a closed loop:
    `S_yr S_ur^-1`. Every result is of inputs of this size: a nonlinear robot has another one for others.

    Args:
        recordings: as `identify` takes them; of one robot and one sample time; runs are never joined.
        source: "set_points", or "positions" of the motors.

    Returns:
        the response at its frequencies, in SI, inputs held between samples.

    Raises:
        DataError: too short, nothing moves, too many samples missed, sizes of realisations that differ, a closed
            loop whose reference rests or was not logged.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> found = softneck.frequency_response(softneck.record(signal("eq22", duration=30.0), neck, seed=1))
        >>> found.outputs, found.own_input("pitch")
        (('pitch', 'roll'), 'theta_i')
    """
    parts = [opened_recording(item) for item in (recordings if isinstance(recordings, list | tuple) else [recordings])]
    require_one_of("source", source, SOURCES)
    robot, sample_time = _one(parts)
    names, transform = input_names(robot)
    runs = [_run(run, transform, source) for part in parts for run in part.runs()]
    moving = _moving(runs, names)
    runs = [_Run(run.inputs[:, moving], run.outputs, run.references, run.missed) for run in runs]
    inputs = tuple(name for name, moves in zip(names, moving, strict=True) if moves)
    found, method = _estimate(runs, sample_time)
    missed = sum(run.missed for run in runs)
    findings: dict[str, Any] = {"runs": len(runs), "rows": sum(run.inputs.shape[0] for run in runs)}
    if missed:
        findings["missing"] = f"{missed} rows with a missing sample were filled by straight lines"
    if any(run.references is not None for run in runs):
        findings["closed_loop"] = "recorded in a closed loop: from the reference to outputs and inputs, S_yr S_ur^-1"
    noise = np.full(found.response.shape, np.nan) if found.noise is None else found.noise
    return FrequencyResponse(
        sample_time=sample_time, robot=robot, inputs=inputs, frequency=found.frequency, response=found.response,
        covariance=found.covariance, freedom=found.freedom, coherence=np.clip(found.coherence, 0.0, 1.0), noise=noise,
        amplitude=np.sqrt(2.0 * np.mean([run.inputs.var(axis=0) for run in runs], axis=0)), method=method,
        findings=findings,
    )  # fmt: skip


def input_names(robot: Robot) -> tuple[tuple[str, ...], Matrix]:
    """Return names of the inputs and their weights (q, motors).

    The neck's are theta_i, phi_i, delta_i (Eq. 9-11). Other robots have one for each output, as their directions are
    given, and one for each way to move motors that moves no output; without directions, the motors themselves.
    """
    weights, motors = robot.weights(), len(robot.motors.names)
    if robot.is_neck:
        return ("theta_i", "phi_i", "delta_i"), redefine(np.eye(3)).T
    if weights is None:
        return robot.set_points, np.eye(motors)
    rest = np.linalg.svd(weights)[2][weights.shape[0] :]
    return (
        *(f"towards_{name}" for name in robot.outputs.names),
        *(f"cocontraction_{k + 1}" for k in range(rest.shape[0])),
    ), np.vstack([weights, rest])


def _one(parts: Sequence[Recording]) -> tuple[Robot, float]:
    if not parts:
        raise DataError("a frequency response needs at least one recording; got none.")
    first = parts[0]
    for part in parts[1:]:
        if part.robot.hash != first.robot.hash:
            raise DataError(f"recordings of two robots, {first.robot.label()} and {part.robot.label()}; take one's.")
        if abs(part.sample_time - first.sample_time) > 1e-9 * first.sample_time:
            raise DataError(
                f"recordings at {first.sample_time:g} s and {part.sample_time:g} s; resample one "
                "(softneck import --resample)."
            )
    return first.robot, first.sample_time


def _run(run: Recording, transform: Matrix, source: str) -> _Run:
    motors = run.motor_positions if source == "positions" else run.set_points
    lost = ~np.isfinite(np.hstack([motors, run.outputs]))
    worst = float(lost.mean(axis=0).max())
    if worst > _MISSED:
        raise DataError(
            f"run {int(run.run[0])}: {100 * worst:.0f} % of a channel's samples are missing, more than "
            f"{100 * _MISSED:.0f} %; record again."
        )
    return _Run(_filled(motors) @ transform.T, _filled(run.outputs), _references(run), int(lost.any(axis=1).sum()))


def _filled(values: Matrix) -> Matrix:
    """Return (time, n) with straight lines where samples are missing."""
    rows, filled = np.arange(values.shape[0]), values.copy()
    for column in filled.T:
        there = np.isfinite(column)
        column[~there] = np.interp(rows[~there], rows[there], column[there])
    return filled


def _references(run: Recording) -> Matrix | None:
    """Return the references of a run in a closed loop, None for one in the open.

    Raises:
        DataError: a controller was at work, and what it was asked for rests or was not logged.
    """
    names = [f"{name}_reference" for name in run.robot.outputs.names]
    logged = [name for name in names if name in run.channels]
    if not logged:
        if any(name in run.channels for name in ("enabled", "innovation")):
            raise DataError(
                "recorded in a closed loop (it has an observer's or a controller's channels) without its reference: "
                f"log `{names[0]}`, or record in an open loop."
            )
        return None
    r = np.column_stack([run.channels[name] for name in logged])
    if np.ptp(r, axis=0).max() <= _STILL:
        raise DataError("recorded in a closed loop whose reference rests: nothing drives it; let the reference move.")
    return r[:, np.ptp(r, axis=0) > _STILL]


def _moving(runs: Sequence[_Run], names: Sequence[str]) -> np.ndarray:
    """Return which inputs move (q,)."""
    size = np.sqrt(np.mean([run.inputs.var(axis=0) for run in runs], axis=0))
    if size.max() <= _STILL:
        raise DataError(f"no input moves ({', '.join(names)} rest); there is nothing to see a response by.")
    return size > _MOVES * size.max()


def _estimate(runs: Sequence[_Run], sample_time: float) -> tuple[Response, str]:
    """Return the response and how it was found."""
    if any(run.references is not None for run in runs):
        return _behind_references(runs, sample_time), "local polynomials"
    lengths = [period_of(run.inputs) for run in runs]
    cut = [
        periods(run.inputs, run.outputs, length, sample_time)
        for run, length in zip(runs, lengths, strict=True)
        if length is not None
    ]
    if any(item.is_sine for item in cut):
        raise DataError("a run of one sine shows no linear response; record `multisine` with a band of two ends.")
    others = [run for run, length in zip(runs, lengths, strict=True) if length is None]
    if not others:
        _check_alike(cut)
        found = robust(cut)
        if found is not None:
            return found, "robust"
    _check_length(others)
    spectra = [spectrum(run.inputs, run.outputs, sample_time) for run in runs]
    return local_polynomial(spectra, _grid(runs, sample_time), runs[0].outputs.shape[1]), "local polynomials"


def _behind_references(runs: Sequence[_Run], sample_time: float) -> Response:
    widths = {None if run.references is None else run.references.shape[1] for run in runs}
    if len(widths) > 1:
        raise DataError("some runs are in a closed loop and others not, or other references move; take them apart.")
    q = runs[0].inputs.shape[1]
    _check_length(runs)
    spectra: list[Spectrum] = []
    for run in runs:
        references = run.references
        if references is None or references.shape[1] < q:
            count = 0 if references is None else references.shape[1]
            raise DataError(
                f"in a closed loop {q} inputs move and {count} reference(s): as many references must move as inputs; "
                "let each move by itself, and the co-contraction rest."
            )
        spectra.append(spectrum(references, np.hstack([run.outputs, run.inputs]), sample_time))
    return local_polynomial(spectra, _grid(runs, sample_time), runs[0].outputs.shape[1])


def _grid(runs: Sequence[_Run], sample_time: float) -> Vector:
    """Return the frequencies at which local polynomials answer: from two cycles in the longest run to nine tenths of
    the Nyquist frequency, beyond which little of a held input is left."""
    longest = max(run.inputs.shape[0] for run in runs) * sample_time
    return np.geomspace(4.0 * np.pi / longest, 0.9 * np.pi / sample_time, _FREQUENCIES)


def _check_length(runs: Sequence[_Run]) -> None:
    for number, run in enumerate(runs):
        if run.inputs.shape[0] < _ROWS:
            raise DataError(
                f"run {number} has {run.inputs.shape[0]} rows; a frequency response of what is not periodic needs "
                f"{_ROWS} at least."
            )


def _check_alike(runs: Sequence[Periods]) -> None:
    sizes = [float(np.sqrt((np.abs(run.inputs) ** 2).sum())) for run in runs]
    if max(sizes) > _ALIKE * min(sizes):
        raise DataError(
            f"the multisines' sizes differ by a factor of {max(sizes) / min(sizes):.2g}: a nonlinear robot answers "
            "small and large ones differently; make one response of each size."
        )
