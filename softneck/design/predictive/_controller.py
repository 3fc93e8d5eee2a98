"""The linear predictive controller in loops, FMUs and files, and the report of one sample."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import FileFormatError, Matrix, ReprMixin, Vector, require_header, to_si, write_archive
from softneck.estimation import AXES
from softneck.loop import BlockPart
from softneck.robot import Robot
from softneck.runtime import Block, Port, State, SteppedMixin, load_functions

from ..linear._controller import assumed_lines, robot_in
from ..linear._ports import MAX_MOTOR, ControllerLimits, controller_inputs, controller_outputs, limit_ports
from ..plants._uncertain import sampling_line
from . import _mpc_state_runtime as rt
from ._arrays import lti
from ._plant import runtime_of, units_of

if TYPE_CHECKING:
    import control

ROW_NAMES = ("slew", "position", "slack", "angle", "angle", "tautness")
STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")
_OF_MOTORS = (rt.MPC_ROW_MOVE, rt.MPC_ROW_POSITION, rt.MPC_ROW_TAUT)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MpcInfo:
    """The result of a sample's QP.

    Attributes:
        status: "optimal", "softened" (a soft limit cannot be kept), "previous plan" (no answer in the budget),
            "holding" (disabled or without measurement) or "not started".
        iterations: rows added and dropped by the solver.
        residual: of the KKT conditions.
        slack: largest violation of a soft limit that is planned, scaled.
        active: names of the active limits.
        set_points: (N, motors) planned motor set-points from the next sample on [rad].
        angles: (N, outputs) pitch and roll that the nominal plant makes of them, each a dead time and a sample later
            [rad].
        reference: (N, outputs) what they are to be then [rad].
        previous_plan, softened: samples so far on which the previous plan went on, and a soft limit was not kept.
    """

    status: str
    iterations: int
    residual: float
    slack: float
    active: tuple[str, ...]
    set_points: Matrix
    angles: Matrix
    reference: Matrix
    previous_plan: int
    softened: int


def explain(arrays: tuple[Matrix, ...], state: Vector, names: tuple[str, ...] = AXES) -> MpcInfo:
    """Return the decision of the sample that led to `state`; `names` are the outputs'."""
    a = rt.MpcArrays(arrays)
    now = {name: state[place] for name, place in rt.MpcState.parts(a).items()}
    functions = load_functions(runtime_of(arrays))
    age = int(now["age"].item())
    motors = a.T.shape[1]
    moves = np.zeros((int(a.constants[rt.MPC_ROWS] - a.constants[rt.MPC_PAST]), motors))
    for i, start in enumerate(a.starts.astype(int)):
        if start > age:
            moves[start - age - 1] = now["plan"][motors * i : motors * i + motors]
    theta = np.zeros(a.K.shape[1])
    functions.mpc_parameter(arrays, state, theta)
    # The state stands one sample on: what is held now was the plan's first move.
    set_points = now["held"] + np.cumsum(moves, axis=0)
    angles, reference = _predict_outputs(a, theta, set_points)
    active = tuple(
        f"{ROW_NAMES[int(kind)]} {('upper', 'lower')[int(sign < 0)]} "
        + (("motor " + str(int(which) + 1)) if kind in _OF_MOTORS else names[int(which)])
        for (kind, which), sign in zip(a.kinds, now["active"], strict=True)
        if sign != 0.0 and kind != rt.MPC_ROW_SLACK
    )
    unit, outputs, _ = units_of(arrays)
    return MpcInfo(
        status=STATUS_NAMES[int(now["status"].item())],
        iterations=int(now["iterations"].item()),
        residual=now["residual"].item(),
        slack=now["slack"].item(),
        active=active,
        set_points=unit * set_points,
        angles=outputs * angles,
        reference=outputs * reference,
        previous_plan=int(now["shifted"].item()),
        softened=int(now["softened"].item()),
    )


