"""The linear predictive controller, in loops, FMUs and files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import FileFormatError, Matrix, Vector, write_archive
from softneck.runtime import Block, Port, State

from ..linear._ports import MAX_MOTOR, controller_inputs, controller_outputs, limit_ports
from . import _mpc_state_runtime as rt
from ._disturbance import MeasuredDisturbance
from ._lti import lti
from ._part import MpcPart
from ._program import MpcInfo, MpcProgram, explain

if TYPE_CHECKING:
    import control


_RUNTIME = "softneck.design.predictive._mpc_runtime"


# Half the digits of a double.
_ILL_CONDITIONED = 1e8
# Of the way that an input of one takes to rest, seen by the end of the horizon.
_SEEN = 0.5


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MpcController:
    """A linear predictive controller of pitch and roll; `MpcSettings.design` makes it.

    Attributes:
        sample_time: [s].
        arrays: what the runtime reads, in the order of `MpcArrays`.
        position_limit, slew_limit, lead_limit, least_position: of each motor [rad], [rad/s], [rad], [rad].
        angle_limit: soft, of pitch and roll [rad], or None.
        minimum_tautness: soft, of each tendon [rad], or None.
        disturbances: that are measured.
        order: of the loop it is for.
        design: JSON values: the settings and what was found.
    """

    sample_time: float
    arrays: tuple[Matrix, ...]
    position_limit: float
    slew_limit: float
    lead_limit: float
    least_position: float
    angle_limit: float | None
    minimum_tautness: float | None
    disturbances: tuple[MeasuredDisturbance, ...]
    order: str
    design: Mapping[str, Any]

    kind = "mpc"

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        ahead = tuple(
            Port(name=f"{axis}_reference_ahead", unit="rad", minimum=-rt.MPC_REFERENCE_LIMIT,
                 maximum=rt.MPC_REFERENCE_LIMIT, description=f"wanted {axis} {self.preview:g} s from now")
            for axis in ("pitch", "roll")
        ) if self.preview > 0.0 else ()  # fmt: skip
        measured = tuple(
            Port(name=item.name, unit=item.unit, description="measured disturbance") for item in self.disturbances
        )
        limits = limit_ports((self.position_limit, self.slew_limit, self.lead_limit, self.least_position, -MAX_MOTOR))[
            :4
        ]
        soft: tuple[Port, ...] = ()
        if self.angle_limit is not None:
            soft += (Port(name="angle_limit", unit="rad", start=self.angle_limit, minimum=0.01, maximum=0.8),)
        if self.minimum_tautness is not None:
            soft += (
                Port(name="minimum_tautness", unit="rad", start=self.minimum_tautness, minimum=-12.0, maximum=6.0),
            )
        return Block(
            kind="mpc",
            role="controller",
            runtime=_RUNTIME,
            sample_time=self.sample_time,
            arrays=self.arrays,
            inputs=(*controller_inputs(), *ahead, *measured),
            outputs=controller_outputs(),
            parameters=(*limits, *soft),
        )

    @property
    def preview(self) -> float:
        """How far ahead the reference is known [s]."""
        return float(rt.MpcArrays(self.arrays).constants[rt.MPC_AHEAD]) * self.sample_time

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters are the limits by name."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the set-points valid now; inputs and outputs as in `block()`."""
        return self.block().step(state, inputs)

    def ss(self) -> control.StateSpace:
        """Return it without limits, from (pitch_reference, roll_reference, pitch, roll) to (theta_i, phi_i)."""
        return lti(self.arrays)

    def to_lti(self) -> control.StateSpace:
        """Return `ss()`: the controller while no limit is active."""
        return self.ss()

    def info(self, state: State) -> MpcInfo:
        """Return what the sample that led to `state` decided: prediction, active limits, iterations."""
        return explain(self.arrays, state.values)

    def program(self) -> MpcProgram:
        """Return the QP outside of the block: as CasADi functions, solved by daqp."""
        return MpcProgram(self.arrays)

    def part(self, *, solver: str = "own") -> MpcPart:
        """Return the controller as a part of a loop that tells `info` after each sample.

        Args:
            solver: "own" for that of the block, "daqp" for daqp.
        """
        return MpcPart(self.block(), solver=solver)

    def review(self) -> list[str]:
        """Return what is wrong or doubtful with this set-up, one line each; empty if nothing is."""
        return _review(self)

    def summary(self) -> str:
        """Return some lines for people."""
        a, d = rt.MpcArrays(self.arrays), self.design
        q = a.constants
        settings = d.get("settings", {})
        lines = [
            f"mpc controller, {self.sample_time * 1e3:g} ms, {self.order} order, {d.get('extra_delay', 0)} samples of "
            "delay added to the plant for it",
            f"  {a.H.shape[0]} unknowns ({int(q[rt.MPC_MOVES])} moves of 3 motors, {int(q[rt.MPC_SLACKS])} "
            f"slacks), {a.kinds.shape[0]} rows, horizon {settings.get('horizon')} samples after the dead time, "
            f"{int(q[rt.MPC_SCENARIOS])} scenario(s)",
            f"  limits: |P| <= {self.position_limit:g} rad, slew {self.slew_limit:g} rad/s, "
            f"lead {self.lead_limit:g} rad"
            + ("" if self.angle_limit is None else f", |angle| <= {np.degrees(self.angle_limit):.3g} deg (soft)")
            + ("" if self.minimum_tautness is None else f", tautness >= {self.minimum_tautness:g} rad (soft)"),
            f"  bandwidth {d.get('bandwidth_rad_s', 0.0):.3g} rad/s, "
            f"observer {d.get('observer_bandwidth_rad_s', 0.0):.3g} rad/s, reference filter "
            f"{d.get('reference_time_s', 0.0):.3g} s; Ms "
            + " and ".join(f"{value:.3g}" for value in d.get("sensitivity", []))
            + " (as identified, small moves)",
        ]
        if d.get("worst_sensitivity") is not None:
            lines.append(f"  Ms at most {d['worst_sensitivity']:.3g} over samples of the family")
        return "\n".join(lines + [f"  review: {line}" for line in self.review()])

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller to one `.npz` file."""
        block = self.block()
        header = {
            "kind": "mpc",
            "sample_time": self.sample_time,
            **{name: getattr(self, name) for name in _LIMITS},
            "disturbances": [asdict(item) for item in self.disturbances],
            "order": self.order,
            "design": dict(self.design),
            "inputs": [port.name for port in block.inputs],
            "outputs": [port.name for port in block.outputs],
            "units": {port.name: port.unit for port in (*block.inputs, *block.outputs)},
        }
        write_archive(path, header, dict(zip(rt.MpcArrays.names(), self.arrays, strict=True)), force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> MpcController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        items = {name: np.ascontiguousarray(arrays[name], dtype=np.float64) for name in rt.MpcArrays.names()}
        if not all(np.isfinite(item).all() for item in items.values()):
            raise FileFormatError("the controller's arrays are not finite; design it again.")
        rt.MpcArrays.lengths(items)
        return cls(
            sample_time=float(header["sample_time"]),
            arrays=tuple(items.values()),
            **{name: None if header[name] is None else float(header[name]) for name in _LIMITS},  # type: ignore[arg-type]
            disturbances=tuple(MeasuredDisturbance(**item) for item in header["disturbances"]),
            order=str(header["order"]),
            design=dict(header["design"]),
        )


_LIMITS = ("position_limit", "slew_limit", "lead_limit", "least_position", "angle_limit", "minimum_tautness")


def _review(controller: MpcController) -> list[str]:
    """Return one line for each finding."""
    c, a = controller, rt.MpcArrays(controller.arrays)
    q = a.constants
    lines = []
    settings = c.design.get("settings", {})
    condition = float(np.linalg.cond(a.H))
    if condition > _ILL_CONDITIONED:
        lines.append(f"the QP is ill-conditioned ({condition:.1g}): bring the weights closer together.")
    horizon = int(settings.get("horizon", 0))
    delay = int(q[rt.MPC_PAST])
    if horizon <= delay:
        lines.append(
            f"the horizon ({horizon} samples) is not longer than the dead time ({delay}); it is counted behind it, but "
            "a plan that short sees no more than it has already caused: take 30."
        )
    lines += _limits(c)
    n = int(q[rt.MPC_ORDER])
    for axis, name in enumerate(("pitch", "roll")):
        A = a.model_A[axis * n : (axis + 1) * n]
        radius = float(np.abs(np.linalg.eigvals(A)).max())
        if 0.0 < radius < 1.0 and 1.0 - radius**horizon < _SEEN:
            lines.append(f"{name}: the horizon ends before half of a move's effect is seen; lengthen it.")
    Ms = max(c.design.get("sensitivity", [1.0]))
    if Ms > 2.0:
        lines.append(f"Ms is {Ms:.2f}: not robust. Ask for less `max_sensitivity`.")
    if c.design.get("spectral_radius", 0.0) >= 1.0:
        lines.append("the loop with the identified plant is not stable without limits; ask for less.")
    return lines


def _limits(c: MpcController) -> list[str]:
    lines = []
    travel = 2.0 * c.position_limit
    if c.slew_limit * c.sample_time > travel:
        lines.append("the slew limit lets a motor cross its range within a sample: it limits nothing.")
    if c.lead_limit < c.slew_limit * c.sample_time:
        lines.append(
            f"lead_limit {c.lead_limit:g} rad is less than one sample's slew "
            f"({c.slew_limit * c.sample_time:g} rad): the slew limit is never reached."
        )
    a = rt.MpcArrays(c.arrays)
    gains = [float(a.rest[axis, 0]) for axis in range(2)]
    if c.angle_limit is not None:
        T_inverse = np.linalg.inv(a.T)
        for axis, name in enumerate(("pitch", "roll")):
            needed = float(np.abs(T_inverse[:, axis]).max()) * c.angle_limit / abs(gains[axis])
            if needed > c.position_limit:
                reach = c.angle_limit * c.position_limit / needed
                lines.append(
                    f"{name}: its limit of {math.degrees(c.angle_limit):.3g} deg is beyond what the motors reach "
                    f"({math.degrees(reach):.3g} deg): it limits nothing."
                )
    if c.minimum_tautness is not None and c.minimum_tautness > 0.0:
        lines.append(
            f"minimum_tautness {c.minimum_tautness:g} rad is above rest: the neck is compressed all the time, and a "
            "co-contraction reference below that is never reached."
        )
    if not np.isfinite(a.K).all():
        lines.append("the arrays are damaged; design it again.")
    return lines
