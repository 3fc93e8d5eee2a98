"""The C sources: those written by hand in `c/`, and `sn_kinds.h`, translated from the runtimes."""

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


def c_sources(modules: tuple[str, ...] = RUNTIMES, *, sensitivities: bool = False) -> Sources:
    """Return the C sources of the library, or of one of other runtime `modules`, translated now.

    With `sensitivities` the kinds hold the derivatives of their steps; those that have none are refused.
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
    """Return a digest of all that the library is made of: runtimes, translator, sources written by hand, flags.

    Far faster than translating: it tells whether a library that is there is still the right one.
    """
    texts = [bundle(module, loops=False) for module in modules]
    digest = hashlib.sha256(repr((FLAGS, [ranks_of(module) for module in modules], texts)).encode())
    # By name: a wheel has the packages in other folders than a checkout. By content where a name is there twice.
    paths = [*HERE.rglob("*.py"), *(HERE / "c").glob("*.[ch]")]
    if sensitivities:
        paths += Path(_tangent.__file__).parent.glob("_tangent*.py")
    for name, content in sorted((path.name.encode(), path.read_bytes()) for path in paths):
        digest.update(name + b"\0" + content)
    return digest.hexdigest()[:32]
