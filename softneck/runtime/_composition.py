"""Several runtimes in one text: each under a prefix, and calls that lead to them by number."""

from __future__ import annotations

import ast

# Set from outside by whoever compiles; one for all (see `_compiled_runtime`).
_SHARED = {"COMPILED"}
_CALLS = {
    "member_size": ("", "state_size", True),
    "member_initialise": (", parameters, state, outputs", "initialise", False),
    "member_step": (", parameters, state, inputs, outputs", "step", False),
}
_ROWS = "state_rows, inputs_rows, outputs_rows, moved"
_TANGENT = {"member_tangent": (f", parameters, state, inputs, outputs, {_ROWS}", "step_tangent", False)}


def prefixed(text: str, prefix: str) -> str:
    """Return a bundle without its imports, with `prefix` before every name that it defines."""
    tree = ast.parse(text)
    body = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
    names = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        names |= {target.id for target in targets if isinstance(target, ast.Name)}
    tree.body = body
    return ast.unparse(_Prefix(names - _SHARED, prefix).visit(tree)) + "\n\n"


def member_calls(counts: list[int], own: int, *, tangents: bool = False) -> str:
    """Return the functions of `_members_runtime` for members that read so many arrays, behind `own` others.

    Args:
        counts: arrays of each member.
        own: arrays before them.
        tangents: the members have a function `step_tangent`.
    """
    lines = ["", "def member_count():", f"    return {len(counts)}", ""]
    for call, (arguments, name, returns) in (_CALLS | (_TANGENT if tangents else {})).items():
        lines += ["", f"def {call}(arrays, member{arguments}):"]
        start = own
        for member, count in enumerate(counts):
            # Constant borders: a compiler knows the type of each array then.
            part = f"arrays[{start}:{start + count}]"
            result = "return " if returns else ""
            lines += [f"    if member == {member}:", f"        {result}m{member}_{name}({part}{arguments})"]
            start += count
        lines += ["    return 0" if returns else "    return None", ""]
    return "\n".join(lines) + "\n"


class _Prefix(ast.NodeTransformer):
    def __init__(self, names: set[str], prefix: str) -> None:
        self._names, self._prefix = names, prefix

    def visit_Name(self, node: ast.Name) -> ast.Name:
        """Rename a use; local variables of the same name follow, all alike."""
        return ast.copy_location(ast.Name(self._new(node.id), node.ctx), node)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """Rename a parameter that is called like a function."""
        node.arg = self._new(node.arg)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        """Rename a function; its docstring is left out."""
        node.name = self._new(node.name)
        if ast.get_docstring(node) is not None and len(node.body) > 1:
            node.body = node.body[1:]
        self.generic_visit(node)
        return node

    def _new(self, name: str) -> str:
        return self._prefix + name if name in self._names else name
