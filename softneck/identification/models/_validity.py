"""What the output `validity` goes by: where the motors were in training, and how wrong a model of this kind gets.

A model is judged on the rows that it was trained on, in free run; how much more it misses elsewhere is no property of
these rows but of its kind: `RATIO` and `SLOPE` are chosen on necks that were not trained on
(`benchmarks/leave_one_neck_out.py validity.*`).
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

#: The error that a neck's validity allows; of another robot whose outputs are no angles a part of their range.
TOLERANCE_DEG = 2.0
_TOLERANCE_OF_RANGE = 0.02
# Up to here, as a share of the training's rows, the motors count as where they have been.
_WITHIN = 0.75
# A direction in which the motors hardly went, of their mean variance: a hundredth of their spread is not a motion.
_LEAST_VARIANCE = 1e-4
# A free run that diverged is off by no number; this is as good as never right.
_MOST = 1e6


@dataclass(frozen=True, slots=True)
class Trust:
    """How far a kind of model can be trusted beyond its training.

    Attributes:
        ratio: of its error where it was trained to that on the rows that it was trained on.
        growth: how its error's variance grows with `outside`, over that on these rows: what equations or lines miss
            elsewhere is as what they miss here.
        slope: the same over the variance of the outputs: what was learnt from rows alone can be anything elsewhere.
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
    """Return the error (outputs,) in SI that `validity` allows where nothing else is asked."""
    count = len(robot.outputs.names)
    if to_si(robot.outputs.unit)[1] == "rad":
        return np.full(count, np.radians(TOLERANCE_DEG))
    low, high = robot.outputs.min, robot.outputs.max
    if low is not None and high is not None:
        return _TOLERANCE_OF_RANGE * (np.array(high) - np.array(low)) * to_si(robot.outputs.unit)[0]
    return _TOLERANCE_OF_RANGE * (np.nanmax(recording.outputs, axis=0) - np.nanmin(recording.outputs, axis=0))


def with_validity_region(model: Model, recording: Recording, *, trust: Trust | None = None) -> Model:
    """Return `model` with what its output `validity` takes.

    Args:
        model: as identified.
        recording: what it was trained on.
        trust: in the place of what its kind has.
    """
    bare = replace(model, arrays=without_validity(model.arrays))
    chosen = TRUST.get(model.kind, _LEARNED) if trust is None else trust
    allowed = tolerance(model.robot, recording)
    errors, motion = _errors_and_motion(bare, recording)
    ground, doubt = _ground(motion), np.zeros((allowed.size, 3))
    with np.errstate(over="ignore", invalid="ignore"):
        missed = np.nanmean(errors**2, axis=0) / allowed**2
    # No error at all is no number to judge others by either.
    missed = np.clip(np.nan_to_num(missed, nan=_MOST, posinf=_MOST), 1e-6, _MOST)
    doubt[:, 0] = chosen.ratio**2 * missed
    doubt[:, 1] = chosen.growth * missed + chosen.slope * np.nanvar(recording.outputs, axis=0) / allowed**2
    doubt[:, 2] = chosen.agreement / allowed**2
    return replace(
        model,
        arrays=with_validity(model.kind, bare.arrays, ground, doubt),
        findings={**model.findings, **tolerance_finding(model.robot, allowed)},
    )


def limit_validity(model: Model, errors: Matrix) -> Model:
    """Return `model` that trusts itself no more than `errors` (time, outputs) allow, NaN where nothing was measured."""
    allowed = tolerance_of(model)
    if allowed is None or not has_validity(model):
        return model
    doubt = model.arrays["doubt"].copy()
    missed = np.clip(np.nanmean(errors**2, axis=0) / allowed**2, 1e-6, _MOST)
    doubt[:, 0] = np.maximum(doubt[:, 0], TRUST.get(model.kind, _LEARNED).ratio ** 2 * missed)
    return replace(model, arrays={**model.arrays, "doubt": doubt})


def tolerance_finding(robot: Robot, allowed: Vector) -> dict[str, Any]:
    """Return the finding that says what error `validity` allows, (outputs,) in SI, in the unit that people see."""
    unit = robot.outputs.display_unit
    return {_finding(unit): [round(value, 12) for value in (allowed / to_si(unit)[0]).tolist()]}


def _finding(unit: str) -> str:
    return f"validity_within_{unit}"


