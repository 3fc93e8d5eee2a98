"""Arrays and ports of an identified plant, the same for every kind; checked before compiled code indexes them.

Arrays of member 0 of kind `play` are named `0.play.history` and so on, after the model's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from softneck.core import KINDS, FileFormatError, Matrix, SettingsError, Vector, resolve, to_si
from softneck.robot import Robot
from softneck.runtime import Port, layout_of, load_runtime, sized_name
from softneck.runtime._layout import Arrays, StateVector
from softneck.signals import Recording, conditions, merge_conditions

from ._linear_systems import STATE_SPACE

COMPOSED = ("guarded",)
_MIN_MEMBERS = 2  # a base and one other
# Runtime of `greybox` for recordings with several payloads.
_LOADED_GREYBOX = "softneck.identification.structured._loaded_greybox_runtime"

# The arrays of the output `validity`: older files, models made by hand and members of others have none.
VALIDITY = ("ground", "doubt")
# Files also leave out the offset of a robot that rests at zero, and a body of constant stiffness without creep.
_OPTIONAL = (*VALIDITY, "offset", "body")
# In the order of BODY_*; drives of any speed.
RIGID = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1e4, 0.0, 1.0])


def without_validity(arrays: Mapping[str, Matrix]) -> dict[str, Matrix]:
    """Return the arrays without those of `validity`."""
    return {name: array for name, array in arrays.items() if name.rpartition(".")[2] not in VALIDITY}


def runtime_arrays(kind: str, arrays: Mapping[str, Matrix]) -> dict[str, Matrix]:
    """Return the arrays in the order of the runtime, with defaults for those that a file may leave out."""
    own = own_arrays(arrays)
    history = own["history"]
    outputs = int(history[1]) if len(history) > 1 else 2
    motors = len(own["drive"]) if "drive" in own else int(history[2]) if len(history) > 2 else 3
    empty = {
        "ground": np.zeros((0, 1 + 2 * motors)), "doubt": np.zeros((outputs, 3)), "offset": np.zeros(outputs),
        "body": RIGID,
    }  # fmt: skip
    if "body" in own:  # of an earlier version it lacks the last numbers
        own = {**own, "body": np.append(own["body"], RIGID[own["body"].size :])}
    names = _names(_module_of(kind, arrays))
    found = {name: own[name] if name in own else empty[name] for name in names}
    for number, (member, part) in enumerate(members(arrays)):
        found |= {f"{number}.{member}.{name}": array for name, array in runtime_arrays(member, part).items()}
    return found


def with_validity(kind: str, arrays: Mapping[str, Matrix], ground: Matrix, doubt: Matrix) -> dict[str, Matrix]:
    """Add the arrays of `validity`, in the order of a file."""
    given = {**arrays, "ground": ground, "doubt": doubt}
    inner = {name: array for name, array in arrays.items() if "." in name}
    return {**{name: given[name] for name in _names(_module_of(kind, arrays)) if name in given}, **inner}


@cache
def _names(module: str) -> tuple[str, ...]:
    """Return the names of a runtime's arrays; cached, as every step needs them."""
    return layout_of(module, Arrays).names()


def prefixed_arrays(members: list[tuple[str, Mapping[str, Matrix]]]) -> dict[str, Matrix]:
    """Return the arrays of all members (kind, arrays) under their names in a composed model."""
    for kind, _ in members:
        if kind in COMPOSED:
            raise SettingsError(f"a model of kind `{kind}` has members and cannot be a member; take its members.")
    # The composed model has its own validity.
    return {
        f"{i}.{kind}.{name}": array
        for i, (kind, arrays) in enumerate(members)
        for name, array in without_validity(arrays).items()
    }


def own_arrays(arrays: Mapping[str, Matrix]) -> dict[str, Matrix]:
    """Return the arrays that are no member's."""
    return {name: array for name, array in arrays.items() if "." not in name}


def members(arrays: Mapping[str, Matrix]) -> list[tuple[str, dict[str, Matrix]]]:
    """Return kind and arrays of each member; raise FileFormatError for a wrong order or kind."""
    found: list[tuple[str, dict[str, Matrix]]] = []
    for name, array in arrays.items():
        if "." not in name:
            continue
        number, kind, own = name.split(".", 2)
        if number == str(len(found)) and kind in KINDS and KINDS[kind].role == "model" and kind not in COMPOSED:
            found.append((kind, {}))
        if not found or (number, kind) != (str(len(found) - 1), found[-1][0]):
            raise FileFormatError(
                f"its array `{name}` belongs to no member in order, or to a kind that cannot be a member."
            )
        found[-1][1][own] = array
    return found


