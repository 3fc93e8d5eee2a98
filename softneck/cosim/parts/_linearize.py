"""Linear system A, B, C, D of an FMU or a block near a moment, after constant inputs.

    x(k+1) = A x(k) + B u(k)
    y(k)   = C x(k) + D u(k)

for small changes, at the sample time. The system is exact for files and FMUs of softneck whose step has derivatives.
For all others it comes from pulses on a saved state (Ho and Kalman 1966; Juang and Pappa 1985). Each input is moved off
its value for one sample, up and down; half the difference of the outputs is the pulse response h(k). The order is the
lowest whose system has the same pulse responses: A, B, C from the singular vectors of the matrix of h(i + j + 1),
D = h(0).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, atomic_write, require_between
from softneck.fmu import Buildable, buildable, unpacked
from softneck.identification import remove_unreachable_states
from softneck.loop import BlockPart
from softneck.runtime import Block, Port, TangentError, load_tangent

from ._fmu_part import FmuPart
from ._variables import read_block, read_description

if TYPE_CHECKING:
    import control

# Relative error of the pulse responses above which the summary warns.
_POOR_FIT = 1e-3
# Tolerance of `at`, as a share of a sample time.
_GRID_TOLERANCE = 1e-6
_MAX_SAMPLES = 10_000_000
# Length of a pulse response: 2.5 s at 20 ms.
SAMPLES = 128
# Size of a pulse, as a share of the input's range: curvature adds its square, 1e-8, to the difference.
_PULSE_SHARE = 1e-4
# Allowed relative error of the pulse responses: curvature and rounding of the difference, with a margin.
_FIT_TOLERANCE = 1e-6
_ROUNDING = 1e3 * float(np.finfo(float).eps)
_MAX_STATES = 60


@dataclass(frozen=True, slots=True, eq=False)
class LinearPoint:
    """A linear system near a moment.

    `A`, `B`, `C`, `D`: (n, n), (n, inputs), (outputs, n), (outputs, inputs). `sample_time`: [s]. `time`: the moment
    [s]. `inputs`, `outputs`: names; FMUs of other tools keep their own units. `name`: of the model. `method`: "exact",
    or "pulses" on saved states. `error`: largest error of the pulse responses, relative to the largest response; 0 if
    exact.
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
        """Return a line on order, moment and method, one on the signals, and a warning if the error is large."""
        pulses = f"from pulses, with an error of {self.error:.1e} of the largest response"
        lines = [
            f"{self.name}: {len(self.A)} states at t = {self.time:g} s, {self.sample_time:g} s a sample, "
            f"{'exact' if self.method == 'exact' else pulses}",
            f"from {', '.join(self.inputs)} to {', '.join(self.outputs)}",
        ]
        if self.error > _POOR_FIT:
            lines.append("caution: the system is not linear there, or its outputs move while the inputs are constant")
        return "\n".join(lines)

    def ss(self) -> control.StateSpace:
        """Return it for python-control, with `dt` and the signals' names."""
        import control

        return control.StateSpace(
            self.A, self.B, self.C, self.D, self.sample_time,
            inputs=list(self.inputs), outputs=list(self.outputs), name=self.name,
        )  # fmt: skip

    def to_mat(self, path: str | Path, *, force: bool = False) -> None:
        """Write a MATLAB file with A, B, C, D, Ts, InputName, OutputName, as for controllers."""
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
    """Return the linear system of a model, neck, controller or FMU near t = `at`, after constant inputs.

    It is exact for softneck's own systems with derivatives, else from pulses on a saved state, with an `error`.
    Booleans and inputs that mean "not measured" stay constant, and `validity` is no output. States that are not
    reachable or not observable are left out.

    Args:
        source: file of a model, observer, controller or neck; an FMU of any tool that `FmuPart` runs; a
            preset of a neck; a model, observer or controller; or its block.
        at: [s], a multiple of the sample time.
        values: inputs and parameters that differ from their start values, in SI units.
        sample_time: [s], of an FMU; its default step if not given.

    Raises:
        SettingsError: a moment between samples, an unknown name, an FMU that cannot save its state, or outputs that
            no input moves.
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
            raise SettingsError("`sample_time` is for FMUs; a file of softneck has its own.")
        return _linearize_block(*_open_source(source, at, given))
    with unpacked(Path(source)) as folder:
        has_role = bool(read_description(Path(source), folder, {}).annotation.role)
    with FmuPart(source, role=None if has_role else "plant", sample_time=sample_time) as part:
        block = read_block(Path(source))
        if block is not None and sample_time in (None, block.sample_time):
            return _linearize_block(block, at, given)
        return _linearize_by_pulses(part, part.parameters, at, given, Path(source).stem)


def _open_source(
    source: str | Path | Block | Buildable, at: float, given: Mapping[str, float]
) -> tuple[Block, float, Mapping[str, float]]:
    """Return the block of a softneck object, and the values by the names of its robot."""
    if isinstance(source, str | Path) and Path(source).suffix == ".ssp":
        raise SettingsError(f"{source}: holds several FMUs; unzip it and linearize one of those in `resources`.")
    found = buildable(source)
    if isinstance(found, Block):
        return found, at, given
    robot = getattr(found, "robot", None)
    return found.block(), at, given if robot is None else {robot.own(name): value for name, value in given.items()}


def _linearize_block(block: Block, at: float, given: Mapping[str, float]) -> LinearPoint:
    held, parameters = _split(block.inputs, block.parameters, given, block.kind)
    try:
        tangent = load_tangent(block.runtime, compiled=False)  # one call: compiling takes longer
    except TangentError:
        return _linearize_by_pulses(SavedBlock(block), block.parameters, at, given, block.kind)
    state, count = block.initial_state(**parameters), _samples(at, block.sample_time, block.kind)
    state = block.run(state, np.tile(held, (count, 1)))[0] if count else state
    moved, shown = _pulsed_inputs(block.inputs, held), _linear_outputs(block.outputs)
    n, m = state.values.size, len(moved)
    X, U = np.zeros((n, n + m)), np.zeros((held.size, n + m))
    X[:, :n] = np.eye(n)
    U[moved, n + np.arange(m)] = 1.0
    Y = np.zeros((len(block.outputs), n + m))
    tangent(block.arrays, state.parameters, state.values.copy(), held, np.zeros(len(block.outputs)), X, U, Y, n + m)
    A, B, C, D = X[:, :n], X[:, n:], Y[shown, :n], Y[shown, n:]
    if block.role in ("plant", "reference"):
        # A step returns the outputs of the next sample; as additional states they become those of this sample.
        A, B = np.block([[A, np.zeros((n, len(C)))], [C, np.zeros((len(C), len(C)))]]), np.vstack([B, D])
        C, D = np.hstack([np.zeros((len(C), n)), np.eye(len(C))]), np.zeros((len(C), m))
    A, B, C = remove_unreachable_states(A, B, C)
    inputs, outputs = _names(block.inputs, moved), _names(block.outputs, shown)
    return LinearPoint(A, B, C, D, block.sample_time, at, inputs, outputs, block.kind, "exact")


class SavedBlock(BlockPart):
    """A block with a state that can be saved, like that of an FMU."""

    def get_state(self) -> tuple[Vector, Vector]:
        """Return state and outputs."""
        return self._state.copy(), self._outputs.copy()

    def set_state(self, state: tuple[Vector, Vector]) -> None:
        """Continue from a state of `get_state`."""
        self._state[:], self._outputs[:] = state


def _linearize_by_pulses(
    part: FmuPart | SavedBlock, parameters: tuple[Port, ...], at: float, given: Mapping[str, float], name: str
) -> LinearPoint:
    held, chosen = _split(part.inputs, parameters, given, name)
    part.start(0.0, chosen)
    part.get_state()  # raises before a long run if the state cannot be saved
    count, Ts = _samples(at, part.sample_time, name), part.sample_time
    for k in range(count):
        part.advance(k * Ts, held)
    moved, shown = _pulsed_inputs(part.inputs, held), _linear_outputs(part.outputs)
    sizes = [_size(part.inputs[i]) for i in moved]
    A, B, C, D, error = realize(part, count, held, moved, sizes, shown, name)
    inputs, outputs = _names(part.inputs, moved), _names(part.outputs, shown)
    return LinearPoint(A, B, C, D, Ts, at, inputs, outputs, name, "pulses", error)


def _split(
    inputs: tuple[Port, ...], parameters: tuple[Port, ...], given: Mapping[str, float], name: str
) -> tuple[Vector, dict[str, float]]:
    """Return the constant inputs (inputs,), and the given parameters."""
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
    count = round(at / sample_time) if np.isfinite(at) and 0.0 <= at < _MAX_SAMPLES * sample_time else -1
    if count < 0:
        raise SettingsError(f"at t = {at:g} s: must be between 0 and {_MAX_SAMPLES} samples of {sample_time:g} s.")
    if abs(at / sample_time - count) > _GRID_TOLERANCE * max(count, 1):
        raise SettingsError(
            f"at t = {at:g} s: {name} has a sample each {sample_time:g} s; take {count * sample_time:g} s."
        )
    return count


def _pulsed_inputs(inputs: tuple[Port, ...], held: Vector) -> list[int]:
    return [i for i, port in enumerate(inputs) if not (port.boolean or port.integer) and np.isfinite(held[i])]


def _linear_outputs(outputs: tuple[Port, ...]) -> list[int]:
    return [i for i, port in enumerate(outputs) if not (port.boolean or port.integer) and port.name != "validity"]


def _names(ports: tuple[Port, ...], chosen: list[int]) -> tuple[str, ...]:
    return tuple(ports[i].name for i in chosen)


def _size(port: Port) -> float:
    """Return the typical size of an input, in proportion to which a pulse is small."""
    if port.nominal:
        return abs(port.nominal)
    if port.minimum is not None and port.maximum is not None and 0.0 < port.maximum - port.minimum < 1e6:
        return 0.5 * (port.maximum - port.minimum)
    return 1.0


def realize(
    part: Any, first: int, held: Vector, moved: list[int], sizes: list[float], shown: list[int], name: str
) -> tuple[Matrix, Matrix, Matrix, Matrix, float]:
    """Return A, B, C, D of the lowest order with the pulse responses of `part`, and their relative error.

    `held` (inputs,) are the constant inputs after `first` steps, `moved` and `sizes` the positions and sizes of those
    with pulses, `shown` the positions of the outputs. Raises SettingsError: no inputs or outputs, or no input moves an
    output.
    """
    if not moved or not shown:
        raise SettingsError(f"{name}: has no {'output' if moved else 'input'} that is a number, so no linear system.")
    h, noise = _pulse_responses(part, first, held, moved, sizes, shown)
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
    for order in range(min(_MAX_STATES, int(np.sum(s > noise))) + 1):
        root = np.sqrt(s[:order])
        A = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        B, C = root[:, None] * right[:order, :inputs], left[:outputs, :order] * root
        error = float(np.abs(_markov(A, B, C, h[0]) - h).max()) / scale
        if best is None or error < best[-1]:
            best = (A, B, C, h[0], error)
        if error <= max(_FIT_TOLERANCE, noise / scale):
            break
    return best


def _pulse_responses(
    part: Any, first: int, held: Vector, moved: list[int], sizes: list[float], shown: list[int]
) -> tuple[np.ndarray, float]:
    """Return the responses (SAMPLES, outputs, inputs) to pulses of 1, and their rounding error."""
    late = part.role in ("plant", "reference")
    h = np.zeros((SAMPLES, len(shown), len(moved)))
    noise, state = 0.0, part.get_state()
    for column, (i, size) in enumerate(zip(moved, sizes, strict=True)):
        off = _PULSE_SHARE * size
        sides = []
        for sign in (1.0, -1.0):
            part.set_state(state)
            u = held.copy()
            u[i] += sign * off
            rows = []
            for k in range(SAMPLES - late):
                rows.append(np.array(part.advance((first + k) * part.sample_time, u))[shown])
                u = held
            sides.append(np.array(rows))
        h[int(late) :, :, column] = (sides[0] - sides[1]) / (2.0 * off)
        noise = max(noise, _ROUNDING * float(np.abs(sides[0]).max()) / off)
    return h, noise


def _markov(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> np.ndarray:
    responses, x = [D], B
    for _ in range(SAMPLES - 1):
        responses.append(C @ x)
        x = A @ x
    return np.array(responses)
