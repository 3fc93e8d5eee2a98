"""`python -m tests.fuzz FORMAT [options of libFuzzer]`: one format under atheris, which looks for new branches.

Atheris is no dependency: `pip install atheris` where it installs. Without it `tests/fuzz/test_fuzz.py` does the work.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Any


def main() -> None:
    from importlib import import_module

    atheris: Any = import_module("atheris")

    with atheris.instrument_imports(include=["softneck"]):
        from softneck.core import SoftneckError

        from .targets import TARGETS
    name = sys.argv.pop(1)
    target, folder = TARGETS[name], Path(tempfile.mkdtemp(prefix="softneck-fuzz-"))
    corpus = folder / "corpus"
    corpus.mkdir()
    for place, write in enumerate(target.seeds):
        write(corpus / f"seed{place}{target.suffix}")

    def one(data: bytes) -> None:
        path = folder / f"a{target.suffix}"
        path.write_bytes(data)
        with contextlib.suppress(SoftneckError):
            target.read(path)

    atheris.Setup([*sys.argv, str(corpus)], one)
    atheris.Fuzz()


main()
