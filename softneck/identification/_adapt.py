"""A model that follows a neck that changed: a warm refit on the latest data, held to the old model elsewhere.

    V(theta) = sum |y - yhat(theta)|^2 / rows + strength * sum |J (theta - theta_0)|^2 / rows of the reference

J are the derivatives of the old model's simulation along a reference motion over all set-points that it was trained on:
the second term is the Gaussian prior that a fit along that motion leaves behind (Ljung 1999, sec. 9.2 and 11.2).
Strength and blocks are chosen on held-out necks: `benchmarks/adaptation.py choose`. Of a network only the weights to
and from its states are moved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import FileFormatError, Matrix, SettingsError, Vector, one_blas_thread, require_positive
from softneck.signals import Recording, concatenate, signal

from .models._arrays import check_arrays, trained_range, trained_set_points
from .models._directions import NECK_SECONDS, on_motors, time_constant_of
from .models._fitting import row_hashes
from .models._model import WARM_UP, Model
from .models._scores import nrmse_fit
from .models._validity import limit_validity
from .structured._parameters import PARAMETERS

# Kind -> the arrays that are moved; entries that are zero are structure and stay.
_ADAPTED_ARRAYS = {"oe": ("a", "b", "A", "B", "offset"), "play": ("weights",), "nn": ("w3", "b3"), "greybox": ("neck",)}
#: Kinds that can adapt.
ADAPTING = tuple(_ADAPTED_ARRAYS)


@dataclass(frozen=True, slots=True, eq=False)
class FreeParameters:
    """The numbers of one model as one vector; `places`: array and mask of the entries in it that are moved."""

    model: Model
    places: tuple[tuple[str, np.ndarray], ...]

    @classmethod
    def of(cls, model: Model) -> FreeParameters:
        """Find them."""
        if model.kind == "greybox":
            mask = np.arange(model.arrays["neck"].size) < len(PARAMETERS)  # its tendons stand behind its numbers
            return cls(model, (("neck", mask),))
        found = [(name, model.arrays[name]) for name in _ADAPTED_ARRAYS[model.kind] if name in model.arrays]
        return cls(model, tuple((name, array != 0.0) for name, array in found))

    def start(self) -> Vector:
        """Return where they are."""
        if self.model.kind == "greybox":
            values = self.model.arrays["neck"]
            return np.array([number.encode(float(value)) for number, value in zip(PARAMETERS, values, strict=False)])
        return np.concatenate([self.model.arrays[name][mask] for name, mask in self.places])

    def sizes(self) -> Vector:
        """Return by how much each is usefully moved: its size, or that of its neighbours where it is small."""
        if self.model.kind == "greybox":
            return np.array([number.spread for number in PARAMETERS])
        parts = [self.model.arrays[name][mask] for name, mask in self.places]
        return np.concatenate([np.maximum(np.abs(part), np.median(np.abs(part))) for part in parts if part.size])

    @property
    def linear(self) -> bool:
        """Whether the simulation is linear in them, but for its limits: one step is all."""
        return self.model.kind == "play"

    def groups(self) -> list[list[tuple[int, int | None]]]:
        """Return the places (number, output) that can be moved at once: each moves its own output, None all of them."""
        count = len(self.model.robot.outputs.names)
        if self.model.kind not in ("play", "nn") and "a" not in self.model.arrays:
            return [[(place, None)] for place in range(self.start().size)]
        first, lines = 0, [[] for _ in range(count)]
        for _, mask in self.places:
            for axis, row in enumerate(mask):
                size = int(np.sum(row))
                lines[axis] += [(place, axis) for place in range(first, first + size)]
                first += size
        return [[line[i] for line in lines if i < len(line)] for i in range(max(map(len, lines)))]

    def at(self, x: Vector) -> Model:
        """Return the model with other numbers."""
        if self.model.kind == "greybox":
            numbers = [number.decode(float(np.clip(v, number.encode(number.low), number.encode(number.high))))
                       for number, v in zip(PARAMETERS, x, strict=True)]  # fmt: skip
            neck = np.concatenate([numbers, self.model.arrays["neck"][len(PARAMETERS) :]])
            # Its drives lag by the same number.
            drive = self.model.arrays["drive"].copy()
            drive[:, 0] = np.exp(-neck[0] * self.model.arrays["sensor"][1])
            return self._with({"neck": neck, "drive": drive})
        moved: dict[str, Matrix] = {}
        edges = np.cumsum([int(mask.sum()) for _, mask in self.places])
        for (name, mask), part in zip(self.places, np.split(x, edges[:-1]), strict=True):
            moved[name] = self.model.arrays[name].copy()
            moved[name][mask] = part
        return self._with(moved)

    def _with(self, moved: Mapping[str, Matrix]) -> Model:
        return replace(self.model, arrays={**self.model.arrays, **moved})

    def is_valid(self, x: Vector) -> bool:
        """Return whether the numbers make a model that a file may hold, and one that does not drift."""
        try:
            model = self.at(x)
            check_arrays(model.kind, model.arrays)
        except FileFormatError:
            return False
        if "a" in model.arrays:
            poles = [np.abs(np.roots([1.0, *row])).max(initial=0.0) for row in model.arrays["a"]]
        else:
            A = model.arrays.get("A", np.zeros((1, 1)))
            poles = np.abs(np.linalg.eigvals(A)) if model.kind == "oe" else [0.0]
        # As the fit of `oe` does: a pole slower than some 20 s at 20 ms is a drift.
        return bool(max(poles) < 0.999)


# A derivative by differences: far above rounding, far below what bends.
_DIFFERENCE_STEP = 1e-4
# Of each number against the reference [parts of its size]: what moves nothing at all stays where it is.
_MIN_INFORMATION = 1e-6
_STEPS, _MOST_DAMPING, _ENOUGH = 8, 1e4, 0.01
# Derivatives cost a simulation for each number: so many in all, which bounds the time whatever the kind.
_MAX_SIMULATIONS = 160
# The reference lasts so long [s of a neck]: all of `mixed`'s motions, each for two seconds.
_REFERENCE_S = 20.0
_RAMP_S = 1.0


def reference(model: Model) -> Recording:
    """Return a motion over all set-points that a model was trained on, from rest; outputs are unknown but for rest."""
    trained, Ts = trained_range(model.findings), model.sample_time
    motors, outputs = len(model.robot.motors.names), model.robot.outputs.names
    low, high = trained if trained is not None else (np.full(motors, -1.0), np.full(motors, 1.0))
    own = signal("mixed", duration=_REFERENCE_S, seed=0)
    P = on_motors(own.set_points, motors)
    P = low + (P - P.min(axis=0)) / np.ptp(P, axis=0) * (high - low)
    # As many samples for another robot, each of its own time constant.
    at = np.arange(0.0, len(P) - 1.0, max(Ts / (own.sample_time * _scale_seconds(1.0, model)), 0.2))
    P = np.column_stack([np.interp(at, np.arange(len(P)), column) for column in P.T])
    P *= np.minimum(1.0, np.arange(len(P)) / max(_RAMP_S * len(P) / _REFERENCE_S, 1.0))[:, None]
    Y = np.full((len(P), len(outputs)), np.nan)
    Y[0] = model.block().initial_state().outputs[: len(outputs)]
    channels = dict(zip((*model.robot.set_points, *outputs), (*P.T, *Y.T), strict=True))
    return Recording(np.arange(len(P)) * Ts, Ts, channels, robot=model.robot)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """One adaptation, its simulations along the window and along the reference.

    learnt, target (time, outputs): which entries count, what was measured; information (n, n): J'J / rows of the
    reference, by sizes; strength: of the prior.
    """

    free: FreeParameters
    window: Recording
    learnt: np.ndarray
    target: Matrix
    information: Matrix
    strength: float

    def errors(self, z: Vector) -> Vector:
        """Return the errors that count, by numbers counted from the old ones in their sizes."""
        return (self.target - simulate_outputs(self.free.at(self.numbers(z)), self.window))[self.learnt]

    def numbers(self, z: Vector) -> Vector:
        """Return the numbers."""
        return self.free.start() + self.free.sizes() * z

    def cost(self, z: Vector, e: Vector) -> float:
        """Return V."""
        return float(e @ e / e.size + z @ self.prior @ z)

    @property
    def prior(self) -> Matrix:
        """(n, n) of the second term."""
        return self.strength * self.information

    def solve(self) -> Vector:
        """Return z of the lowest cost near zero by damped Gauss-Newton steps."""
        z = np.zeros(self.free.start().size)
        e = self.errors(z)
        cost, damping = self.cost(z, e), 1e-3
        for _ in range(int(np.clip(_MAX_SIMULATIONS // len(self.free.groups()), 1, _STEPS))):
            J = derivatives(self.free, self.numbers(z), lambda model: simulate_outputs(model, self.window))[
                :, self.learnt
            ].T
            A, g = J.T @ J / e.size + self.prior, J.T @ e / e.size - self.prior @ z
            found = self._step(z, cost, damping, A, g)
            if found is None:
                break
            gained = cost - found[1]
            z, cost, e, damping = found
            if gained < _ENOUGH * cost or self.free.linear:
                break
        return z

    def _step(
        self, z: Vector, cost: float, damping: float, A: Matrix, g: Vector
    ) -> tuple[Vector, float, Vector, float] | None:
        """Return the step that lowers the cost, None where none does."""
        while damping < _MOST_DAMPING:
            trial = z + np.linalg.solve(A + damping * np.diag(np.diag(A)), g)
            if self.free.is_valid(self.numbers(trial)):
                e = self.errors(trial)
                value = self.cost(trial, e)
                if value < cost:
                    return trial, value, e, damping / 10.0
            damping *= 10.0
        return None


def information(free: FreeParameters, motion: Recording) -> Matrix:
    """Return J'J (n, n) / entries of the old simulation along `motion`, by sizes of the numbers, positive definite."""
    J = derivatives(free, free.start(), lambda model: simulate_outputs(model, motion))
    J = J.reshape(len(J), -1)
    H = J @ J.T / J.shape[1]
    return H + _MIN_INFORMATION * max(np.trace(H) / len(H), 1e-12) * np.eye(len(H))


