"""What a set stands on: its regressor, drives and base, and balanced kd-trees over its points.

The slanted tree has the directions in which the points spread: its boxes are tighter and have fewer sides, and values
over the plane range far less within one. Form `residual` is over what a linear base leaves: no feedback to drift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix, SettingsError, Vector
from softneck.robot import Scaling
from softneck.runtime import have_numba, load_functions
from softneck.signals import Recording

from ..linear._regression import check_linear, linear_in_si, no_base
from ..models._arrays import check_table, within
from ..models._drive import DriveModel
from ..models._fitting import ScaledData
from ..models._linear_systems import history_array
from ..models._model import WARM_UP, Model
from ..models._regressors import motor_signals, regression, regressor_scale
from ..models._scores import nrmse_fit

# The last level has at most so many points in a node, and (of more than one node) at least half as many.
LEAF = 16


def depth_of(rows: int) -> int:
    """Return the number of halvings after which no node has more than `LEAF` of `rows` points."""
    depth = 0
    while rows > LEAF << depth:
        depth += 1
    return depth


def tree_order(points: Matrix) -> np.ndarray:
    """Return the order (N,) of `points` (n, N) in which each node is a segment, halved across its widest side."""
    rows = points.shape[1]
    order = np.arange(rows)
    for level in range(depth_of(rows)):
        cuts = borders(rows, level)
        sides = np.array([low_high(row[order], cuts) for row in points])
        widest = np.argmax(sides[:, 1] - sides[:, 0], axis=0)
        node = np.repeat(np.arange(widest.size), np.diff(cuts))
        order = order[np.lexsort((points[widest[node], order], node))]
    return order


def tree_nodes(points: Matrix, values: Vector) -> Matrix:
    """Return the nodes (2^(depth+1), 2 n + 2) over points (n, N) in tree order: low and high a side, ymin, ymax.

    Node j of level l is row 2^l + j and holds the columns from `j N >> l` on; row 0 is unused and zero.
    """
    n, rows = points.shape
    depth = depth_of(rows)
    nodes = np.zeros((2 << depth, 2 * n + 2))
    for level in range(depth + 1):
        cuts = borders(rows, level)
        for i, row in enumerate((*points, values)):
            nodes[1 << level : 2 << level, 2 * i : 2 * i + 2] = low_high(row, cuts).T
    return nodes


def borders(rows: int, level: int) -> np.ndarray:
    """Return the first column of each node of a level, then `rows`."""
    return (np.arange((1 << level) + 1) * rows) >> level


def low_high(row: Vector, borders: np.ndarray) -> Matrix:
    """Return the minimum and maximum (2, nodes) of each segment."""
    return np.array([np.minimum.reduceat(row, borders[:-1]), np.maximum.reduceat(row, borders[:-1])])


# Of gamma, the most that the plane may climb: nearer to it, rounding of gamma^2 - m^2 would count.
_MAX_SLOPE_RATIO = 0.98
# Directions with less than this share of the widest spread hardly tell nodes apart, and the plane is steep over their
# noise: they take part in neither.
_MIN_SPREAD_RATIO = 0.02
_MAX_SAMPLED_POINTS = 20_000
# Other sides come in fours, as processors take them.
_SIDES_STEP = 4
_MAX_SIDES = 8


def slant_frames(data: Sequence[tuple[Matrix, Vector]], gammas: Vector) -> tuple[Matrix, Vector]:
    """Return a frame (1 + 4 or 1 + 8, n) for each points (n, N) and values (N,), and its plane's climb along row 0.

    Rows are orthonormal; those behind the n-th are zero.
    """
    found = [_frame(points, values, float(gamma)) for (points, values), gamma in zip(data, gammas, strict=True)]
    sides = _SIDES_STEP if max(wide for _, _, wide in found) <= _SIDES_STEP else _MAX_SIDES
    return np.array([frame[: 1 + sides] for frame, _, _ in found]), np.array([slope for _, slope, _ in found])


def _frame(points: Matrix, values: Vector, gamma: float) -> tuple[Matrix, float, int]:
    """Return the frame with all sides that may be, the plane's climb, and how many sides tell nodes apart."""
    n = len(points)
    # Directions and plane may be anything: a part of the points finds good ones.
    some = slice(None, None, max(1, values.size // _MAX_SAMPLED_POINTS))
    P, y = points[:, some], values[some] - values[some].mean()
    # Sums of squares of any size neither overflow nor vanish.
    size = float(np.abs(P).max()) or 1.0
    P = P / size
    P -= P.mean(axis=1, keepdims=True)
    spread, follows = P @ P.T, P @ y
    variance, V = np.linalg.eigh(spread)
    slope = np.zeros(n)
    # The plane follows the directions of widest spread, as long as it climbs less than cones do.
    for j in range(n - 1, -1, -1):
        if variance[j] <= _MIN_SPREAD_RATIO**2 * variance[-1]:
            break
        more = slope + V[:, j] * (V[:, j] @ follows / variance[j])
        if float(np.linalg.norm(more)) > _MAX_SLOPE_RATIO * gamma * size:
            break
        slope = more
    climb = float(np.linalg.norm(slope))
    along = slope / climb if climb > 0.0 else V[:, -1]
    # What is square to it, widest first.
    across = np.linalg.qr(np.column_stack([along, np.eye(n)]))[0][:, 1:]
    variance, V = np.linalg.eigh(across.T @ spread @ across)
    rows = (across @ V[:, ::-1]).T[:_MAX_SIDES]
    frame = np.zeros((1 + _MAX_SIDES, n))
    frame[0] = along
    frame[1 : 1 + len(rows)] = rows
    wide = np.sum(variance > _MIN_SPREAD_RATIO**2 * max(float(along @ spread @ along), variance.max(initial=0.0)))
    return frame, climb / size, int(wide)


def is_frame(frame: Matrix) -> bool:
    """Return whether the rows of a frame are orthonormal, but for rows of zeros: then no length in it is too long."""
    known = frame[np.any(frame != 0.0, axis=1)]
    sides = len(frame) - 1
    return (
        sides >= 0
        and sides % _SIDES_STEP == 0
        and bool(np.allclose(known @ known.T, np.eye(len(known)), rtol=0, atol=1e-13))
    )


def in_frame(frame: Matrix, points: Matrix) -> Matrix:
    """Return the points (n, N) along the rows of `frame`, summed in one order: the same bits on every machine."""
    turned = np.zeros((len(frame), points.shape[1]))
    for row, direction in zip(turned, frame, strict=True):
        for weight, component in zip(direction, points, strict=True):
            row += weight * component
    return turned


def slant_order(frame: Matrix, points: Matrix) -> np.ndarray:
    """Return the order (N,) of the columns of `points` in which each node is one segment of them."""
    return tree_order(in_frame(frame, points))


def _largest(points: Matrix) -> float:
    """Return the largest sum of a point's components, row by row."""
    total = np.zeros(points.shape[1])
    for row in points:
        total += np.abs(row)
    return float(total.max())


def slant_nodes(frame: Matrix, slope: float, points: Matrix, values: Vector) -> Matrix:
    """Return the nodes (2^(depth+1), 2 (1 + sides) + 2) over points in tree order; see `_principal_tree_runtime`.

    Row 0, which is not a node, holds the slope of the plane and the size of points and values.
    """
    sides, rows = len(frame) - 1, values.size
    depth = depth_of(rows)
    nodes = np.zeros((2 << depth, 4 + 2 * sides))
    nodes[0, 0] = slope
    nodes[0, 1] = _largest(points)
    nodes[0, 2] = np.abs(values).max()
    # One direction after the other: memory holds no second copy of the points.
    for i in range(1 + sides):
        row = in_frame(frame[i : i + 1], points)[0]
        columns = [(row, 3 + i, 3 + sides + i)] if i > 0 else [(row, 0, 1), (values - slope * row, 2, 3)]
        for level in range(depth + 1):
            there, cuts = nodes[1 << level : 2 << level], borders(rows, level)
            for numbers, low, high in columns:
                there[:, low], there[:, high] = low_high(numbers, cuts)
    return nodes


# At most so many rows tell how wide the bounds are between the data: a quantile needs no more.
_MAX_WIDTH_ROWS = 5000


def usual_width(points: Matrix, values: Vector, gamma: float, correlated: int, quantile: float) -> float:
    """Return the half-width, without epsilon, that a quantile of the rows stays below, themselves left out.

    Points (n, N) and values (N,) in order of time; `correlated` rows before and after a row are left out with it.
    """
    rows, halves = np.arange(values.size), []
    # Spread over the tree, and so over all places.
    for k in tree_order(points)[
        np.unique(np.linspace(0, rows.size - 1, min(rows.size, _MAX_WIDTH_ROWS)).astype(np.int64))
    ]:
        squared = np.zeros(rows.size)
        for row in points:
            gap = row - row[k]
            squared += gap * gap
        cone, counts = gamma * np.sqrt(squared), np.abs(rows - k) > correlated
        halves.append(0.5 * (np.min((values + cone)[counts]) - np.max((values - cone)[counts])))
    return float(np.quantile(halves, quantile))


def check_nlsm(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    """Raise FileFormatError unless the set has its tree, and its base fits the histories."""
    check_table(arrays["table"], sizes)
    within(np.array([sizes["rows"]]), 1, np.inf, "the number of points")
    frame, slopes = arrays["frame"], _slopes(arrays)
    if not all(is_frame(rows) for rows in frame):
        raise FileFormatError("the directions in its array `frame` are not orthogonal; identify the model again.")
    parts = zip(frame, slopes, arrays["points"], arrays["values"], strict=True)
    nodes = np.array([slant_nodes(*axis) for axis in parts])
    # A tree of another shape would be read beyond its end, and one of other numbers would leave points out.
    if not np.array_equal(arrays["nodes"], nodes):
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    check_linear(arrays, sizes, least=0)


def _slopes(arrays: Mapping[str, Matrix]) -> Vector:
    """Return the climb (outputs,) of the values' plane of each axis, less than the cones'."""
    nodes = arrays["nodes"]
    axes = len(arrays["bounds"])
    slopes = nodes[:, 0, 0] if nodes.ndim == 3 and len(nodes) == axes and nodes.size else np.full(axes, -1.0)
    if not ((slopes >= 0.0) & ((slopes < arrays["bounds"][:, 0]) | (slopes == 0.0))).all():
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    return slopes


_TREE_SEARCH = "softneck.identification.set_membership._gamma_runtime"


def least_gammas(points: Matrix, values: Vector, slacks: Vector) -> tuple[Vector, np.ndarray]:
    """Return the smallest gamma (m,) of a slack with `|y_j - y_k| <= slack + gamma |w_j - w_k|`, and its pair (m, 2).

    A gamma beyond 1e200 says that equal regressors have outputs further apart than the slack.
    """
    rising = np.argsort(slacks, kind="stable")
    gammas, found = np.zeros(slacks.size), np.zeros((slacks.size, 2), dtype=np.int64)
    if not have_numba():
        return all_pairs_gammas(points, values, slacks)
    order = tree_order(points)
    points, values = np.ascontiguousarray(points[:, order]), values[order]
    nodes = tree_nodes(points, values)
    search = load_functions(_TREE_SEARCH).gamma_search
    search(points, values, nodes, np.ascontiguousarray(slacks[rising]), gammas, found)
    back = np.argsort(rising)
    return gammas[back], order[found[back]]


def all_pairs_gammas(points: Matrix, values: Vector, slacks: Vector) -> tuple[Vector, np.ndarray]:
    """Return `least_gammas` by numpy."""
    n, worst = values.shape[0], np.zeros((slacks.size, 2), dtype=np.int64)
    gammas = np.zeros(slacks.shape[0])
    for i in range(n - 1):
        squared = np.zeros(n - 1 - i)
        for c in range(points.shape[0]):
            gap = points[c, i + 1 :] - points[c, i]
            squared += gap * gap
        distance = np.sqrt(squared)
        rise = np.abs(values[i + 1 :] - values[i])
        for m in range(slacks.shape[0]):
            # 1e-300 and 1e300 keep equal regressors from making 0/0 or infinity; `argmax` would stumble over a NaN.
            needed = np.minimum(np.maximum(rise - slacks[m], 0.0) / np.maximum(distance, 1e-300), 1e300)
            j = int(np.argmax(needed))
            if needed[j] > gammas[m]:
                gammas[m] = needed[j]
                worst[m] = i, i + 1 + j
    return gammas, worst


def require_feasible(
    training: ScaledData, table: Matrix, data: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector
) -> None:
    """Raise DataError, naming two samples of the recording, where equal regressors deny epsilon whatever gamma is.

    `data`: regressors (n, N) and targets (N,) of each axis, in order; a least gamma beyond 1e100: there is none.
    """
    if gamma.max() <= 1e100:
        return
    recording, axis = training.recording, int(np.argmax(gamma))
    points, values = data[axis]
    j, k = sorted(least_gammas(points, values, epsilon[axis : axis + 1])[1][0].tolist())
    rows = _rows_of(recording, table, axis, values.size)
    name, unit = recording.robot.outputs.names[axis], recording.robot.outputs.display_unit
    tried = training.in_display_unit(epsilon)
    rise = float(training.in_display_unit(np.full_like(epsilon, np.abs(values[j] - values[k])))[axis])
    where = f"samples {j} and {k} of the set"
    if rows is not None:
        where = " and ".join(
            f"row {row} (run {recording.run[row]}, {recording.time[row]:.6g} s)" for row in (rows[j], rows[k])
        )
    raise DataError(
        f"epsilon {tried.round(4).tolist()} {unit} is below the noise: equal regressors have outputs "
        f"further apart, so no function fits the data. {where} differ by {rise:.4g} {unit} in {name} and by nothing in "
        "the regressor. Set `epsilon` higher."
    )


def _rows_of(recording: Recording, table: Matrix, axis: int, count: int) -> np.ndarray | None:
    """Return the recording's row (count,) of each sample of the set, or None if unknown."""
    lags = table[:, 2].astype(int)
    # Form `residual` (source 3) waits for its base to settle.
    skip = (2 if (table[:, 0] == 3).any() else 1) * int(lags.max())
    runs, start, found = recording.runs(), 0, []
    for run in runs:
        own = sorted({0, *lags[table[:, 0] == 0]})
        there = np.array(
            [all(np.isfinite(run.outputs[k - lag, axis]) for lag in own) for k in range(skip, len(run))], dtype=bool
        )
        found.append(start + skip + np.flatnonzero(there))
        start += len(run)
    rows = np.concatenate(found)
    return rows if rows.size == count else None


# How far back the state shows in the inputs: the newest sample of a neck, then about one, two and four time constants
# of 0.2. Denser or longer ones moved no simulation by more than 2 points (virtual neck, `paper`).
_LOOKS_BACK = (0.02, 0.2, 0.4, 0.8)
# The longest lag is at most this part of a run where the time constant is learned, as twice as long the base settles: a
# robot as slow as its record is long does not show what was so long ago.
_RUNS_SHARE = 8


def residual_lags(recording: Recording, paced: bool) -> tuple[int, ...]:
    """Return the lags [samples] of the motors and of the base's outputs for a scaled recording."""
    longest = max(len(run) for run in recording.runs())
    most = longest if paced else longest // _RUNS_SHARE
    lags = {max(min(round(seconds / recording.sample_time), most), 1) for seconds in _LOOKS_BACK}
    return tuple(sorted(lags))


def residual_rows(
    recording: Recording, base: Model, table: Matrix, axis: int, *, measured: bool = False
) -> tuple[Matrix, Vector]:
    """Return regressors (n, N) and y(k) less the base's simulation (N,), no row of a run before the base settled.

    Source 3 of the table is the base's simulation; `measured` takes logged motor positions. DataError: runs too short.
    """
    parts, left = [], []
    outputs, both = recording.outputs.shape[1], recording.outputs.shape[1] + recording.set_points.shape[1]
    for run in recording.runs():
        # Its start is forgotten at the far end of the regressor: a base of 4 rad/s keeps 3 % of it after 0.8 s.
        settled = 2 * int(table[:, 2].max())
        if len(run) <= settled:
            continue
        simulated = base.simulate(run, warm_up=1)
        motors = run.motor_positions if measured else simulated[:, outputs:both]
        sources = {1: run.set_points, 2: motors, 3: simulated[:, :outputs]}
        columns = np.array([sources[int(s)][settled - int(lag) : len(run) - int(lag), int(c)] for s, c, lag in table])
        target = run.outputs[settled:, axis] - sources[3][settled:, axis]
        there = np.isfinite(target) & np.isfinite(columns).all(axis=0)
        parts.append(columns[:, there])
        left.append(target[there])
    if sum(part.size for part in left) < 2:
        raise DataError("every run is too short for form `residual`; record runs of several seconds.")
    return np.concatenate(parts, axis=1), np.concatenate(left)


Data = Sequence[tuple[Matrix, Vector]]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """All of a set but its points and their scale.

    table: rows (source, channel, lag); drive: supplies motor positions in simulation; base: of form `residual`;
    measured: whether the set is made of logged motor positions, where there are any.
    """

    table: Matrix
    drive: DriveModel
    base: Model | None
    measured: bool

    def data(self, recording: Recording) -> Data:
        """Return each axis' regressors (n, N), not scaled, and targets (N,)."""
        axes = range(recording.outputs.shape[1])
        if self.base is not None:
            base, measured = self.base, self.measured and recording.has_motor_positions
            return [residual_rows(recording, base, self.table, axis, measured=measured) for axis in axes]
        recording = motor_signals(recording, self.drive, again=not self.measured)
        pairs = [regression(recording, self.table, axis) for axis in axes]
        return [(X.T, y) for X, y in pairs]

    def arrays(self, data: Data, scale: Vector, gamma: Vector, epsilon: Vector) -> dict[str, Matrix]:
        """Return the runtime's arrays of the set of `data`; gamma and epsilon (outputs,), scale (n,)."""
        history = int(max(self.table[:, 2].max(), self.drive.delay.max(), 1))  # samples that the runtime stores
        base = no_base(len(self.drive.pole), len(data))
        if self.base is not None:
            base = {name: self.base.arrays[name] for name in base}
            history = max(history, int(self.base.arrays["history"][0]))
        return {
            "history": history_array(history, len(data)),
            "drive": self.drive.array,
            "table": self.table,
            "scale": scale,
            **set_arrays([(apply_scale(X, scale), y) for X, y in data], gamma, epsilon),
            **base,
        }

    def free_run(self, arrays: dict[str, Matrix], recording: Recording) -> tuple[float, float, float]:
        """Return the sum of all axes' simulation fits [%], the bounds' coverage (0 to 1) and mean width [rad].

        The score of a run that left all bounds is -inf.
        """
        robot, outputs = recording.robot, recording.outputs.shape[1]
        lower = outputs + recording.set_points.shape[1] + 2 * np.arange(outputs)
        model = Model(kind="nlsm", sample_time=recording.sample_time, arrays=arrays, robot=robot)
        y, Y = recording.outputs[WARM_UP:], model.simulate(recording)[WARM_UP:]
        fits = [nrmse_fit(y[:, axis], Y[:, axis]) for axis in range(outputs)]
        low, high, there = Y[:, lower], Y[:, lower + 1], np.isfinite(y)
        coverage = float(((low <= y) & (y <= high))[there].mean()) if there.any() else 0.0
        return float(sum(fits)) if np.isfinite(fits).all() else -np.inf, coverage, float(np.mean(high - low))


def set_in_si(arrays: Mapping[str, Matrix], scaling: Scaling) -> dict[str, Matrix]:
    """Return the arrays of a scaled set, and of its base, in SI; all outputs have one unit."""
    out, rest = scaling.output_unit, scaling.output_rest
    base = linear_in_si({name: arrays[name] for name in no_base()}, scaling)
    moved = scaling.motor_rest.any() or rest.any()
    if arrays["b"].size and moved:  # rows for the outputs alone say that the base is not zero at rest
        base["redefinition"] = base["redefinition"][: len(out)]
    # The base has no offset: it stands elsewhere in SI, and the set's values make up for it.
    static = base["b"].sum(axis=1) / (1.0 + base["a"].sum(axis=1))
    at_rest = static * (base["redefinition"][: len(out)] @ scaling.motor_rest)
    rests, units = regressor_scale(arrays["table"], scaling, at_rest)
    scale = arrays["scale"] / units[0]
    points = [W + (scale * r)[:, None] for W, r in zip(arrays["points"], rests, strict=True)]
    values = (rest - at_rest)[:, None] + out[:, None] * arrays["values"]
    gamma, epsilon = out * arrays["bounds"].T
    made = set_arrays(list(zip(points, values, strict=True)), gamma, epsilon)
    return {**arrays, "scale": scale, **made, **base}


def gammas(data: Data, scale: Vector, epsilons: Sequence[Vector]) -> list[Vector]:
    """Return the smallest gamma (outputs,) for each epsilon (outputs,), by the paper's rule."""
    columns = [
        least_gammas(apply_scale(X, scale), y, np.array([epsilon[axis] for epsilon in epsilons]))[0]
        for axis, (X, y) in enumerate(data)
    ]
    return [np.array(pair) for pair in zip(*columns, strict=True)]


def double_epsilon_until_feasible(data: Data, scale: Vector, epsilon: Vector) -> tuple[Vector, Vector]:
    """Return epsilon (outputs,), doubled until a function fits the data, and its smallest gamma.

    Rows of several payloads have equal regressors and unequal outputs: what parts them counts as noise.
    """
    gamma = gammas(data, scale, [epsilon])[0]
    while gamma.max() > 1e100:
        epsilon = np.where(gamma > 1e100, 2.0 * epsilon, epsilon)
        gamma = gammas(data, scale, [epsilon])[0]
    return epsilon, gamma


def widening(chosen: Vector, taken: Vector, training: ScaledData) -> dict[str, str]:
    """Return the finding on an increased epsilon (outputs,); empty if it is unchanged."""
    if np.array_equal(chosen, taken):
        return {}
    wide, narrow = (
        "/".join(f"{value:.3g}" for value in training.in_display_unit(values)) for values in (taken, chosen)
    )
    why = "equal regressors have unequal outputs (several payloads?)"
    unit = training.recording.robot.outputs.display_unit
    return {"widened": f"epsilon is {wide} {unit} instead of {narrow}: {why}"}


def apply_scale(points: Matrix, scale: Vector) -> Matrix:
    """Return points (n, N) in the norm of Eq. 16, each component times its weight."""
    return np.ascontiguousarray(points * scale[:, None])


def set_arrays(points: Data, gamma: Vector, epsilon: Vector) -> dict[str, Matrix]:
    rows = min(values.size for _, values in points)
    if rows < 2:
        raise SettingsError("a set needs at least 2 points.")
    W = np.empty((len(points), points[0][0].shape[0], rows))
    y = np.empty((len(points), rows))
    # Filled in place: with the data at hand and the tree, memory holds 2.9 times the data (of eight sides: 3.3).
    points = [(given[:, :rows], values[:rows]) for given, values in points]
    frames, slopes = slant_frames(points, gamma)
    for axis, (given, values) in enumerate(points):
        order = slant_order(frames[axis], given)
        for row, given_row in zip(W[axis], given, strict=True):
            row[:] = given_row[order]
        y[axis] = values[order]
    nodes = np.array([slant_nodes(*axis) for axis in zip(frames, slopes, W, y, strict=True)])
    return {
        "points": W, "values": y, "bounds": np.column_stack([gamma, epsilon]), "nodes": nodes, "frame": frames,
    }  # fmt: skip
