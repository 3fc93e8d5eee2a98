"""The neck as one state space from its three motors to both angles, without redefinition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._directions import directions_of
from ..models._drive import fit_drive
from ..models._fitting import delay_samples, fitted_model, training_recording
from ..models._model import Model
from ..models._state_space import lss_arrays
from ._oe import SOURCES
from ._operating_point import about, operating_point, with_offset
from ._regression import condition

# A mode slower than the record cannot be told from a drift: it is drawn in to this radius.
_LARGEST_RADIUS = 0.9995

Runs = Sequence[tuple[Matrix, Matrix]]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SubspaceFit:
    """A state space and how it fits.

    Attributes:
        A, B, C, K: of the innovation form.
        singular_values: of the projected future: their drop says the order.
        cost: (ny,) sums of squared errors of the free run, over the outputs.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    K: Matrix
    singular_values: Vector
    cost: Vector


def fit_subspace(runs: Runs, order: int, horizon: int, *, offset: bool = False) -> SubspaceFit:
    """Identify from inputs (time, nu) and outputs (time, ny) of each run.

    Args:
        runs: never joined; a window with a missed output is left out.
        order: n.
        horizon: block rows of past and of future.
        offset: whether outputs have a constant part, which no state is to stand for.

    Raises:
        DataError: every run too short, or too few windows.
    """
    windows = _Windows(runs, horizon)
    gamma, sequence, values = windows.observability(order, offset=offset)
    ny = runs[0][1].shape[1]
    C = gamma[:ny]
    A = _settled(np.linalg.lstsq(gamma[:-ny], gamma[ny:])[0])
    B, cost = _input_matrix(runs, A, C, offset=offset)
    K = _gain(windows, sequence, A, B, C)
    return SubspaceFit(A=A, B=B, C=C, K=K, singular_values=values, cost=cost)


class _Windows:
    """All windows of past and future of all runs."""

    def __init__(self, runs: Runs, horizon: int) -> None:
        self.nu, self.ny, self.horizon = runs[0][0].shape[1], runs[0][1].shape[1], horizon
        parts, self.follows, self.inputs, self.outputs = [], [], [], []
        for U, Y in runs:
            count = len(U) - 2 * horizon
            if count < 2:
                continue
            both = np.column_stack([U, Y])
            rows = np.lib.stride_tricks.sliding_window_view(both, 2 * horizon, axis=0)[:count]  # (count, nu+ny, 2h)
            good = np.isfinite(rows).all(axis=(1, 2))
            parts.append(rows[good])
            at = np.flatnonzero(good)
            follows = np.zeros(at.size, dtype=bool)
            follows[:-1] = np.diff(at) == 1
            self.follows.append(follows)
            self.inputs.append(U[at + horizon])
            self.outputs.append(Y[at + horizon])
        total = sum(len(part) for part in parts)
        need = 2 * horizon * (self.nu + self.ny)
        if total < need:
            raise DataError(
                f"{total} windows of {2 * horizon} samples without a missed one are too few for {need} rows; "
                "record longer runs or lower `horizon`."
            )
        self.data = np.concatenate(parts)

    def observability(self, order: int, *, offset: bool) -> tuple[Matrix, Matrix, Vector]:
        """Return Gamma (h ny, n), the states (windows, n) at the first sample of each future, and singular values."""
        h, nu = self.horizon, self.nu
        flat = self.data.transpose(0, 2, 1)  # (windows, time, channel)
        count = len(flat)
        past = flat[:, :h].reshape(count, -1)
        future_u = flat[:, h:, :nu].reshape(count, -1)
        future_y = flat[:, h:, nu:].reshape(count, -1)
        if offset:  # a constant is an input that is known as well: what it does is projected out with the others
            future_u = np.column_stack([np.ones(count), future_u])
        R = np.asarray(np.linalg.qr(np.column_stack([future_u, past, future_y]), mode="r"))
        n1, n2 = future_u.shape[1], past.shape[1]
        R22, R23 = R[n1 : n1 + n2, n1 : n1 + n2], R[n1 : n1 + n2, n1 + n2 :]
        U, s, _ = np.linalg.svd(R23.T, full_matrices=False)
        if order > s.size or s[order - 1] <= 1e-12 * s[0]:
            raise DataError(f"the data holds fewer than {order} states; lower `order`.")
        gamma = U[:, :order] * np.sqrt(s[:order])
        # Y_f = Gamma X + ..., and X is what the past says of it with the future inputs taken out.
        states = past @ np.linalg.lstsq(R22, R23, rcond=1e-10)[0] @ np.linalg.pinv(gamma).T
        return gamma, states, s[: 3 * order + 4]