def simulate_outputs(model: Model, recording: Recording) -> Matrix:
    """Return the simulation (time, outputs)."""
    return model.simulate(recording)[:, : recording.outputs.shape[1]]


def derivatives(free: FreeParameters, numbers: Vector, run: Callable[[Model], Matrix]) -> np.ndarray:
    """Return the derivatives (n, time, outputs) of a simulation by each number over its size."""
    now, sizes = run(free.at(numbers)), free.sizes()
    J = np.zeros((numbers.size, *now.shape))
    for group in free.groups():
        moved = numbers.copy()
        for place, _ in group:
            moved[place] += _DIFFERENCE_STEP * sizes[place]
        change = (run(free.at(moved)) - now) / _DIFFERENCE_STEP
        for place, axis in group:
            if axis is None:
                J[place] = change
            else:
                J[place, :, axis] = change[:, axis]
    return np.nan_to_num(J, posinf=0.0, neginf=0.0)


def _scored_entries(recording: Recording) -> np.ndarray:
    """Return (time, outputs) whether an entry is scored: measured, and after the warm-up of its run."""
    late = np.concatenate([np.arange(len(run)) > WARM_UP for run in recording.runs()])
    return np.isfinite(recording.outputs) & late[:, None]


# The latest data that are looked at, scaled [s].
_WINDOW_S = 30.0
# Weight of a change along the reference beside an error over the window.
_PRIOR_STRENGTH = 0.1
# Held out: the last of every so many blocks, so long [scaled s]; between them the window is learnt from.
_HOLD_OUT_PERIOD, _BLOCK_S = 3, 2.0
# Set-points that move less than this part of what they do along the reference teach nothing.
_LEAST_MOTION = 0.1
# A direction that moves less than this part of the one that moves most, both as parts of the reference, is missing.
_LEAST_DIRECTION = 0.05
# Fewer entries of an output than this on either side decide nothing.
_LEAST_ROWS = 50
# Parts of the way that are tried until no output is worse.
_STEP_FRACTIONS = (1.0, 0.5, 0.25)


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptationResult:
    """The result of an adaptation.

    why: the old model was kept, "" where not; seconds: of the window; rows: held out; before, after: fit [%] of the
    simulation on them, of each output; part: of the way that was gone.
    """

    adapted: bool
    why: str
    seconds: float
    rows: int = 0
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()
    part: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of findings and JSON."""
        return {
            "adapted": self.adapted, "why": self.why, "window_s": self.seconds, "rows_held_out": self.rows,
            "fit_before": list(self.before), "fit_after": list(self.after), "part": self.part,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Adaptation:
    """How a model is adapted.

    Attributes:
        window: latest seconds of the recording that are looked at [s]; None: 150 time constants (of a neck 30 s).
        strength: weight of a change of the old simulation along its reference motion beside an error over the window.
        block: length of a block [s], of which every third is held out; None: 10 time constants (of a neck 2 s).
    """

    window: float | None = None
    strength: float = _PRIOR_STRENGTH
    block: float | None = None

    def __post_init__(self) -> None:
        require_positive("strength", self.strength)
        for name, value in (("window", self.window), ("block", self.block)):
            if value is not None:
                require_positive(name, value, "s")

    @one_blas_thread
    def of(self, model: Model, recording: Recording) -> Model:
        """Return the adapted model, or the old one if it is no worse; findings hold the reason under `adaptation`."""
        if model.kind not in ADAPTING:
            raise SettingsError(
                f"a model of kind `{model.kind}` cannot adapt; {', '.join(ADAPTING)} can. Identify it again on new "
                "data."
            )
        model.check(recording)
        window = _latest(recording, self.window or _scale_seconds(_WINDOW_S, model))
        if window is None:
            least = (WARM_UP + 1) * recording.sample_time
            why = f"no run of the window goes on for more than {least:.3g} s after all outputs were first measured"
            return _keep_model(model, AdaptationResult(adapted=False, why=why, seconds=0.0))
        known, held = _split(window, self.block or _scale_seconds(_BLOCK_S, model))
        seconds = len(window) * window.sample_time
        if min(known.sum(axis=0).min(), held.sum(axis=0).min()) < _LEAST_ROWS:
            why = "an output was measured in too few of its rows"
            return _keep_model(model, AdaptationResult(adapted=False, why=why, seconds=seconds))
        motion, why = reference(model), ""
        if not (window.set_points.std(axis=0) > _LEAST_MOTION * motion.set_points.std(axis=0)).any():
            why = "the window hardly moves the neck, so that it teaches nothing"
        elif missing := _missing_direction(model, window.set_points, motion.set_points):
            why = f"the window moves the robot along one direction; add motion of {missing}"
        if why:
            rows = int(held.any(axis=1).sum())
            return _keep_model(model, AdaptationResult(adapted=False, why=why, seconds=seconds, rows=rows))
        free = FreeParameters.of(model)
        problem = Problem(free, window, known, window.outputs, information(free, motion), self.strength)
        return _accept_if_better(model, window, problem, problem.solve(), held)


def _scale_seconds(seconds: float, model: Model) -> float:
    """Return so many seconds of a neck for a model [s]."""
    return seconds * ((time_constant_of(model) or NECK_SECONDS) / NECK_SECONDS)


def _accept_if_better(model: Model, window: Recording, problem: Problem, z: Vector, held: np.ndarray) -> Model:
    """Return the adapted model if no output is worse over the rows held out, else the old one."""
    seconds, rows = len(window) * window.sample_time, int(held.any(axis=1).sum())
    before = _fits(window.outputs, simulate_outputs(model, window), held)
    best: tuple[float, Model, tuple[float, ...]] | None = None
    for part in _STEP_FRACTIONS:
        numbers = problem.numbers(part * z)
        if not (part * z).any() or not problem.free.is_valid(numbers):
            continue
        trial = problem.free.at(numbers)
        after = _fits(window.outputs, simulate_outputs(trial, window), held)
        no_worse = all(new >= old for new, old in zip(after, before, strict=True))
        if no_worse and sum(after) > sum(before) and (best is None or sum(after) > sum(best[2])):
            best = (part, trial, after)
    if best is None:
        why = "no adapted model is better on the rows held out"
        return _keep_model(
            model, AdaptationResult(adapted=False, why=why, seconds=seconds, rows=rows, before=before, after=before)
        )
    said = AdaptationResult(
        adapted=True, why="", seconds=seconds, rows=rows, before=before, after=best[2], part=best[0]
    )
    new = _update_validity(best[1], window)
    findings = {**model.findings, **trained_set_points(window, model.findings), "adaptation": said.as_dict()}
    rows_seen = np.unique(np.concatenate([model.training_rows, row_hashes(window)]))
    return replace(new, findings=findings, training_rows=rows_seen)


def _keep_model(model: Model, said: AdaptationResult) -> Model:
    return replace(model, findings={**model.findings, "adaptation": said.as_dict()})


def _latest(recording: Recording, seconds: float) -> Recording | None:
    """Return the last seconds, each run from where all outputs are there; None where they never are."""
    rows = max(round(seconds / recording.sample_time), 1)
    last = recording.rows(max(len(recording) - rows, 0), len(recording))
    parts = []
    for run in last.runs():
        there = np.isfinite(run.outputs).all(axis=1)
        if there.any() and len(run) - int(np.argmax(there)) > WARM_UP + 1:
            parts.append(run.rows(int(np.argmax(there)), len(run)))
    return concatenate(parts) if parts else None


def _split(window: Recording, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the entries (time, outputs) to learn from and those held out: blocks in turn."""
    there = _scored_entries(window)
    block = np.arange(len(window)) // max(round(seconds / window.sample_time), 1)
    held = (block % _HOLD_OUT_PERIOD == _HOLD_OUT_PERIOD - 1)[:, None]
    return there & ~held, there & held