def _predict_outputs(a: rt.MpcArrays, theta: Vector, set_points: Matrix) -> tuple[Matrix, Matrix]:
    """Return predicted angles and references (N, outputs) of the nominal plant from theta on."""
    n, N, m = a.model_A.shape[1], set_points.shape[0], a.T.shape[0] - 1
    coupled = a.model_B.shape[1] > n
    now = {name: theta[place] for name, place in rt.MpcTheta.parts(a).items()}
    inputs = set_points @ a.T.T
    angles, reference = np.zeros((N, m)), np.zeros((N, m))
    for axis in range(m):
        A, B = a.model_A[axis * n : (axis + 1) * n], a.model_B[axis].reshape(-1, n).T
        v = inputs[:, :m] if coupled else inputs[:, axis : axis + 1]
        pole, delay = a.observer[axis, 2], int(a.delays[axis])
        level, rate = now["offsets"].reshape(-1, 2)[axis]
        x = now["models"].reshape(-1, n)[axis]
        reference[:, axis] = now["wanted"].reshape(m, -1)[axis, delay : delay + N]
        for i in range(N):
            x = A @ x + B @ v[i]
            angles[i, axis] = x[0] + level + rate * (1.0 - pole ** (delay + 1 + i)) / (1.0 - pole)
    return angles, reference