def tolerance_of(model: Model) -> Vector | None:
    """Return the error (outputs,) in SI that a model's `validity` allows; None where it does not say."""
    unit = model.robot.outputs.display_unit
    found = model.findings.get(_finding(unit))
    return None if found is None else np.array(found, dtype=float) * to_si(unit)[0]


def with_tolerance(model: Model, tolerance: float) -> Model:
    """Return `model` whose `validity` allows an error of `tolerance`, in the unit in which people see the outputs.

    Raises:
        SettingsError: a tolerance that is not positive.
        DataError: a model that has no validity.
    """
    unit, known = model.robot.outputs.display_unit, tolerance_of(model)
    require_positive("tolerance", tolerance, unit)
    if known is None or not has_validity(model):
        raise DataError("`tolerance` is that of `validity`, which this model does not have: identify it again.")
    allowed = np.full(known.size, tolerance * to_si(unit)[0])
    # All of `doubt` are variances over the tolerance squared.
    doubt = model.arrays["doubt"] * (known / allowed)[:, None] ** 2
    findings = {**model.findings, **tolerance_finding(model.robot, allowed)}
    return replace(model, arrays={**model.arrays, "doubt": doubt}, findings=findings)


def has_validity(model: Model) -> bool:
    """Return whether a model says where it was trained; older files and models made by hand do not."""
    return len(model.arrays.get("ground", ())) > 0


def find_farthest_motor(block: Block, motors: Matrix) -> tuple[int, bool, float, float]:
    """Return which motor is farthest from where it was in training: its place, whether held or as it is, where, times.

    Args:
        block: of a model that knows its validity.
        motors: positions (time, motors) up to the instant that is asked for.
    """
    ground = block.arrays[layout_of(block.runtime.partition("(")[0], Arrays).place("ground")]
    n = motors.shape[1]
    z = np.concatenate([motors[-1], low_pass_motors(motors)[-1]])
    inverse = np.linalg.inv(ground[:, 1:])
    # Of each entry alone: how far it went when all of them were within 1, one standard deviation like another.
    times = np.abs(z - inverse @ ground[:, 0]) / np.sqrt(np.sum(inverse**2, axis=1))
    place = int(np.argmax(times))
    return place % n, place >= n, float(z[place]), float(times[place])


def _errors_and_motion(model: Model, recording: Recording) -> tuple[Matrix, Matrix]:
    """Return the errors (rows, outputs) of the free run and where the motors were then (rows, 2 motors)."""
    outputs, motors = len(model.robot.outputs.names), len(model.robot.motors.names)
    errors, motion = [], []
    for run in recording.runs():
        if len(run) < 3:  # a start, and nothing that follows from it
            continue
        free = model.simulate(run)
        m = free[:, outputs : outputs + motors]
        # What stands at t_k follows from the motors at t_k-1.
        z = np.hstack([m[:-1], low_pass_motors(m)[1:]])
        first = min(WARM_UP, len(run) - 2)
        errors.append((run.outputs - free[:, :outputs])[1 + first :])
        motion.append(z[first:])
    return np.concatenate(errors), np.concatenate(motion)


def low_pass_motors(m: Matrix) -> Matrix:
    """Return where the motors `m` (time, motors) have been held, as the runtime keeps it."""
    from scipy.signal import lfilter

    keep = 1.0 - GROUND_RATE
    # Row k+1 has taken in row k.
    late = np.vstack([m[:1], m[:-1]])
    return np.asarray(lfilter([GROUND_RATE], [1.0, -keep], late, axis=0, zi=keep * m[:1])[0])


def _ground(motion: Matrix) -> Matrix:
    """Return `ground` (n, 1 + n) of a motion (rows, n): within 1 lie as many of them as `_WITHIN` says."""
    motion = motion[np.isfinite(motion).all(axis=1)]
    centre = motion.mean(axis=0)
    spread = np.atleast_2d(np.cov(motion.T))
    spread += max(_LEAST_VARIANCE * np.trace(spread) / len(spread), 1e-12) * np.eye(len(spread))
    D = np.linalg.inv(np.linalg.cholesky(spread))
    reach = np.quantile(np.linalg.norm((motion - centre) @ D.T, axis=1), _WITHIN)
    # Above the diagonal there is only rounding.
    D = np.tril(D) / max(reach, 1e-9)
    return np.column_stack([D @ centre, D])
