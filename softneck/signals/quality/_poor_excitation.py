"""What a recording cannot teach, in one line each: said whenever a model is trained, for any robot."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._recording import Recording

# 10 s at 20 ms: fifty time constants of a neck, less than one of Eq. 22's slow waves.
_FEW_ROWS = 500
# Set-points that change in fewer rows are steps that can be counted, and say nothing between.
_FEW_CHANGES = 20
# Motions [standard deviations] below this part of the largest one are what drives and sensors add to it.
_NO_MOTION = 0.02
# An output of which the motors explain less than this [R2] follows something else.
_UNRELATED = 0.2
_BLOCKS = 10
# Motions of lagged set-points below this part of the largest are left out of a fit: what hardly moves in the blocks
# fitted, and moves in those judged, is extrapolated by thousands of times. Which part is small is tried.
_SINGULAR = (1e-6, 1e-4, 1e-2)
# By outputs that move by less of what they do in all rows [standard deviations] nothing can be judged: a good model's
# error, a twentieth of the motion that it was trained on, would read as a fit of 0 %.
_STANDS = 0.05
# Lags [samples] over which an output may follow: an octave apart, to 5 s at 20 ms.
_LAGS = (0, *(2**k for k in range(9)))


def poor_excitation(recording: Recording) -> tuple[str, ...]:
    """Return what there is to say before a model is trained on this recording; empty where nothing is missing."""
    said = []
    if len(recording) < _FEW_ROWS:
        seconds = len(recording) * recording.sample_time
        said.append(f"{len(recording)} rows ({seconds:.3g} s) are few to train on: record {_FEW_ROWS} or more.")
    spans = np.ptp(recording.set_points, axis=0)
    still = [name for name, span in zip(recording.robot.set_points, spans, strict=True) if span < 1e-9]
    if still:
        said.append(f"{', '.join(still)} never moves: what it does cannot be learned. Move every motor.")
    changes = sum(int((np.diff(run.set_points, axis=0) != 0.0).any(axis=1).sum()) for run in recording.runs())
    if spans.max() >= 1e-9 and changes < _FEW_CHANGES:
        said.append(f"the set-points change in {changes} rows only: a model is guesswork between them. Record `mixed`.")
    outputs = recording.robot.outputs.names
    if independent_motions(recording) < min(len(outputs), len(spans)):
        said.append(
            f"the motors move along {independent_motions(recording)} direction(s) for {len(outputs)} outputs: how they "
            "add up elsewhere cannot be learned. Move all of them independently, as `eq22` and `mixed` do."
        )
    if len(recording) < _FEW_ROWS or changes < _FEW_CHANGES:
        return tuple(said)  # too little to tell what an output follows
    said += [
        f"`{name}` does not follow the motors (they explain {100.0 * max(share, 0.0):.0f} % of its variance): no model "
        "of set-points will predict it. Look for drift, a wrong column, or an output that nothing moves."
        for name, share in zip(outputs, explained(recording), strict=True)
        if share < _UNRELATED
    ]
    return tuple(said)


def stands_still(held_out: Recording, whole: Recording) -> str | None:
    """Return why no model can be judged by `held_out`, a part of `whole`; None if one can."""
    for name, judged, seen in zip(whole.robot.outputs.names, held_out.outputs.T, whole.outputs.T, strict=True):
        there = np.isfinite(judged)
        if there.any() and np.nanstd(judged) < _STANDS * np.nanstd(seen):
            part = 100.0 * float(np.nanstd(judged) / np.nanstd(seen))
            return f"the rows held out stand still: {name} moves by {part:.1f} % of what it does in all rows"
    return None


def independent_motions(recording: Recording) -> int:
    """Return in how many directions the set-points move, each by 2 % of the largest motion at least."""
    U = recording.set_points
    sizes = np.linalg.svd(U - U.mean(axis=0), compute_uv=False)
    return int((sizes > _NO_MOTION * sizes[0]).sum()) if sizes[0] > 0.0 else 0


def explained(recording: Recording) -> Vector:
    """Return which share of each output's variance lagged set-points explain on rows not fitted (outputs,).

    Least squares on every other of ten blocks, judged on those between, and the other way round: a drift is met by
    chance where it is fitted, and nowhere else. NaN where an output was hardly measured or never moves.
    """
    X = np.concatenate([_lagged(run.set_points) for run in recording.runs()])
    odd = np.arange(len(X)) * _BLOCKS // len(X) % 2 == 1
    found = []
    for y in recording.outputs.T:
        parts = [(X[rows] - X[rows].mean(axis=0), y[rows] - y[rows].mean()) for rows in _halves(odd, np.isfinite(y))]
        spread = sum(float(y @ y) for _, y in parts)
        if spread <= 1e-18 or min(len(y) for _, y in parts) < 2 * X.shape[1]:
            found.append(np.nan)
            continue
        found.append(1.0 - min(_unexplained(parts, cut) for cut in _SINGULAR) / spread)
    return np.array(found)


def _unexplained(parts: list[tuple[Matrix, Vector]], cut: float) -> float:
    """Return the sum of squares that each half leaves when fitted on the other."""
    fits = [np.linalg.lstsq(A, b, rcond=cut)[0] for A, b in parts]
    return sum(float(((b - A @ fit) ** 2).sum()) for (A, b), fit in zip(parts, fits[::-1], strict=True))


def _halves(odd: np.ndarray, there: np.ndarray) -> list[np.ndarray]:
    """Return the numbers of the rows in even and in odd blocks that are there; one row where none is."""
    return [np.flatnonzero(part & there) if (part & there).any() else np.zeros(1, dtype=int) for part in (odd, ~odd)]


def _lagged(U: Matrix) -> Matrix:
    """Return the set-points of now and before (time, lags * motors), the first where there were none."""
    return np.column_stack(
        [np.vstack([np.repeat(U[:1], min(lag, len(U)), axis=0), U[: max(len(U) - lag, 0)]]) for lag in _LAGS]
    )
