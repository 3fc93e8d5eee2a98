"""A, B, C, D of an FMU or a block after a while of held inputs.

    x(k+1) = A x(k) + B u(k)
    y(k)   = C x(k) + D u(k)

of small changes, at the sample time. Of files and FMUs of ours whose step has derivatives they are exact; of all others
they come from pulses on a saved state (Ho and Kalman 1966; Juang and Pappa 1985): each input is held off its value for
one sample, up and down; half the difference of the outputs is the answer to a pulse, h(k). The least order whose system
answers all pulses alike is taken: A, B, C from the singular vectors of the matrix of h(i + j + 1), D = h(0).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, atomic_write, require_between
from softneck.fmu import Buildable, buildable
from softneck.identification import remove_unreachable_states
from softneck.loop import BlockPart
from softneck.runtime import Block, Port, State, TangentError, load_tangent

from ._fmu_part import FmuPart
from ._variables import block_of

if TYPE_CHECKING:
    import control

# What pulses may differ by before a linear system is worth little.
_POOR = 1e-3
# Of a sample time: where `at` is meant to be one.
_ON_GRID = 1e-6
_MOST_SAMPLES = 10_000_000
# Samples that an answer is followed for: two of ours' seconds and a half.
SAMPLES = 128
# A pulse, of the size of an input's moves: its square is what curvature leaves in the difference, 1e-8.
_PULSE = 1e-4
# What answers may differ by, of the largest: curvature, and rounding of the difference, with room.
_ALIKE = 1e-6
_ROUNDING = 1e3 * float(np.finfo(float).eps)
_MOST_STATES = 60


@dataclass(frozen=True, slots=True, eq=False)
class LinearPoint:
    """A linear system near a moment.

    Attributes:
        A, B, C, D: (n, n), (n, inputs), (outputs, n), (outputs, inputs).
        sample_time: [s].
        time: the moment [s].
        inputs, outputs: names; an FMU of others has them in its own units.
        name: of the model.
        method: "exact", or "pulses" on saved states.
        error: most that the answers to pulses differ from this system's, of the largest of them; 0 where exact.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    sample_time: float
    time: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    name: str
    method: str
    error: float = 0.0

    def summary(self) -> str:
        """Return a line on its order, moment and method, one on its signals, and one if it is worth little."""
        pulses = f"by pulses, which it answers to {self.error:.1e} of the largest"
        lines = [
            f"{self.name}: {len(self.A)} states at t = {self.time:g} s, {self.sample_time:g} s a sample, "
            f"{'exact' if self.method == 'exact' else pulses}",
            f"from {', '.join(self.inputs)} to {', '.join(self.outputs)}",
        ]
        if self.error > _POOR:
            lines.append("caution: it is not linear there, or moves while its inputs are held")
        return "\n".join(lines)

    def ss(self) -> control.StateSpace:
        """Return it for python-control, with `dt` and the signals' names."""
        import control

        return control.StateSpace(
            self.A, self.B, self.C, self.D, self.sample_time,
            inputs=list(self.inputs), outputs=list(self.outputs), name=self.name,
        )  # fmt: skip

    def to_mat(self, path: str | Path, *, force: bool = False) -> None:
        """Write a MATLAB file: A, B, C, D, Ts, InputName, OutputName, as controllers write theirs."""
        from scipy.io import savemat

        names = {"InputName": self.inputs, "OutputName": self.outputs}
        values = {"A": self.A, "B": self.B, "C": self.C, "D": self.D, "Ts": self.sample_time, "Time": self.time}
        values |= {key: np.array(value, dtype=object) for key, value in names.items()}
        with atomic_write(path, force=force) as temporary, temporary.open("wb") as file:
            savemat(file, values)


def linearize(
    source: str | Path | Block | Buildable, *, at: float = 0.0, values: Mapping[str, float] | None = None,
    sample_time: float | None = None,
) -> LinearPoint:  # fmt: skip
    """Return the linear system near t = `at` of a model, neck, controller or FMU whose inputs were held until then.

    Exact for what is ours and has derivatives; else from pulses on a saved state, whose `error` is told.
    Booleans and inputs that mean "not measured" are held, and `validity` is no output of a linear system. States
    that no input moves or no output shows are left out.

    Args:
        source: file of a model, observer, controller, neck or of any tool's FMU (FMI 2.0 or 3.0, Co-Simulation); a
            preset of a neck; a model, observer or controller; or its block.
        at: [s], on the grid of samples.
        values: inputs and parameters that differ from their start values, in SI units.
        sample_time: [s], of an FMU of others; its default step where none is given.

    Raises:
        SettingsError: a moment between samples, a name that is not there, an FMU that cannot save its state, or one
            whose outputs no input moves.
        FmuError: the FMU refused a call.

    Example:
        >>> import softneck
        >>> system = softneck.linearize("paper", at=0.02, values={"motor_setpoint_1": 0.5})
        >>> system.inputs[0], system.outputs[0], system.A.shape == (len(system.A), len(system.A))
        ('motor_setpoint_1', 'pitch', True)
        >>> system.ss().dt
        0.02
    """
    given = dict(values or {})
    require_between("at", at, 0.0, 1e12, "s")
    if not isinstance(source, str | Path) or Path(source).suffix != ".fmu":
        if sample_time is not None:
            raise SettingsError("`sample_time` is for FMUs; what is softneck's has its own.")
        return _of_block(*_opened(source, at, given))
    with FmuPart(source, role=None if _says_role(source) else "plant", sample_time=sample_time) as part:
        block = block_of(Path(source))
        if block is not None and sample_time in (None, block.sample_time):
            return _of_block(block, at, given)
        return _by_pulses(part, part.parameters, at, given, Path(source).stem)


