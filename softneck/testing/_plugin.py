"""The pytest plugin, loaded through the entry point `softneck`; it is cheap when no test uses the fixture."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from ._closed_loop import ClosedLoop

_MARKER_LINES = (
    "closed_loop(loop_file=None, **settings): defaults of the `closed_loop` fixture",
    "limits(metric=limit, ...): upper limits that every loop of the test must hold, such as overshoot_pct=10",
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers."""
    for marker in _MARKER_LINES:
        config.addinivalue_line("markers", marker)


@pytest.fixture
def closed_loop(request: pytest.FixtureRequest) -> ClosedLoop:
    """Run closed loops over FMUs and check their limits; see `softneck.testing._closed_loop.ClosedLoop`."""
    from ._closed_loop import ClosedLoop

    file: object = None
    settings: dict[str, object] = {}
    limits: dict[str, float] = {}
    # The closest marker comes first: a marker of the test overrides one of its module.
    for marker in reversed(list(request.node.iter_markers("closed_loop"))):
        file = marker.args[0] if marker.args else file
        settings |= marker.kwargs
    for marker in reversed(list(request.node.iter_markers("limits"))):
        for table in marker.args:
            limits |= table
        limits |= marker.kwargs
    name = re.sub(r"[^\w.-]+", "_", request.node.nodeid.partition("::")[2] or request.node.name).strip("_")
    plots = request.config.rootpath / "build" / "closed_loop"
    plot = plots / f"{name}.png"
    return ClosedLoop(folder=request.path.parent, plot=plot, file=file, settings=settings, limits=limits)
