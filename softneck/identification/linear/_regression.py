"""Rows of linear regressions (Eq. 26), checks of their excitation, and arrays of linear models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_between, require_positive
from softneck.robot import Scaling
from softneck.signals import Recording

from ..models._arrays import within
from ..models._drive import DriveModel
from ..models._fitting import ScaledData
from ..models._linear_systems import history_array, system_of
from ..models._model import WARM_UP, Model


def check_delays(delay: float | None, max_delay: float | None) -> None:
    """Raise SettingsError for a dead time or a bound on it that is out of range."""
    if delay is not None:
        require_between("delay", delay, 0.0, 1e6, "s")
    if max_delay is not None:
        require_positive("max_delay", max_delay, "s")


def with_offset(kind: str, arrays: Mapping[str, Matrix], recording: Recording) -> dict[str, Matrix]:
    """Add an offset to the arrays of a state space: the mean error of its simulation."""
    offset = np.zeros(recording.outputs.shape[1])
    late = np.concatenate([np.arange(len(run)) for run in recording.runs()]) >= WARM_UP
    for _ in range(2):  # again, as the start of the simulation depends on the offset
        now = {**arrays, "offset": offset}
        model = Model(kind=kind, sample_time=recording.sample_time, arrays=now, robot=recording.robot)
        error = (recording.outputs - model.simulate(recording)[:, : offset.size])[late]
        offset = offset + (np.nanmean(error, axis=0) if np.isfinite(error).any(axis=0).all() else 0.0)
    return {**arrays, "offset": offset}


def linear_in_si(arrays: Mapping[str, Matrix], scaling: Scaling) -> dict[str, Matrix]:
    """Convert the arrays of scaled transfer functions, which rest at zero, or of a scaled state space to SI."""
    out, motor = scaling.output_unit, scaling.motor_unit
    if "a" in arrays:
        return {**arrays, "b": arrays["b"] * (out / motor)[:, None]}
    A, B, C, K = system_of(arrays)
    units = np.resize(out, len(A))  # states are (y, y, ..)
    A, B, K = units[:, None] * A / units, units[:, None] * B / motor, units[:, None] * K / out
    found = {**arrays, "A": A, "B": B, "K": K}
    if "offset" in arrays:
        gain = C @ np.linalg.pinv(np.eye(len(A)) - A) @ B
        found["offset"] = scaling.unscale_outputs(arrays["offset"]) - gain @ scaling.motor_rest
    return found


def axis_arrays(
    redefinition: Matrix, drive: DriveModel, a: Matrix, b: Matrix, delays: Sequence[int]
) -> dict[str, Matrix]:
    """Return the runtime's arrays of transfer functions over redefined inputs; a (outputs, na), b (outputs, nb)."""
    history = max(a.shape[1], max(delays) + b.shape[1], drive.delay.max())
    return {
        "history": history_array(int(history), len(a)),
        "drive": drive.array,
        "redefinition": redefinition,
        "a": a,
        "b": b,
        "delay": np.array(delays, dtype=np.float64),
    }


def functions_found(
    scaled: ScaledData, a: Sequence[Vector], b: Sequence[Vector], delays: Sequence[int]
) -> dict[str, Any]:
    """Return the transfer functions in SI as a finding, for a model whose arrays are one state space."""
    rows = zip(scaled.directions.names, a, b, delays, scaled.gains, strict=True)
    found = {name: {"a": f.tolist(), "b": (gain * g).tolist(), "delay": int(d)} for name, f, g, d, gain in rows}
    return {"transfer_functions": found}


def no_base(motors: int = 3, outputs: int = 2) -> dict[str, Matrix]:
    """Return the arrays of a set without a base model."""
    empty = np.zeros((outputs, 0))
    return {"redefinition": np.zeros((outputs + 1, motors)), "a": empty, "b": empty, "delay": np.zeros(outputs)}


def check_linear(arrays: Mapping[str, Matrix], sizes: Mapping[str, int], *, least: int = 1) -> None:
    """Raise FileFormatError for orders, dead times or a source outside the histories."""
    if "A" in arrays:
        within(np.array([sizes["n"]]), sizes["outputs"], sizes["outputs"] * sizes["H"], "the order")
        within(arrays["delay"][:1], 0, sizes["H"] - 1, "a dead time")
        within(arrays["delay"][1:], 0, 1, "the source")
        return
    most = max(sizes["outputs"], sizes["motors"]) + 1
    within(np.array([sizes["c"]]), sizes["outputs"], most, "the number of redefined inputs")
    within(arrays["delay"], 0, sizes["H"] - sizes["nb"], "a dead time")
    within(np.array([sizes["na"]]), least, sizes["H"], "the order")
    within(arrays.get("source", np.zeros(1)), 0, 1, "the source")


# Condition number of unit columns above which rounding and noise decide; real recordings stay below 1e4.
_MAX_CONDITION = 1e8


def arx_rows(runs: Sequence[tuple[Matrix, Matrix]], na: int, nb: int, delay: int) -> tuple[Matrix, Matrix]:
    """Return phi(t-1) of Eq. 26 (rows, n) and y(t) (rows, ny) of all runs, without rows with a missed sample.

    Runs are outputs (time, ny), the modelled one first, and inputs (time, nu); the newest input is u(t - delay - 1).
    """
    first = max(na, nb + delay)
    parts, targets = [], []
    for Y, U in runs:
        if len(Y) <= first:
            continue
        rows = slice(first, len(Y))
        columns = [-Y[first - i : len(Y) - i, j] for j in range(Y.shape[1]) for i in range(1, na + 1)]
        columns += [U[first - delay - i : len(Y) - delay - i, j] for j in range(U.shape[1]) for i in range(1, nb + 1)]
        parts.append(np.column_stack(columns))
        targets.append(Y[rows])
    if not parts:
        raise DataError(
            f"every run is shorter than the {first + 1} samples that this order and dead time need; "
            "lower them or record longer."
        )
    Phi, y = np.concatenate(parts), np.concatenate(targets)
    good = np.isfinite(Phi).all(axis=1) & np.isfinite(y[:, 0])
    return np.ascontiguousarray(Phi[good]), np.ascontiguousarray(y[good])


def require_excitation(what: str, Phi: Matrix) -> float:
    """Return the condition number of the regressors, with columns of unit length; raise DataError for a large one."""
    norms, number = np.linalg.norm(Phi, axis=0), float("inf")
    if Phi.shape[0] >= Phi.shape[1] and norms.min(initial=np.inf) > 0.0:
        number = float(np.linalg.cond(Phi / norms))
    if not number <= _MAX_CONDITION:
        raise DataError(
            f"{what}: the data does not determine the {Phi.shape[1]} parameters (condition number {number:.2g}, "
            f"{len(Phi)} rows): its input stands still, repeats another, or the order is too high. "
            "Record with an excitation such as `eq22`, or lower the orders."
        )
    return number
