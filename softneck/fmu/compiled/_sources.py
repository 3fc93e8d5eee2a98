"""The C sources: those written by hand in `c/`, and `sn_kinds.h`, translated from the runtimes."""

from __future__ import annotations

import ast
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from .translate._kinds import RANKS
from .translate._translate import Unit
from .translate._types import TranslationError

HERE = Path(__file__).parent
# Floating point as it stands there, on every platform: no fused multiply-add, no errno, no traps.
FLAGS = (
    "-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden",
    "-ffunction-sections", "-fdata-sections",
)  # fmt: skip
MAIN = "softneck.c"
GENERATED = "sn_kinds.h"
PROBE = "sn_probe.h"  # for zig and Windows alone


@dataclass(frozen=True, slots=True)
class Sources:
    """Everything that a C compiler needs.

    Attributes:
        files: name -> text, `softneck.c` includes all others.
        refused: runtime module -> why it is not in there.
    """

    files: dict[str, str]
    refused: dict[str, str]


def c_sources() -> Sources:
    """Return the C sources of the library, translated now."""
    unit, refused = Unit(), {}
    for module, ranks in RANKS.items():
        if find_spec(module.rpartition(".")[0]) is None or find_spec(module) is None:
            refused[module] = "this softneck does not have it"
            continue
        try:
            unit.add(module, ranks)
        except TranslationError as error:
            refused[module] = str(error)
    files = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "c").glob("*.[ch]"))}
    files[GENERATED] = unit.text()
    return Sources(files, refused)


@cache
def sources_key() -> str:
    """Return a digest of all that the library is made of: runtimes, translator, sources written by hand, flags.

    Far faster than translating: it tells whether a library that is there is still the right one.
    """
    digest = hashlib.sha256(repr((FLAGS, sorted(RANKS.items()))).encode())
    # By name: a wheel has the packages in other folders than a checkout.
    files = {*HERE.rglob("*.py"), *(HERE / "c").glob("*.[ch]"), *_runtime_files()}
    for path in sorted(files, key=lambda path: path.name):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:32]


def _runtime_files() -> set[Path]:
    """Return the files of all runtimes in the table, with the runtime modules that they import."""
    found: set[Path] = set()
    waiting = list(RANKS)
    while waiting:
        path = _file_of(waiting.pop())
        if path is None or path in found:
            continue
        found.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.endswith("_runtime"):
                waiting.append(node.module)
    return found


def _file_of(module: str) -> Path | None:
    try:
        spec = find_spec(module)
    except ModuleNotFoundError:
        return None
    return None if spec is None or spec.origin is None else Path(spec.origin)
