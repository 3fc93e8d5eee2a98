"""One module of a kind's runtime and the slave, named by a hash of its content, and a script that loads it.

pythonfmu's binary compiles and runs the slave's script again for every instance and never releases its names. The
script is therefore short and imports the module, which Python keeps in `sys.modules`.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import SettingsError
from softneck.runtime import COMPILE_OPTIONS, _numba_cache, bundle, compiled_name, content_name

from ..describe._describe import MINIMUM_PYTHON
from ._slave_compiled import _FMU_BORDER

# Written to the FMU and checked first; its syntax must be valid for old versions of Python.
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
# The binary (pythonfmu 0.7) releases, for every instance, a reference to the script's names that it never acquired.
_SCRIPT_TEMPLATE = """import ctypes

from {name} import SoftneckSlave

ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))
"""
_SLAVE_FILES = ("_slave_compiled.py", "_slave_exit.py", "_slave.py")


@dataclass(frozen=True, slots=True)
class SlaveModule:
    """The Python code of an FMU.

    `name`, `source`: of the module with runtime and slave. `script_name`, `script`: of the script that pythonfmu's
    binary loads for each instance. `runtime`: name under which softneck and the FMUs cache the compiled runtime.
    `options`: of numba, to compile it.
    """

    name: str
    source: str
    script_name: str
    script: str
    runtime: str
    options: dict[str, Any]


def slave_module(runtime: str) -> SlaveModule:
    """Return the module of the FMU of runtime module `runtime`.

    Raises SettingsError: the runtime defines a name that the slave uses.
    """
    text = bundle(runtime)
    files = [Path(_numba_cache.__file__), *(Path(__file__).with_name(name) for name in _SLAVE_FILES)]
    parts = [file.read_text(encoding="utf-8") for file in files]
    clash = _names(text) & set[str]().union(*map(_names, parts))
    if clash:
        raise SettingsError(f"runtime module {runtime} defines {', '.join(sorted(clash))}; the FMU's slave does too.")
    source = _FMU_BORDER + text + _FMU_BORDER + "\n".join(map(_without_own_imports, parts))
    name = content_name(source)
    script = f"{_CHECK}{_SCRIPT_TEMPLATE.format(name=name)}"
    return SlaveModule(name, source, content_name(script, "softneck_fmu"), script, compiled_name(text), COMPILE_OPTIONS)


def _without_own_imports(source: str) -> str:
    lines = source.splitlines()
    for node in ast.parse(source).body:
        own = isinstance(node, ast.ImportFrom) and (node.level > 0 or (node.module or "").startswith("softneck."))
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