def _opened(
    source: str | Path | Block | Buildable, at: float, given: Mapping[str, float]
) -> tuple[Block, float, Mapping[str, float]]:
    """Return the block of what is ours, and the values by the names that its robot has for them."""
    if isinstance(source, str | Path) and Path(source).suffix == ".ssp":
        raise SettingsError(f"{source}: is several FMUs; unzip it and linearize one of those in `resources`.")
    found = buildable(source)
    if isinstance(found, Block):
        return found, at, given
    robot = getattr(found, "robot", None)
    return found.block(), at, given if robot is None else {robot.own(name): value for name, value in given.items()}


def _says_role(path: str | Path) -> bool:
    from softneck.fmu import unpacked

    from ._variables import read_description

    with unpacked(Path(path)) as folder:
        return bool(read_description(Path(path), folder, {}).annotation.role)


def _of_block(block: Block, at: float, given: Mapping[str, float]) -> LinearPoint:
    held, parameters = _split(block.inputs, block.parameters, given, block.kind)
    try:
        tangent = load_tangent(block.runtime, compiled=False)  # for once: numba would take its time
    except TangentError:
        return _by_pulses(SavedBlock(block), block.parameters, at, given, block.kind)
    state = _reached_state(block, block.initial_state(**parameters), held, at)
    moved, shown = _moved(block.inputs, held), _shown(block.outputs)
    n, m = state.values.size, len(moved)
    X, U = np.zeros((n, n + m)), np.zeros((held.size, n + m))
    X[:, :n] = np.eye(n)
    U[moved, n + np.arange(m)] = 1.0
    Y = np.zeros((len(block.outputs), n + m))
    tangent(block.arrays, state.parameters, state.values.copy(), held, np.zeros(len(block.outputs)), X, U, Y, n + m)
    A, B, C, D = X[:, :n], X[:, n:], Y[shown, :n], Y[shown, n:]
    if block.role in ("plant", "reference"):
        # A step returns the outputs of the next sample; as states of their own they are those of this one.
        A, B = np.block([[A, np.zeros((n, len(C)))], [C, np.zeros((len(C), len(C)))]]), np.vstack([B, D])
        C, D = np.hstack([np.zeros((len(C), n)), np.eye(len(C))]), np.zeros((len(C), m))
    A, B, C = remove_unreachable_states(A, B, C)
    return LinearPoint(
        A,
        B,
        C,
        D,
        block.sample_time,
        at,
        _names(block.inputs, moved),
        _names(block.outputs, shown),
        block.kind,
        "exact",
    )


class SavedBlock(BlockPart):
    """A block whose state can be saved, as that of an FMU."""

    def get_state(self) -> tuple[Vector, Vector]:
        """Return state and outputs."""
        return self._state.copy(), self._outputs.copy()

    def set_state(self, state: tuple[Vector, Vector]) -> None:
        """Go on from what `get_state` returned."""
        self._state[:], self._outputs[:] = state


def _by_pulses(
    part: FmuPart | SavedBlock, parameters: tuple[Port, ...], at: float, given: Mapping[str, float], name: str
) -> LinearPoint:
    held, chosen = _split(part.inputs, parameters, given, name)
    part.start(0.0, chosen)
    part.get_state()  # one that cannot says so before it has run for long
    count, Ts = _samples(at, part.sample_time, name), part.sample_time
    for k in range(count):
        part.advance(k * Ts, held)
    moved, shown = _moved(part.inputs, held), _shown(part.outputs)
    sizes = [_size(part.inputs[i]) for i in moved]
    A, B, C, D, error = realised(part, count, held, moved, sizes, shown, name)
    inputs, outputs = _names(part.inputs, moved), _names(part.outputs, shown)
    return LinearPoint(A, B, C, D, Ts, at, inputs, outputs, name, "pulses", error)


def _split(
    inputs: tuple[Port, ...], parameters: tuple[Port, ...], given: Mapping[str, float], name: str
) -> tuple[Vector, dict[str, float]]:
    """Return the held inputs, and the parameters that are given."""
    known = [port.name for port in inputs]
    held = np.array([np.nan if port.missing else port.start for port in inputs])
    left: dict[str, float] = {}
    others = {port.name for port in parameters}
    for key, value in given.items():
        if not np.isfinite(value):
            raise SettingsError(f"{key} = {value}: must be finite.")
        if key in known:
            held[known.index(key)] = value
        elif key in others:
            left[key] = value
        else:
            raise SettingsError(f"{name}: has no input or parameter `{key}`; it has {', '.join([*known, *others])}.")
    return held, left