def runtime_of(kind: str, arrays: Mapping[str, Matrix]) -> str:
    """Return the runtime's name, with those of its members in brackets (see `softneck.runtime.bundle`)."""
    history, module = arrays["history"], _module_of(kind, arrays)
    if kind not in COMPOSED:
        return sized_name(module, len(arrays["drive"]), int(history[1]) if len(history) > 1 else 2)
    inner = ",".join(
        f"{runtime_of(member, part)}:{len(runtime_arrays(member, part))}" for member, part in members(arrays)
    )
    outer = sized_name(module, int(history[2]), int(history[1])) if len(history) > 2 else module
    return f"{outer}({inner})"


def _module_of(kind: str, arrays: Mapping[str, Matrix]) -> str:
    """Return the module of the runtime; the arrays decide between several forms of one kind."""
    runtime = KINDS[kind].runtime
    if kind == "greybox" and "payload" in arrays:
        return _LOADED_GREYBOX
    return STATE_SPACE if "A" in arrays else runtime


def memory_of(arrays: Mapping[str, Matrix]) -> int:
    """Return the number of samples after which constant inputs and outputs have filled a model's memory."""
    longest = max(float(arrays["history"][0]), float(arrays.get("memory", np.zeros(1))[0]))
    return int(max([longest, *(memory_of(part) for _, part in members(arrays))]))


def set_now(kind: str, arrays: Mapping[str, Matrix], values: Vector, m: Vector, y: Vector) -> None:
    """Write the present motors `m` (3,) and outputs `y` (2,) into a state after a `step`."""
    runtime, arrays = runtime_of(kind, arrays).partition("(")[0], runtime_arrays(kind, arrays)
    named = layout_of(runtime, Arrays)(list(arrays.values()))
    parts = layout_of(runtime, StateVector).parts(named)
    if "motors" in parts:
        values[parts["motors"]], values[parts["angles"]] = m, y
    if "slow" in parts:
        values[parts["slow"]] = m
    at = parts[list(parts)[-1]].start
    for member, part in members(arrays):
        size = load_runtime(runtime_of(member, part)).state_size(tuple(part.values()))
        set_now(member, part, values[at : at + size], m, y)
        at += size


# A minute at 1 ms: far longer than any lag of a neck, and still small in memory.
_MAX_HISTORY_SAMPLES = 60_000


def memory_array(seconds: float, sample_time: float) -> Vector:
    """Return the array `memory`: the samples in so many seconds, up to the limit of a file."""
    return np.array([float(min(np.ceil(seconds / sample_time), _MAX_HISTORY_SAMPLES))])


def check_arrays(kind: str, arrays: Mapping[str, Matrix]) -> None:
    """Raise FileFormatError unless the arrays are finite, in order, and of shapes that fit each other."""
    if kind in COMPOSED:
        _check_composed(kind, arrays)
        return
    names = layout_of(runtime_of(kind, arrays), Arrays).names()
    if not _has_names(arrays, names):
        raise FileFormatError(f"a model of kind {kind} has the arrays {', '.join(names)}; got {', '.join(arrays)}.")
    _check_numbers(kind, runtime_arrays(kind, arrays), runtime_of(kind, arrays))


def _has_names(arrays: Mapping[str, Matrix], names: tuple[str, ...]) -> bool:
    """Return whether the arrays are those of a runtime in its order, apart from optional ones."""
    return tuple(arrays) == tuple(name for name in names if name in arrays or name not in _OPTIONAL)


def _check_composed(kind: str, arrays: Mapping[str, Matrix]) -> None:
    names = layout_of(KINDS[kind].runtime, Arrays).names()
    own, parts = own_arrays(arrays), members(arrays)
    if tuple(arrays)[: len(own)] != tuple(own) or not _has_names(own, names):
        raise FileFormatError(f"a model of kind {kind} starts with the arrays {', '.join(names)}.")
    if len(parts) < _MIN_MEMBERS:
        raise FileFormatError(f"a model of kind {kind} cannot have {len(parts)} members.")
    _check_numbers(kind, runtime_arrays(kind, own), KINDS[kind].runtime)
    for member, part in parts:
        check_arrays(member, part)