def _missing_direction(model: Model, window: Matrix, motion: Matrix) -> str:
    """Return the direction of the outputs that a window does not move, "" where it moves all that the motion does."""
    weights = model.robot.weights()
    if weights is None or len(weights) < 2:
        return ""
    moved, whole = (np.cov((rows @ weights.T).T) for rows in (window, motion))
    scale = np.linalg.inv(np.linalg.cholesky(whole))
    shares, directions = np.linalg.eigh(scale @ moved @ scale.T)
    # The least share alone is missing: where all are small, the window is short of motion altogether.
    if shares[0] > _LEAST_DIRECTION**2 * shares[-1]:
        return ""
    direction = np.abs(directions[:, 0])
    names = [name for name, part in zip(model.robot.outputs.names, direction, strict=True) if part > 0.4]
    return " and ".join(names) + (" across it" if len(names) > 1 else "")


def _fits(measured: Matrix, free: Matrix, held: np.ndarray) -> tuple[float, ...]:
    fits = [nrmse_fit(measured[held[:, axis], axis], free[held[:, axis], axis]) for axis in range(measured.shape[1])]
    return tuple(float(fit) if np.isfinite(fit) else -np.inf for fit in fits)


def _update_validity(model: Model, window: Recording) -> Model:
    """Return the model with a validity that includes its errors over the window."""
    there = _scored_entries(window)
    run = model.simulate(window)[:, : len(model.robot.outputs.names)]
    errors = np.where(there, window.outputs - run, np.nan)
    return limit_validity(model, errors)