def _input_matrix(runs: Runs, A: Matrix, C: Matrix, *, offset: bool) -> tuple[Matrix, Vector]:
    """Return B (n, nu) and the cost by least squares of the free run, each run with a start of its own."""
    from scipy.signal import lfilter

    n, ny = A.shape[0], C.shape[0]
    nu = runs[0][0].shape[1]
    modes, V = np.linalg.eig(A)
    left, right = C @ V, np.linalg.inv(V)
    weights = np.einsum("im,mj->ijm", left, right)  # (ny, n, modes)
    parts, targets = [], []
    for U, Y in runs:
        forced = np.zeros((len(U), ny, n * nu))
        for j in range(nu):
            s = np.column_stack([lfilter([0.0, 1.0], [1.0, -m], U[:, j]) for m in modes])
            forced[:, :, j * n : (j + 1) * n] = np.real(np.einsum("tm,ijm->tij", s, weights))
        free = np.real(np.einsum("tm,ijm->tij", modes ** np.arange(len(U))[:, None], weights))
        if offset:
            forced = np.concatenate([forced, np.tile(np.eye(ny), (len(U), 1, 1))], axis=2)
        X, F, y = forced.reshape(len(U) * ny, -1), free.reshape(-1, n), Y.reshape(-1)
        there = np.isfinite(y)
        Q, _ = np.linalg.qr(F[there])
        parts.append(X[there] - Q @ (Q.T @ X[there]))
        targets.append((y[there] - Q @ (Q.T @ y[there]), np.flatnonzero(there) % ny))
    X = np.concatenate(parts)
    y = np.concatenate([t for t, _ in targets])
    channel = np.concatenate([c for _, c in targets])
    theta = np.linalg.lstsq(X, y)[0]
    e = y - X @ theta
    return theta[: n * nu].reshape(nu, n).T, np.array([float(e[channel == i] @ e[channel == i]) for i in range(ny)])


def _gain(windows: _Windows, states: Matrix, A: Matrix, B: Matrix, C: Matrix) -> Matrix:
    """Return the Kalman gain of the noise that the state sequence leaves over."""
    from scipy.linalg import solve_discrete_are

    follows = np.concatenate(windows.follows)
    at = np.flatnonzero(follows)
    U, Y = np.concatenate(windows.inputs), np.concatenate(windows.outputs)
    w = states[at + 1] - states[at] @ A.T - U[at] @ B.T
    v = Y[at] - states[at] @ C.T
    joint = np.cov(np.column_stack([w, v]).T)
    n, ny = A.shape[0], C.shape[0]
    # A clean simulation leaves nothing; an observer needs some noise to trade.
    floor = 1e-10 * max(float(np.trace(np.atleast_2d(np.cov(Y.T)))), 1e-12)
    R = joint[n:, n:] + floor * np.eye(ny)
    Q = joint[:n, :n] + floor * np.eye(n)
    S = joint[:n, n:]
    try:
        P = np.asarray(solve_discrete_are(A.T, C.T, Q, R, s=S))
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((n, ny))  # no stabilising gain: the model starts from where it would stand
    K = (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R)
    return K if np.abs(np.linalg.eigvals(A - K @ C)).max() < 1.0 else np.zeros((n, ny))


def _settled(A: Matrix) -> Matrix:
    """Return `A` with its modes drawn into the unit disc."""
    modes, V = np.linalg.eig(A)
    size = np.abs(modes)
    if size.max() <= _LARGEST_RADIUS:
        return A
    inside = np.where(size > _LARGEST_RADIUS, modes * _LARGEST_RADIUS / np.maximum(size, 1e-300), modes)
    return np.real(V @ np.diag(inside) @ np.linalg.inv(V))


