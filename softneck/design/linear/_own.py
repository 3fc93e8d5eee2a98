"""A controller of one's own, written in Python: one text for loops, verification and FMUs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import ModuleType

from softneck.core import Matrix, SettingsError, require_positive
from softneck.core._shown import Shown
from softneck.robot import Robot
from softneck.runtime import Block, Port, bundle

from ._ports import controller_inputs, controller_outputs


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class OwnController(Shown):
    """A module with `step` as a controller: `softneck.simulate`, `verify` and `build_fmu` take it as any other.

    The module has `state_size(arrays)`, `initialise(arrays, parameters, state, outputs)` and
    `step(arrays, parameters, state, inputs, outputs)`, scalar code over numpy arrays that imports numpy and math only.
    Of a neck the inputs are pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy and
    enabled, and the outputs motor_setpoint_1..3, in SI; those of another robot stand in the same order.

    Attributes:
        step: the module, or its dotted name.
        arrays: what its functions read: gains, matrices.
        parameters: that can be set in a loop or in an FMU, in their order.
        sample_time: [s].
        robot: whose motors it moves.
        order: of the loop that it is made for, "sequential" or "jacobi".
    """

    step: ModuleType | str
    arrays: Sequence[Matrix] = ()
    parameters: Sequence[Port] = ()
    sample_time: float = 0.02
    robot: Robot = field(default_factory=Robot.preset)
    order: str = "sequential"

    def __post_init__(self) -> None:
        require_positive("sample_time", self.sample_time, "s")
        text = bundle(self._name)
        for name in ("state_size", "initialise", "step"):
            if f"def {name}(" not in text:
                raise SettingsError(f"{self._name}: a controller of one's own needs the function `{name}`.")

    @property
    def _name(self) -> str:
        return self.step.__name__ if isinstance(self.step, ModuleType) else str(self.step)

    def block(self) -> Block:
        """Return what is stepped."""
        return Block(
            kind=self._name.rpartition(".")[2], role="controller", runtime=self._name, sample_time=self.sample_time,
            arrays=tuple(self.arrays), inputs=controller_inputs(self.robot), outputs=controller_outputs(self.robot),
            parameters=tuple(self.parameters),
        )  # fmt: skip

    def summary(self) -> str:
        """Return a line on what it is."""
        return f"{self._name}: a controller of one's own, {1e3 * self.sample_time:g} ms"
