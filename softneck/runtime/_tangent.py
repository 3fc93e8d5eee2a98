"""`step_tangent`: the derivative of a runtime's step, generated from the text that is compiled and translated to C.

    step_tangent(arrays, parameters, state, inputs, outputs, state_rows, inputs_rows, outputs_rows, moved)

advances `state` and `outputs` as `step` does, to the bit. It also advances the tangents `state_rows` (n_state, m) and
fills the tangents `outputs_rows` (n_out, m), along the first `moved` of m directions; `inputs_rows` (n_in, m) are the
tangents of the inputs. Scalars are differentiated in forward mode, with a row of tangents, one for each direction.
Functions that reduce loops or arrays to one number are differentiated in reverse mode, so that a network costs one more
sweep and not one for each direction.

At a kink the derivative to the right is used: `max` and `min` of equal numbers are differentiated as if the first were
    slightly larger, so is `abs` of zero, and a length of zero by its first component. A play operator on its edge thus
    moves
with a growing input and stays with a falling one, for every direction: the derivative stays linear. An `if` follows the
branch that the step takes. Whole numbers, tests and random numbers have no derivative.

If the members of a runtime are not in the text (in C each has its own function), `member_tangent` is their derivative.
"""

from __future__ import annotations

from functools import cache

from ._tangent_activity import MEMBER_STEP, Pattern, Program, TangentError
from ._tangent_back import Back, is_reverse_better
from ._tangent_rows import Rows

_SHIFT_SOURCE = """
def tangent_shifted(rows, to, start, count, moved):
    if to > start:
        for i in range(count - 1, -1, -1):
            for r in range(moved):
                rows[to + i, r] = rows[start + i, r]
    else:
        for i in range(count):
            for r in range(moved):
                rows[to + i, r] = rows[start + i, r]
"""

_PRODUCT_SOURCE = """
def tangent_product(matrix, rows, start, moved):
    made = np.zeros((matrix.shape[0], moved))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            for r in range(moved):
                made[i, r] += matrix[i, j] * rows[start + j, r]
    return made
"""

_MEMBER_SOURCE = """
def member_tangent(
    arrays, member, parameters, state, inputs, outputs, state_rows, inputs_rows, outputs_rows, moved
):
    raise NotImplementedError
"""
_ACTIVE_ARGUMENTS = (("state", 1), ("inputs", 1), ("outputs", 1))


@cache
def with_tangent(text: str) -> str:
    """Return the bundle `text` with `step_tangent` and the functions it needs.

    Raises TangentError: the step has no derivative, or the text has a construct without a rule.
    """
    derivation = _Derivation(Program(text))
    derivation.rows_of_step()
    members = [_MEMBER_SOURCE] if derivation.calls_members else []
    return "\n\n".join([text, _SHIFT_SOURCE, _PRODUCT_SOURCE, *members, *derivation.texts])


class _Derivation:
    """The derived functions of one text, one for each function and set of active arguments."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self.texts: list[str] = []
        self.calls_members = False
        self._rows: dict[tuple[str, Pattern], str] = {}
        self._back: dict[tuple[str, Pattern], str | None] = {}

    def rows_of_step(self) -> None:
        """Derive the step: state, inputs and outputs are active, arrays and parameters are not."""
        arguments = [argument.arg for argument in self._program.functions["step"].args.args]
        self.rows("step", tuple((name, 1) for name in arguments[2:]))

    def rows(self, name: str, pattern: Pattern) -> str:
        """Return the name of a function's forward derivative."""
        activity = self._program.activity(name, pattern)
        key = (name, tuple(activity.written.items()))
        if name == MEMBER_STEP and self._program.has_members:
            if key[1] != _ACTIVE_ARGUMENTS:
                raise TangentError("a member's state, inputs and outputs move, and nothing else of it.")
            self.calls_members = True
            return "member_tangent"
        if key not in self._rows:
            self._rows[key] = self._unique(f"{name}_tangent")
            self.texts.append(Rows(activity, self).text(self._rows[key]))
        return self._rows[key]

    def back(self, name: str, pattern: Pattern) -> str | None:
        """Return the name of a function's reverse derivative; None if forward mode is better."""
        key = (name, pattern)
        if key not in self._back:
            self._back[key] = None
            activity = self._program.activity(name, pattern)
            if is_reverse_better(activity, pattern):
                made = self._unique(f"{name}_back")
                try:
                    self.texts.append(Back(activity, self).text(made))
                    self._back[key] = made
                except TangentError:  # forward mode covers what reverse mode does not
                    self._back[key] = None
        return self._back[key]

    def _unique(self, name: str) -> str:
        taken = {*self._program.functions, *self._rows.values(), *self._back.values()}
        number, made = 2, name
        while made in taken:
            made, number = f"{name}_{number}", number + 1
        return made
