"""One module out of a kind's runtime and the slave, under a name that its content decides."""

from __future__ import annotations

import ast
from pathlib import Path

from softneck.core import SettingsError, bundle, content_name

# Stated in the FMU and checked before anything else: old hosts must get past the syntax of this part.
MINIMUM_PYTHON = (3, 11)
_CHECK = f'''"""A softneck FMU: generated, do not edit."""
import sys


def _fmu_refuse(text):
    text = "softneck FMU: " + text
    if sys.stderr is not None:
        sys.stderr.write(text + "\\n")
        sys.stderr.flush()
    raise ImportError(text)


if sys.version_info < {MINIMUM_PYTHON}:
    _fmu_refuse("it needs Python {".".join(map(str, MINIMUM_PYTHON))} or newer; this host runs " + sys.version.split()[0] + ".")
try:
    import numpy
except ImportError:
    _fmu_refuse("it needs numpy in the Python of this host (" + sys.executable + "); install it there.")
'''  # noqa: E501
_SLAVE = Path(__file__).with_name("_slave.py")


def slave_module(runtime: str) -> tuple[str, str]:
    """Return (module name, source text) of the FMU of runtime module `runtime`.

    Raises:
        SettingsError: the runtime defines a name that the slave uses.
    """
    text = bundle(runtime)
    slave = _SLAVE.read_text(encoding="utf-8")
    clash = _names(text) & (_names(slave) - {"initialise", "state_size", "step"})
    if clash:
        raise SettingsError(f"runtime module {runtime} defines {', '.join(sorted(clash))}; the FMU's slave does too.")
    source = "\n".join([_CHECK, text, _without_own_imports(slave)])
    return content_name(source), source


def _without_own_imports(source: str) -> str:
    lines = source.splitlines()
    for node in ast.parse(source).body:
        own = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("softneck.")
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if own or docstring:
            for number in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                lines[number - 1] = ""
    return "\n".join(lines).strip("\n") + "\n"


def _names(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        for target in node.targets if isinstance(node, ast.Assign) else []:
            names.update({target.id} if isinstance(target, ast.Name) else set())
    return names