class PredictivePart(BlockPart):
    """A predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample.

    Attributes:
        took: how long the last sample took [s]; NaN before the first.
    """

    def __init__(self, controller: Any) -> None:
        """Adapt a controller."""
        super().__init__(controller.block())
        self._controller, self.took = controller, math.nan

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self.took = math.nan
        return super().start(time, parameters)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs)
        self.took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> Any:
        """The decision of the last sample."""
        return self._controller.explain(self._state)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class MpcController(SteppedMixin, ReprMixin):
    """A linear predictive controller of all outputs; `MpcSettings.design` makes it.

    Attributes:
        sample_time: [s].
        arrays: what the runtime reads, in the order of `MpcArrays`.
        position_limit, slew_limit, lead_limit, least_position: of each motor [rad], [rad/s], [rad], [rad].
        angle_limit: soft, of pitch and roll [rad], or None.
        minimum_tautness: soft, of each tendon [rad], or None.
        order: of the loop it is for.
        design: JSON values: the settings and what was found.
        robot: whose controller it is; all limits are in SI.
    """

    sample_time: float
    arrays: tuple[Matrix, ...]
    position_limit: float
    slew_limit: float
    lead_limit: float
    least_position: float
    angle_limit: float | None
    minimum_tautness: float | None
    order: str
    design: Mapping[str, Any]
    robot: Robot = field(default_factory=Robot.preset)

    kind = "mpc"

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        ahead = tuple(
            replace(port, name=f"{port.name}_ahead", description=f"{port.description} {self.preview:g} s from now")
            for port in controller_inputs(self.robot)[: len(self.robot.outputs.names)]
        ) if self.preview > 0.0 else ()  # fmt: skip
        told = rt.MpcArrays(self.arrays).constants[rt.MPC_PAYLOAD] > 0.0
        measured = (Port(name="payload", unit="kg", description="measured disturbance"),) if told else ()
        starts = (self.position_limit, self.slew_limit, self.lead_limit, self.least_position, -MAX_MOTOR)
        limits, robot = limit_ports(starts, self.robot)[:4], self.robot
        soft = tuple(
            Port(name=name, unit=to_si(unit)[1], start=start, minimum=least)
            for name, unit, start, least in (
                ("angle_limit", robot.outputs.unit, self.angle_limit, 0.0),
                ("minimum_tautness", robot.motors.unit, self.minimum_tautness, None),
            )
            if start is not None
        )
        return Block(
            kind="mpc",
            role="controller",
            runtime=runtime_of(self.arrays),
            sample_time=self.sample_time,
            arrays=self.arrays,
            inputs=(*controller_inputs(self.robot), *ahead, *measured),
            outputs=controller_outputs(self.robot),
            parameters=(*limits, *soft),
        )

    @property
    def preview(self) -> float:
        """How far ahead the reference is known [s]."""
        return float(rt.MpcArrays(self.arrays).constants[rt.MPC_AHEAD]) * self.sample_time

    def ss(self) -> control.StateSpace:
        """Return it without limits, from (pitch_reference, roll_reference, pitch, roll) to (theta_i, phi_i)."""
        return lti(self.arrays, self.robot)

    def to_lti(self) -> control.StateSpace:
        """Return `ss()`: the controller while no limit is active."""
        return self.ss()

    def info(self, state: State) -> MpcInfo:
        """Return the decision of the sample that led to `state`: prediction, active limits, iterations."""
        return self.explain(state.values)

    def explain(self, values: Vector) -> MpcInfo:
        """Return the same of a state's values."""
        return explain(self.arrays, values, self.robot.outputs.names)

    def part(self) -> PredictivePart:
        """Return the controller as a part of a loop that tells `info` after each sample."""
        return PredictivePart(self)

    def review(self) -> list[str]:
        """Return one line on each doubtful setting; empty if there is none."""
        return _review(self)

    def summary(self) -> str:
        """Return some lines for people."""
        a, d = rt.MpcArrays(self.arrays), self.design
        q = a.constants
        settings = d.get("settings", {})
        lines = [
            f"mpc controller, {self.sample_time * 1e3:g} ms, {self.order} order, {d.get('extra_delay', 0)} samples of "
            "delay added to the plant for it",
            f"  {a.H.shape[0]} unknowns ({int(q[rt.MPC_MOVES])} moves of {a.T.shape[1]} motors, "
            f"{int(q[rt.MPC_SLACKS])} slacks), {a.kinds.shape[0]} rows, "
            f"horizon {settings.get('horizon')} samples after the dead time",
            self._limits_line(),
            f"  bandwidth {d.get('bandwidth_rad_s', 0.0):.3g} rad/s, "
            f"observer {d.get('observer_bandwidth_rad_s', 0.0):.3g} rad/s, reference filter "
            f"{d.get('reference_time_s', 0.0):.3g} s; Ms "
            + " and ".join(f"{value:.3g}" for value in d.get("sensitivity", []))
            + f" (nominal model only{', small moves' * (len(d.get('sensitivity', [])) > 1)})",
        ]
        lines += _observer_line(settings)
        if d.get("worst_sensitivity") is not None:
            lines.append(f"  Ms at most {d['worst_sensitivity']:.3g} over samples of the family")
        lines += [*sampling_line(d), *assumed_lines(d.get("assumed", {}))]
        return "\n".join(lines + [f"  review: {line}" for line in self.review()])

    def _limits_line(self) -> str:
        """Return a line on the limits, in the units of the robot's file."""
        given = {name: getattr(self, name) for name in _LIMIT_NAMES[:4]}
        line = ControllerLimits(robot=self.robot, **given).lines(self.sample_time)[0]
        outputs, motors = self.robot.outputs.display_unit, self.robot.motors.unit
        if self.angle_limit is not None:
            line += f", |angle| <= {self.angle_limit / to_si(outputs)[0]:.3g} {outputs} (soft)"
        if self.minimum_tautness is not None:
            line += f", tautness >= {self.minimum_tautness / to_si(motors)[0]:g} {motors} (soft)"
        return line

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller to one `.npz` file."""
        header = {
            **self.block().in_header(),
            **{name: getattr(self, name) for name in _LIMIT_NAMES},
            "order": self.order,
            "design": dict(self.design),
            **self.robot.in_header(),
        }
        write_archive(path, header, dict(zip(rt.MpcArrays.names(), self.arrays, strict=True)), force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> MpcController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        require_header(header, {"design": _DESIGN})
        items = {name: np.ascontiguousarray(arrays[name], dtype=np.float64) for name in rt.MpcArrays.names()}
        if not all(np.isfinite(item).all() for item in items.values()):
            raise FileFormatError("the controller's arrays are not finite; design it again.")
        if gone := _removed_option(items):
            raise FileFormatError(
                f"{gone} of `mpc` went after softneck 0.2.0, which still reads the file; design it again."
            )
        found = rt.MpcArrays.lengths(items)
        if found["entries"] not in (found["n"], found["n"] * found["outputs"]):
            raise FileFormatError("its array `model_B` is of other inputs; design the controller again.")
        return cls(
            sample_time=float(header["sample_time"]),
            arrays=tuple(items.values()),
            **{name: None if header[name] is None else float(header[name]) for name in _LIMIT_NAMES},  # type: ignore[arg-type]
            order=str(header["order"]),
            design=dict(header["design"]),
            robot=robot_in(header),
        )


# Types of `design` in a header, as far as a summary reads it.
_DESIGN = {
    "extra_delay": int, "bandwidth_rad_s": float, "observer_bandwidth_rad_s": float, "reference_time_s": float,
    "sensitivity": [float], "worst_sensitivity": (float, None), "spectral_radius": float, "assumed": {str: float},
    "held_s": (float, None),
    "settings": {"look_ahead": float, "payload_tautness": float, "sample_time": (float, None)},
}  # fmt: skip


def _removed_option(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the unsupported part of a file of an earlier version; "" if there is none."""
    q, m = arrays["constants"].ravel(), arrays["T"].shape[0] - 1
    known = arrays["disturbances"]
    if q.size < rt.MPC_NUMBERS or known.ndim != 2 or known.shape[1] <= m:
        return ""  # damaged, which its lengths say
    if q[2] != 1.0:
        return "scenarios"
    if q[15] != 0.0 or q[16] != 0.0:
        return "tightened limits"
    return "measured disturbances" if known[:, :m].any() or q[rt.MPC_PAYLOAD] != float(known.shape[1] > m + 1) else ""