def _samples(at: float, sample_time: float, name: str) -> int:
    count = round(at / sample_time) if np.isfinite(at) and 0.0 <= at < _MOST_SAMPLES * sample_time else -1
    if count < 0:
        raise SettingsError(f"at t = {at:g} s: must be between 0 and {_MOST_SAMPLES} samples of {sample_time:g} s.")
    if abs(at / sample_time - count) > _ON_GRID * max(count, 1):
        raise SettingsError(
            f"at t = {at:g} s: {name} has a sample each {sample_time:g} s; take {count * sample_time:g} s."
        )
    return count


def _reached_state(block: Block, state: State, held: Vector, at: float) -> State:
    count = _samples(at, block.sample_time, block.kind)
    return block.run(state, np.tile(held, (count, 1)))[0] if count else state


def _moved(inputs: tuple[Port, ...], held: Vector) -> list[int]:
    return [i for i, port in enumerate(inputs) if not (port.boolean or port.integer) and np.isfinite(held[i])]


def _shown(outputs: tuple[Port, ...]) -> list[int]:
    return [i for i, port in enumerate(outputs) if not (port.boolean or port.integer) and port.name != "validity"]


def _names(ports: tuple[Port, ...], chosen: list[int]) -> tuple[str, ...]:
    return tuple(ports[i].name for i in chosen)


def _size(port: Port) -> float:
    """Return how large an input's moves are, for pulses to be small beside them."""
    if port.nominal:
        return abs(port.nominal)
    if port.minimum is not None and port.maximum is not None and 0.0 < port.maximum - port.minimum < 1e6:
        return 0.5 * (port.maximum - port.minimum)
    return 1.0


def realised(
    part: Any, first: int, held: Vector, moved: list[int], sizes: list[float], shown: list[int], name: str
) -> tuple[Matrix, Matrix, Matrix, Matrix, float]:
    """Return A, B, C, D of least order that answer pulses as `part` does from where it is, and what they miss.

    Args:
        part: what is stepped; the outputs of plants and references come one sample later than the inputs.
        first: samples that it has taken.
        held: (inputs,) the inputs off which pulses go.
        moved, sizes: the inputs that are moved, and how large their moves are.
        shown: the outputs that are looked at.
        name: for messages.

    Raises:
        SettingsError: nothing to move or look at, or no input moves an output.
    """
    if not moved or not shown:
        raise SettingsError(f"{name}: has no {'output' if moved else 'input'} that is a number, so no linear system.")
    h, noise = _answers(part, first, held, moved, sizes, shown)
    scale = float(np.abs(h).max())
    if not np.isfinite(scale):
        raise SettingsError(f"{name}: its outputs are not finite there, or after a pulse.")
    if scale <= noise:
        raise SettingsError(f"{name}: no input moves an output within {SAMPLES} samples from there.")
    half, outputs, inputs = (SAMPLES - 1) // 2, len(shown), len(moved)
    H = np.block([[h[i + j + 1] for j in range(half)] for i in range(half)])
    shifted = np.block([[h[i + j + 2] for j in range(half)] for i in range(half)])
    left, s, right = np.linalg.svd(H, full_matrices=False)
    best: Any = None
    for order in range(min(_MOST_STATES, int(np.sum(s > noise))) + 1):
        root = np.sqrt(s[:order])
        A = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        B, C = root[:, None] * right[:order, :inputs], left[:outputs, :order] * root
        missed = float(np.abs(_markov(A, B, C, h[0]) - h).max()) / scale
        if best is None or missed < best[-1]:
            best = (A, B, C, h[0], missed)
        if missed <= max(_ALIKE, noise / scale):
            break
    return best


def _answers(
    part: Any, first: int, held: Vector, moved: list[int], sizes: list[float], shown: list[int]
) -> tuple[np.ndarray, float]:
    """Return answers (SAMPLES, outputs, inputs) for pulses of 1, and what rounding leaves in them."""
    late = part.role in ("plant", "reference")
    h = np.zeros((SAMPLES, len(shown), len(moved)))
    noise, state = 0.0, part.get_state()
    for column, (i, size) in enumerate(zip(moved, sizes, strict=True)):
        off = _PULSE * size
        sides = []
        for sign in (1.0, -1.0):
            part.set_state(state)
            u = held.copy()
            u[i] += sign * off
            seen = []
            for k in range(SAMPLES - late):
                seen.append(np.array(part.advance((first + k) * part.sample_time, u))[shown])
                u = held
            sides.append(np.array(seen))
        h[int(late) :, :, column] = (sides[0] - sides[1]) / (2.0 * off)
        noise = max(noise, _ROUNDING * float(np.abs(sides[0]).max()) / off)
    return h, noise


def _markov(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> np.ndarray:
    answers, x = [D], B
    for _ in range(SAMPLES - 1):
        answers.append(C @ x)
        x = A @ x
    return np.array(answers)