def _check_numbers(kind: str, arrays: Mapping[str, Matrix], runtime: str) -> None:
    """Check the arrays against the declaration of their kind and by its own check."""
    for name, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise FileFormatError(f"its array `{name}` is not of finite floats.")
    for name, what in {"history": "its history in samples", "memory": "its memory in samples"}.items():
        if name in arrays:  # before other arrays' lengths are computed from it
            within(arrays[name], 1, _MAX_HISTORY_SAMPLES, what)
    sizes = layout_of(runtime, Arrays).lengths(arrays)
    if "drive" in arrays:
        within(arrays["drive"][:, 1], 0, sizes["H"], "a drive's delay")
    ground, doubt, n = arrays["ground"], arrays["doubt"], 2 * sizes["motors"]
    if ground.shape not in ((0, 1 + n), (n, 1 + n)):
        raise FileFormatError(f"its array `ground` has shape {ground.shape}; ({n}, {1 + n}) is needed, or no rows.")
    if len(doubt) != sizes["outputs"] or (doubt < 0.0).any() or (ground.size and not (doubt[:, 0] > 0.0).all()):
        raise FileFormatError("its array `doubt` must hold three variances of each output, the first positive.")
    if KINDS[kind].check:
        resolve(KINDS[kind].check)(arrays, sizes)


def check_table(table: Matrix, sizes: Mapping[str, int]) -> None:
    """Check a regressor table with rows (source, channel, lag) against the sizes of a model."""
    within(np.array([len(table)]), 1, np.inf, "the number of regressors")
    within(table[:, 0], 0, 3, "a regressor's source")
    within(table[table[:, 0] < 3, 1], 0, sizes["motors"] - 1, "a regressor's channel")
    within(table[table[:, 0] == 3, 1], 0, sizes["outputs"] - 1, "a regressor's output")
    within(table[:, 2], 1, sizes["H"], "a regressor's lag")


def within(values: Matrix, low: float, high: float, what: str) -> None:
    """Raise FileFormatError unless all values are whole numbers from `low` to `high`."""
    if (values != np.round(values)).any() or not ((values >= low) & (values <= high)).all():
        raise FileFormatError(f"{what} is not a whole number from {low:g} to {high:g}.")


#: Largest payload on the platform [kg], as of the virtual neck.
MOST_PAYLOAD = 5.0
# Range of a winch [rad], for models without a recorded training range.
_DEFAULT_RANGE_RAD = 6.0
_RANGE_KEY = "set_points_rad"
_OUTPUT_RANGE_KEY = "outputs_si"
# Of a robot without a limit of its own: so much of the recorded range lies beyond each end of it.
_OUTPUT_MARGIN = 0.5


def _output_port(robot: Robot, name: str, description: str, *, missing: bool = False) -> Port:
    unit, shown = to_si(robot.outputs.unit)[1], robot.outputs.display_unit
    # An empty display unit means the usual one of the unit: degrees.
    display = "" if shown == "deg" else shown
    port = Port(name=name, unit=unit, description=description, missing=missing, display_unit=display)
    if unit != "rad" or missing:
        return port
    port = replace(port, nominal=0.2)
    most = robot.angle_limit
    return replace(port, minimum=-most, maximum=most) if np.isfinite(most) else port


def _motor_port(robot: Robot, name: str, description: str, *, missing: bool = False) -> Port:
    unit, shown = to_si(robot.motors.unit)[1], robot.motors.unit
    nominal, display = 1.0 if unit == "rad" else None, "" if shown == unit else shown
    return Port(name=name, unit=unit, description=description, nominal=nominal, missing=missing, display_unit=display)


def parameter_ports(robot: Robot, arrays: Mapping[str, np.ndarray]) -> tuple[Port, ...]:
    """Return the parameters: start values, `use_measurement`, noise, and the payload where the model depends on it."""
    known, names, unit = payloads(arrays), robot.outputs.names, to_si(robot.outputs.unit)[1]
    measured = "false: simulation; true: from measured outputs and motors (paper, Fig. 3b and 3a)"
    noise = f"Standard deviation of the noise on {' and '.join(names)}"
    ports = [_output_port(robot, f"{name}_start", f"{name[0].upper()}{name[1:]} at the start") for name in names]
    ports += [
        Port(name="use_measurement", description=measured, boolean=True, minimum=0.0, maximum=1.0),
        Port(
            name="noise_std",
            unit=unit,
            description=noise,
            minimum=0.0,
            maximum=0.5 if unit == "rad" else None,
            display_unit=robot.outputs.shown,
        ),
        Port(name="noise_seed", description="Seed of that noise", minimum=0.0, maximum=2147483647.0, integer=True),
    ]
    if known is not None:
        text = "What hangs on the platform; the recordings had {:g} to {:g} kg, beyond which validity is 0".format(
            *known
        )
        ports.append(
            Port(name="payload", unit="kg", description=text, start=known[0], minimum=0.0, maximum=MOST_PAYLOAD)
        )
    return tuple(ports)


def payloads(arrays: Mapping[str, np.ndarray]) -> tuple[float, float] | None:
    """Return the smallest and largest payload [kg] of a model's recordings; None for a single payload."""
    found = [array for name, array in arrays.items() if name.rpartition(".")[2] == "payload"]
    return (float(found[0][0]), float(found[0][1])) if found else None