def _observer_line(settings: Mapping[str, Any]) -> list[str]:
    """Return a line on the observer that it is made for, none where it is one that does not look ahead."""
    ahead, taut = (float(settings.get(name, 0.0)) for name in ("look_ahead", "payload_tautness"))
    told = [f"looks {1e3 * ahead:g} ms ahead"] * (ahead > 0.0)
    told += [f"tells the payload, for which tendons are tauter by {taut:g} rad/kg"] * (taut > 0.0)
    return [f"  for an observer that {' and '.join(told)}"] if told else []


_LIMIT_NAMES = ("position_limit", "slew_limit", "lead_limit", "least_position", "angle_limit", "minimum_tautness")


def _review(controller: MpcController) -> list[str]:
    """Return one line for each finding."""
    c, lines = controller, _limits(controller)
    Ms = max(c.design.get("sensitivity", [1.0]), default=1.0)
    if Ms > 2.0:
        lines.append(f"Ms is {Ms:.2f}: not robust. Ask for less `max_sensitivity`.")
    if c.design.get("spectral_radius", 0.0) >= 1.0:
        lines.append("the loop with the identified plant is not stable without limits; ask for less.")
    return lines


def _limits(c: MpcController) -> list[str]:
    lines = []
    if c.lead_limit < c.slew_limit * c.sample_time:
        per = to_si(c.robot.motors.unit)[0]
        lines.append(
            f"lead_limit {c.lead_limit / per:g} {c.robot.motors.unit} is less than one sample's slew "
            f"({c.slew_limit * c.sample_time / per:g} {c.robot.motors.unit}): the slew limit is never reached."
        )
    a, (unit, outputs, _) = rt.MpcArrays(c.arrays), units_of(c.arrays)
    n = a.model_A.shape[1]
    for axis, name in enumerate(c.robot.outputs.names if c.angle_limit is not None else ()):
        gain = abs(float(a.rest[axis, axis * n if a.rest.shape[1] > n else 0])) * outputs[axis] / unit
        reach = gain * c.position_limit / float(np.abs(np.linalg.pinv(a.T)[:, axis]).max())
        if c.angle_limit is not None and c.angle_limit > reach:
            lines.append(
                f"{name}: its limit of {math.degrees(c.angle_limit):.3g} deg is beyond what the motors reach "
                f"({math.degrees(reach):.3g} deg): it limits nothing."
            )
    if c.minimum_tautness is not None and c.minimum_tautness > 0.0:
        per = to_si(c.robot.motors.unit)[0]
        lines.append(
            f"minimum_tautness {c.minimum_tautness / per:g} {c.robot.motors.unit} is above rest: {c.robot.name} is "
            "compressed all the time, and a co-contraction reference below that is never reached."
        )
    return lines
