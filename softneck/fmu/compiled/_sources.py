"""C sources of the library: written by hand in `c/`, and `sn_kinds.h`, translated from the runtimes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from softneck.runtime import _tangent, bundle

from .translate._kinds import RUNTIMES, ranks_of
from .translate._scope import TranslationError
from .translate._translate import Unit

HERE = Path(__file__).parent
# Floating point exactly as written, on every platform: no fused multiply-add, no errno, no traps.
FLAGS = (
    "-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden",
    "-ffunction-sections", "-fdata-sections",
)  # fmt: skip
MAIN = "softneck.c"
GENERATED = "sn_kinds.h"
PROBE = "sn_probe.h"  # only for zig and Windows


@dataclass(frozen=True, slots=True)
class Sources:
    """Input of a C compiler.

    Attributes:
        files: name -> text, `softneck.c` includes all others.
        refused: runtime module that could not be translated -> the reason.
    """

    files: dict[str, str]
    refused: dict[str, str]


def c_sources(modules: tuple[str, ...] = RUNTIMES, *, sensitivities: bool = False) -> Sources:
    """Translate the runtime `modules` and return the C sources of their library.

    With `sensitivities` the derivatives of the steps are included; kinds without derivative are refused.
    """
    unit, refused = Unit(), {}
    for module in modules:
        try:
            unit.add(module, ranks_of(module), tangent=sensitivities)
        except TranslationError as error:
            refused[module] = str(error)
    files = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "c").glob("*.[ch]"))}
    files[GENERATED] = unit.text()
    return Sources(files, refused)


@cache
def sources_key(modules: tuple[str, ...] = RUNTIMES, *, sensitivities: bool = False) -> str:
    """Return a digest of all inputs of the library: runtimes, translator, sources written by hand, flags.

    Much faster than translating; a library with another digest is out of date.
    """
    texts = [bundle(module, loops=False) for module in modules]
    digest = hashlib.sha256(repr((FLAGS, [ranks_of(module) for module in modules], texts)).encode())
    # Sorted by name, as a wheel has other folders than a checkout; equal names are sorted by content.
    paths = [*HERE.rglob("*.py"), *(HERE / "c").glob("*.[ch]")]
    if sensitivities:
        paths += Path(_tangent.__file__).parent.glob("_tangent*.py")
    for name, content in sorted((path.name.encode(), path.read_bytes()) for path in paths):
        digest.update(name + b"\0" + content)
    return digest.hexdigest()[:32]
