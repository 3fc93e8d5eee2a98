"""`step_tangent`: the derivative of a runtime's step, written from the same text that is compiled and translated to C.

    step_tangent(arrays, parameters, state, inputs, outputs, state_rows, inputs_rows, outputs_rows, moved)

advances `state` and `outputs` as `step` does, to the bit, and moves `state_rows` (n_state, m) on and fills
`outputs_rows` (n_out, m) along the first `moved` of m directions; `inputs_rows` (n_in, m) holds what the inputs are
moved by. Numbers are differentiated in rows, one for each direction (forward); functions that make one number out of
loops or arrays in reverse, so that a network costs one more sweep and not one for each direction.

At a kink the derivative to the right counts: `max` and `min` of equal numbers are those of a first one that grows a
little, so is `abs` of zero, and so is a length of zero by its first part. A play operator on its edge thus moves with a
growing input and stays with a falling one, whatever the direction: the derivative stays linear. An `if` follows the
branch that the step takes. Whole numbers, tests and draws of random numbers are moved by nothing.

Where the members of a runtime are not in the text (in C each stands for itself), `member_tangent` is what derives them.
"""

from __future__ import annotations

from functools import cache

from ._tangent_activity import MEMBER_STEP, Pattern, Program, TangentError
from ._tangent_back import Back, worth_it
from ._tangent_rows import Rows

_SHIFTED = """
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

_PRODUCT = """
def tangent_product(matrix, rows, start, moved):
    made = np.zeros((matrix.shape[0], moved))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            for r in range(moved):
                made[i, r] += matrix[i, j] * rows[start + j, r]
    return made
"""

_MEMBER = """
def member_tangent(
    arrays, member, parameters, state, inputs, outputs, state_rows, inputs_rows, outputs_rows, moved
):
    raise NotImplementedError
"""
_MOVED_MEMBER = (("state", 1), ("inputs", 1), ("outputs", 1))


@cache
def with_tangent(text: str) -> str:
    """Return the bundle `text` with `step_tangent` and the functions it needs.

    Raises:
        TangentError: the step has no derivative, or the text uses what is not known here.
    """
    derivation = _Derivation(Program(text))
    derivation.rows_of_step()
    members = [_MEMBER] if derivation.calls_members else []
    return "\n\n".join([text, _SHIFTED, _PRODUCT, *members, *derivation.texts])


class _Derivation:
    """The derived functions of one text: each once for each set of arguments that move."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self.texts: list[str] = []
        self.calls_members = False
        self._rows: dict[tuple[str, Pattern], str] = {}
        self._back: dict[tuple[str, Pattern], str | None] = {}

    def rows_of_step(self) -> None:
        """Derive the step: state, inputs and outputs move, arrays and parameters do not."""
        arguments = [argument.arg for argument in self._program.functions["step"].args.args]
        self.rows("step", tuple((name, 1) for name in arguments[2:]))

    def rows(self, name: str, pattern: Pattern) -> str:
        """Return the name of a function's derivative in rows."""
        activity = self._program.activity(name, pattern)
        key = (name, tuple(activity.written.items()))
        if name == MEMBER_STEP and self._program.has_members:
            if key[1] != _MOVED_MEMBER:
                raise TangentError("a member's state, inputs and outputs move, and nothing else of it.")
            self.calls_members = True
            return "member_tangent"
        if key not in self._rows:
            self._rows[key] = self._unique(f"{name}_tangent")
            self.texts.append(Rows(activity, self).text(self._rows[key]))
        return self._rows[key]

    def back(self, name: str, pattern: Pattern) -> str | None:
        """Return the name of a function's derivative in reverse; None where rows do better."""
        key = (name, pattern)
        if key not in self._back:
            self._back[key] = None
            activity = self._program.activity(name, pattern)
            if worth_it(activity, pattern):
                made = self._unique(f"{name}_back")
                try:
                    self.texts.append(Back(activity, self).text(made))
                    self._back[key] = made
                except TangentError:  # rows can do all that reverse cannot
                    self._back[key] = None
        return self._back[key]

    def _unique(self, name: str) -> str:
        taken = {*self._program.functions, *self._rows.values(), *self._back.values()}
        number, made = 2, name
        while made in taken:
            made, number = f"{name}_{number}", number + 1
        return made
