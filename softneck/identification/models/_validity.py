"""The training range of the motors and the error of a model, from which its output `validity` is computed.

The numbers of `TRUST` were chosen on held-out robots (`benchmarks/leave_one_neck_out.py validity.*`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_positive, to_si
from softneck.robot import Robot
from softneck.runtime import Block, layout_of
from softneck.runtime._layout import Arrays
from softneck.signals import Recording

from ._arrays import with_validity, without_validity
from ._model import WARM_UP, Model
from ._validity_runtime import GROUND_RATE

#: The error that `validity` allows of an angle; of other outputs it allows a part of their range.
TOLERANCE_DEG = 2.0
_TOLERANCE_OF_RANGE = 0.02
# Share of the training rows inside the region where the model counts as trained.
_REGION_QUANTILE = 0.75
# Smallest variance of a direction, as a share of the mean variance: a hundredth of the spread is no motion.
_MIN_VARIANCE_SHARE = 1e-4
# Error variance over the squared tolerance of a diverged simulation: practically no validity.
_MAX_VARIANCE = 1e6


@dataclass(frozen=True, slots=True)
class Trust:
    """Error model of a kind outside its training rows.

    Attributes:
        ratio: of the error on new rows inside the training range to that on the training rows.
        growth: of the error's variance with `outside`, over that on the training rows; for equations and linear models.
        slope: the same, over the variance of the outputs; for models learned from rows alone.
        agreement: weight of the squared spread of members, or of the half-width of bounds.
    """

    ratio: float
    growth: float
    slope: float
    agreement: float = 0.0


_EQUATIONS, _LEARNED = Trust(0.7, 1.0, 0.002), Trust(2.0, 0.0, 0.02)
TRUST = {
    **dict.fromkeys(("rls", "oe", "greybox"), _EQUATIONS),
    **dict.fromkeys(("play", "nlsm", "nn"), _LEARNED),
    "guarded": Trust(1.0, 0.0, 0.02, 1.0),
}


def tolerance(robot: Robot, recording: Recording) -> Vector:
    """Return the default error (outputs,) in SI that `validity` allows."""
    count = len(robot.outputs.names)
    if to_si(robot.outputs.unit)[1] == "rad":
        return np.full(count, np.radians(TOLERANCE_DEG))
    low, high = robot.outputs.min, robot.outputs.max
    if low is not None and high is not None:
        return _TOLERANCE_OF_RANGE * (np.array(high) - np.array(low)) * to_si(robot.outputs.unit)[0]
    return _TOLERANCE_OF_RANGE * (np.nanmax(recording.outputs, axis=0) - np.nanmin(recording.outputs, axis=0))


def with_validity_region(model: Model, recording: Recording, *, trust: Trust | None = None) -> Model:
    """Add the arrays of `validity` to a model, from its simulation of the training recording."""
    bare = replace(model, arrays=without_validity(model.arrays))
    chosen = TRUST.get(model.kind, _LEARNED) if trust is None else trust
    allowed = tolerance(model.robot, recording)
    errors, motion = _errors_and_motion(bare, recording)
    ground, doubt = _ground(motion), np.zeros((allowed.size, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        missed = np.nanmean(errors**2, axis=0) / allowed**2
    missed = np.clip(np.nan_to_num(missed, nan=_MAX_VARIANCE, posinf=_MAX_VARIANCE), 1e-6, _MAX_VARIANCE)
    doubt[:, 0] = chosen.ratio**2 * missed
    doubt[:, 1] = chosen.growth * missed + chosen.slope * np.nanvar(recording.outputs, axis=0) / allowed**2
    doubt[:, 2] = chosen.agreement / allowed**2
    return replace(
        model,
        arrays=with_validity(model.kind, bare.arrays, ground, doubt),
        findings={**model.findings, **tolerance_finding(model.robot, allowed)},
    )


def limit_validity(model: Model, errors: Matrix) -> Model:
    """Lower the validity of a model to that of `errors` (time, outputs), NaN where not measured."""
    allowed = tolerance_of(model)
    if allowed is None or not has_validity(model):
        return model
    doubt = model.arrays["doubt"].copy()
    missed = np.clip(np.nanmean(errors**2, axis=0) / allowed**2, 1e-6, _MAX_VARIANCE)
    doubt[:, 0] = np.maximum(doubt[:, 0], TRUST.get(model.kind, _LEARNED).ratio ** 2 * missed)
    return replace(model, arrays={**model.arrays, "doubt": doubt})


# Kinds that are right on nearly all rows of their training, so that these say nothing of v.
_BLIND_TO_THEIR_ERROR = ("nlsm",)
# Largest factor on v that is looked for, and halvings of its logarithm: it is then known to 1 %.
_MAX_FACTOR, _HALVINGS = 1e5, 10


def calibrate_validity(model: Model, again: Model, recording: Recording, unseen: np.ndarray) -> Model:
    """Return the model with a v that holds on motions that a training did not see.

    `again` is of the same kind, trained without the rows `unseen` (time,) of the recording. v is multiplied so that the
    mean of its validity there is the share of rows with all errors within the tolerance; never made smaller. Other
    kinds than set membership are returned as they are: the ratio of `TRUST` serves them as well.
    """
    allowed = tolerance_of(again)
    if model.kind not in _BLIND_TO_THEIR_ERROR or allowed is None or not (has_validity(model) and has_validity(again)):
        return model
    doubt = again.arrays["doubt"].copy()
    v, doubt[:, 0] = float(doubt[:, 0].max()), 0.0
    outputs = np.asarray(replace(again, arrays={**again.arrays, "doubt": doubt}).simulate(recording))
    errors = np.abs(recording.outputs - outputs[:, : allowed.size])
    unseen = unseen & np.isfinite(recording.outputs).all(axis=1) & np.isfinite(outputs).all(axis=1)
    if not unseen.any():
        return model
    share = float((errors[unseen] <= allowed).all(axis=1).mean())
    outside = 1.0 / np.maximum(outputs[unseen, -1], 1e-9) - 1.0
    low, high = 1.0, _MAX_FACTOR
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if np.mean(1.0 / (1.0 + outside + middle * v)) > share else (low, middle)
    doubt = model.arrays["doubt"].copy()
    doubt[:, 0] *= low
    return replace(model, arrays={**model.arrays, "doubt": doubt})


def tolerance_finding(robot: Robot, allowed: Vector) -> dict[str, Any]:
    """Return the finding with the error that `validity` allows, given as (outputs,) in SI, in the display unit."""
    unit = robot.outputs.display_unit
    return {f"validity_within_{unit}": [round(value, 12) for value in (allowed / to_si(unit)[0]).tolist()]}


def tolerance_of(model: Model) -> Vector | None:
    """Return the error (outputs,) in SI that a model's `validity` allows; None where the findings have none."""
    unit = model.robot.outputs.display_unit
    found = model.findings.get(f"validity_within_{unit}")
    return None if found is None else np.array(found, dtype=float) * to_si(unit)[0]


