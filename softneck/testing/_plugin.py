"""What pytest loads through the entry point `softneck`; it must cost nothing where no test closes a loop."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from ._closed_loop import ClosedLoop

_MARKERS = (
    "closed_loop(loop_file=None, **settings): what the `closed_loop` fixture runs unless the test says otherwise",
    "limits(metric=limit, ...): upper limits that every loop of the test must hold, such as overshoot_pct=10",
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers."""
    for marker in _MARKERS:
        config.addinivalue_line("markers", marker)


@pytest.fixture
def closed_loop(request: pytest.FixtureRequest) -> ClosedLoop:
    """Run closed loops over FMUs and say what did not hold; see `softneck.testing._closed_loop.ClosedLoop`."""
    from ._closed_loop import ClosedLoop

    file: object = None
    settings: dict[str, object] = {}
    limits: dict[str, float] = {}
    # The closest marker comes first: what stands at the test goes before what stands at its module.
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
