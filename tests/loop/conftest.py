"""Toy blocks, shared with the tests of FMUs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from softneck.runtime import Block

_TOYS = str(Path(__file__).parents[1] / "fmu" / "toys")
if _TOYS not in sys.path:
    sys.path.append(_TOYS)  # where the bundler finds the toy runtimes


@pytest.fixture
def toy_blocks() -> Callable[[], tuple[Block, Block]]:
    """Return a neck and a PI controller for it."""
    module = import_module("toy_blocks")
    return lambda: (module.neck(), module.pi())