# Motors that repeat each other to one part in a million: no method tells their effects apart.
_WORST_CONDITION = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Subspace:
    """State space of both angles over the three motors by past-output MOESP (of the N4SID family).

    Its gain K makes predictions from measured angles; its free run is fitted by B.

    Attributes:
        order: states, without the dead time.
        horizon: past and future samples that the projection looks at.
        delay: dead time of all motors [s]; None takes the one whose free run costs least.
        max_delay: end of that search [s], of another robot by its time constant over the neck's 0.2 s.
        source: "set_points", or "positions" of the motors, see `OutputError`.
    """

    order: int = 4
    horizon: int = 15
    delay: float | None = None
    max_delay: float = 0.2
    source: str = "set_points"

    def __post_init__(self) -> None:
        require_whole("order", self.order, 2, 30)
        require_whole("horizon", self.horizon, 2, 200)
        require_between("order / horizon", self.order / self.horizon, 0.0, 1.0)
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_positive("max_delay", self.max_delay, "s")
        require_one_of("source", self.source, SOURCES)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify both angles at once; runs are never joined, missed samples are left out.

        Raises:
            DataError: too short, constant, or motors that repeat each other.
        """
        recording = training_recording(recordings, any_robot=True)
        if self.source == "positions" and not recording.has_motor_positions:
            raise DataError("no motor positions were logged; use `source=set_points`.")
        motors = recording.motor_positions if self.source == "positions" else recording.set_points
        number = condition(motors)
        if not number <= _WORST_CONDITION:
            raise DataError(
                f"the {motors.shape[1]} motors repeat each other (condition number {number:.2g}), so their effects "
                "cannot be told apart. Record with co-contraction in it (`mixed`), or identify `oe` or `srivc` over "
                "theta_i and phi_i."
            )
        outputs = len(recording.robot.outputs.names)
        if self.order < outputs:
            raise DataError(f"{outputs} outputs need at least {outputs} states; raise `order`.")
        point = operating_point(recording)
        best, curves, found = self._search(about(recording, point), progress)
        fit, d = best
        drive = fit_drive(recording)
        arrays = lss_arrays(
            (fit.A, fit.B, fit.C, fit.K), delay=d, drive=drive.array, source=int(self.source == "positions")
        )
        arrays = with_offset("subspace", arrays, recording, point)
        progress(1.0, "done")
        return fitted_model(
            "subspace",
            self,
            recording,
            arrays=arrays,
            findings={
                "delay_criterion": "output_error",
                "delay_curve": curves,
                "singular_values": fit.singular_values.tolist(),
                "condition_number": number,
                **found,
            },
        )

    def _search(
        self, recording: Recording, progress: Progress
    ) -> tuple[tuple[SubspaceFit, int], dict[str, Any], dict[str, Any]]:
        """Return fit and dead time of the least cost, the cost curves, and what was found of another robot's time."""
        Ts, names = recording.sample_time, recording.robot.outputs.names
        runs = [
            (run.motor_positions if self.source == "positions" else run.set_points, run.outputs)
            for run in recording.runs()
        ]
        directions = directions_of(recording, [U for U, _ in runs])
        offset = not recording.robot.is_neck
        outputs = recording.outputs
        spread = np.nansum((outputs - np.nanmean(outputs, axis=0)) ** 2, axis=0)
        best: tuple[SubspaceFit, int] | None = None
        curves: dict[str, list[list[float]]] = {name: [] for name in names}
        tried = delay_samples(self.delay, self.max_delay * directions.stretch, Ts, [(Y, U) for U, Y in runs])
        for number, d in enumerate(tried):
            progress(number / len(tried), f"{1e3 * d * Ts:.0f} ms")
            fit = fit_subspace([(_late(U, d), Y) for U, Y in runs], self.order, self.horizon, offset=offset)
            for axis, name in enumerate(names):
                percent = 100.0 * (1.0 - float(np.sqrt(fit.cost[axis] / spread[axis])))
                curves[name].append([d * Ts, percent, float(np.sqrt(fit.cost[axis] / len(outputs)))])
            if best is None or np.sum(fit.cost / spread) < np.sum(best[0].cost / spread):
                best = (fit, d)
        if best is None:
            raise DataError("no dead time could be tried; record longer.")
        found = {} if recording.robot.is_neck else {"time_constants_s": directions.seconds.tolist()}
        return best, curves, found


def _late(U: Matrix, d: int) -> Matrix:
    """Return the inputs `d` samples late, the first held before the record."""
    return np.vstack([np.repeat(U[:1], min(d, len(U)), axis=0), U[: len(U) - d]]) if d else U