def with_tolerance(model: Model, tolerance: float) -> Model:
    """Return the model with a `validity` that allows an error of `tolerance`, in the display unit of the outputs."""
    unit, known = model.robot.outputs.display_unit, tolerance_of(model)
    require_positive("tolerance", tolerance, unit)
    if known is None or not has_validity(model):
        raise DataError("`tolerance` is that of `validity`, which this model does not have: identify it again.")
    allowed = np.full(known.size, tolerance * to_si(unit)[0])
    doubt = model.arrays["doubt"] * (known / allowed)[:, None] ** 2
    findings = {**model.findings, **tolerance_finding(model.robot, allowed)}
    return replace(model, arrays={**model.arrays, "doubt": doubt}, findings=findings)


def has_validity(model: Model) -> bool:
    """Return whether a model has a training region; older files and models made by hand have none."""
    return len(model.arrays.get("ground", ())) > 0


def find_farthest_motor(block: Block, motors: Matrix) -> tuple[int, bool, float, float]:
    """Find the motor farthest from its training range at the end of positions `motors` (time, motors).

    Returns its index, whether its low-passed position counts, that position, and its relative distance.
    """
    ground = block.arrays[layout_of(block.runtime.partition("(")[0], Arrays).place("ground")]
    n = motors.shape[1]
    z = np.concatenate([motors[-1], low_pass_motors(motors)[-1]])
    inverse = np.linalg.inv(ground[:, 1:])
    # The extent of the ellipsoid |D z - o| <= 1 along each entry alone.
    times = np.abs(z - inverse @ ground[:, 0]) / np.sqrt(np.sum(inverse**2, axis=1))
    place = int(np.argmax(times))
    return place % n, place >= n, float(z[place]), float(times[place])


def _errors_and_motion(model: Model, recording: Recording) -> tuple[Matrix, Matrix]:
    """Return errors (rows, outputs) of the simulation, and motors as they are and low-passed (rows, 2 motors)."""
    outputs, motors = len(model.robot.outputs.names), len(model.robot.motors.names)
    errors, motion = [], []
    for run in recording.runs():
        if len(run) < 3:  # nothing to simulate after the start
            continue
        free = model.simulate(run)
        m = free[:, outputs : outputs + motors]
        # The outputs at t_k follow from the motors at t_k-1.
        z = np.hstack([m[:-1], low_pass_motors(m)[1:]])
        first = min(WARM_UP, len(run) - 2)
        errors.append((run.outputs - free[:, :outputs])[1 + first :])
        motion.append(z[first:])
    return np.concatenate(errors), np.concatenate(motion)


def low_pass_motors(m: Matrix) -> Matrix:
    """Return the motors `m` (time, motors) after the low-pass of the runtime."""
    from scipy.signal import lfilter

    keep = 1.0 - GROUND_RATE
    late = np.vstack([m[:1], m[:-1]])
    return np.asarray(lfilter([GROUND_RATE], [1.0, -keep], late, axis=0, zi=keep * m[:1])[0])


def _ground(motion: Matrix) -> Matrix:
    """Return o and D (n, 1 + n) of the ellipsoid |D z - o| <= 1 around `_REGION_QUANTILE` of a motion (rows, n)."""
    motion = motion[np.isfinite(motion).all(axis=1)]
    centre = motion.mean(axis=0)
    spread = np.atleast_2d(np.cov(motion.T))
    spread += max(_MIN_VARIANCE_SHARE * np.trace(spread) / len(spread), 1e-12) * np.eye(len(spread))
    D = np.linalg.inv(np.linalg.cholesky(spread))
    reach = np.quantile(np.linalg.norm((motion - centre) @ D.T, axis=1), _REGION_QUANTILE)
    # The entries above the diagonal are rounding errors.
    D = np.tril(D) / max(reach, 1e-9)
    return np.column_stack([D @ centre, D])