def trained_set_points(*sources: Recording | Mapping[str, Any]) -> dict[str, Any]:
    """Return the findings on set-points and outputs (SI, with rest) and conditions of recordings or findings."""
    parts = [s.set_points if isinstance(s, Recording) else np.array(_set_point_range(s, 3)) for s in sources]
    known = [s.outputs if isinstance(s, Recording) else _output_range(s) for s in sources]
    outputs = {} if any(rows is None for rows in known) else {_OUTPUT_RANGE_KEY: _range_of(*known)}
    made = [conditions(part) if isinstance(part, Recording) else part.get("conditions", {}) for part in sources]
    return {_RANGE_KEY: _range_of(*parts), **outputs, "conditions": merge_conditions([part for part in made if part])}


def _range_of(*parts: Matrix | None) -> dict[str, list[float]]:
    """Return the smallest and largest values of rows, rest (zero) included."""
    rows = np.vstack([part for part in parts if part is not None])
    rows = np.vstack([np.zeros((1, rows.shape[1])), rows])
    return {"min": np.nanmin(rows, axis=0).tolist(), "max": np.nanmax(rows, axis=0).tolist()}


def _output_range(findings: Mapping[str, Any]) -> Matrix | None:
    """Return the smallest and largest outputs (2, outputs) of the training in SI; None where the findings have none."""
    limits = findings.get(_OUTPUT_RANGE_KEY)
    return None if limits is None else np.array([limits["min"], limits["max"]], dtype=np.float64)


def trained_range(findings: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the smallest and largest training set-points (motors,) in SI; None where the findings have none."""
    limits = findings.get(_RANGE_KEY)
    return None if limits is None else (np.array(limits["min"]), np.array(limits["max"]))


def input_ports(findings: Mapping[str, Any], robot: Robot) -> tuple[Port, ...]:
    """Return the inputs; the set-points have the range of the training."""
    low, high = _set_point_range(findings, len(robot.motors.names))
    pulls = f" ({robot.motors.unit} in the robot's files)"
    if robot.tendon_angles is not None:
        pulls = "; positive: the winch pulls"
    ports = [
        replace(_motor_port(robot, name, f"Set-point of motor {j}{pulls}"), minimum=float(a), maximum=float(b))
        for j, (name, a, b) in enumerate(zip(robot.set_points, low, high, strict=True), start=1)
    ]
    for name in robot.outputs.names:
        ports.append(_output_port(robot, f"{name}_measured", f"Measured {name}; for use_measurement", missing=True))
    for j, name in enumerate(robot.measured_positions, start=1):
        text = f"Measured position of motor {j}; for use_measurement"
        ports.append(_motor_port(robot, name, text, missing=True))
    return tuple(ports)


def _set_point_range(findings: Mapping[str, Any], motors: int) -> tuple[list[float], list[float]]:
    limits = findings.get(_RANGE_KEY, {"min": [-_DEFAULT_RANGE_RAD] * motors, "max": [_DEFAULT_RANGE_RAD] * motors})
    return limits["min"], limits["max"]


#: Kinds with bounds of their outputs, listed after outputs and motors.
BOUNDED = ("nlsm",)


def output_ports(kind: str, robot: Robot, findings: Mapping[str, Any]) -> tuple[Port, ...]:
    """Return the outputs of a kind: outputs, motors, the bounds of set membership, and `validity` last.

    Outputs without a limit of the robot's own have that of the training, and half of its range beyond.
    """
    names, tendons = robot.outputs.names, robot.tendon_angles is not None
    texts = [
        f"{name.capitalize()} of the platform" if tendons else f"Output `{name}` of {robot.name}" for name in names
    ]
    ports = [_output_port(robot, name, text) for name, text in zip(names, texts, strict=True)]
    limits = None if np.isfinite(robot.angle_limit) else _output_range(findings)
    if limits is not None:
        (low, high), margin = limits, _OUTPUT_MARGIN * np.ptp(limits, axis=0)
        ends = zip(ports, (low - margin).tolist(), (high + margin).tolist(), strict=True)
        ports = [replace(port, minimum=least, maximum=most) for port, least, most in ends]
    for j, name in enumerate(robot.motor_positions, start=1):
        ports.append(_motor_port(robot, name, f"Position of motor {j} by the drive model"))
    for name in names if kind in BOUNDED else ():
        for side in ("lower", "upper"):
            text = f"{side.capitalize()} bound of {name} by set membership (Eq. 19, 20)"
            ports.append(_output_port(robot, f"{name}_{side}", text))
    text = "Predicted probability that the error stays within the model's tolerance; 0: not known"
    return (*ports, Port(name="validity", description=text, minimum=0.0, maximum=1.0))
