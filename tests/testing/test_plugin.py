"""The plugin as users meet it: pytest in a process of its own, on a test of five lines."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from softneck.fmu import build_fmu

_TOYS = str(Path(__file__).parents[1] / "fmu" / "toys")
if _TOYS not in sys.path:
    sys.path.append(_TOYS)  # where the bundler finds the toy runtimes

FIVE_LINES = """
def test_a_step_of_10_deg(closed_loop):
    loop = closed_loop(plant="Neck.fmu", controller="Pi.fmu", pitch_deg=10.0, duration_s=3.0)
    loop.holds(overshoot_pct=10.0, settling_s=1.0)
"""
MARKED = """
import pytest

pytestmark = pytest.mark.closed_loop(plant="Neck.fmu", controller="Pi.fmu", duration_s=3.0)


@pytest.mark.closed_loop(roll_deg=10.0)
@pytest.mark.limits(overshoot_pct=10.0, settling_s=1.0, max_rad=6.0)
def test_roll(closed_loop):
    assert closed_loop().result["roll"].max() > 0.1


@pytest.mark.closed_loop(pitch_deg=10.0)
@pytest.mark.limits({"pitch.rise_s": 0.01})
def test_too_fast(closed_loop):
    closed_loop(plant_parameters={"pitch_start": 0.01})


def test_wrong(closed_loop):
    closed_loop(speed=3)


def test_of_a_file(closed_loop):
    closed_loop("loop.toml")
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import toy_blocks  # pyright: ignore[reportMissingImports]

    folder = tmp_path_factory.mktemp("project")
    build_fmu(toy_blocks.neck(), folder / "Neck.fmu")
    build_fmu(toy_blocks.pi(), folder / "Pi.fmu")
    (folder / "pyproject.toml").write_text("[tool.pytest.ini_options]\naddopts = ['--strict-markers']\n")
    return folder


def run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    installed = any(point.name == "softneck" for point in entry_points(group="pytest11"))
    plugin = [] if installed else ["-p", "softneck.testing._plugin"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *plugin, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_five_lines_are_a_closed_loop_test(project: Path) -> None:
    (project / "test_five.py").write_text(FIVE_LINES)
    done = run_pytest(project, "test_five.py")
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout


@pytest.mark.slow
def test_a_failure_prints_metric_limit_and_value_and_saves_the_plot(project: Path) -> None:
    (project / "loop.toml").write_text("nonsense = 1\n")
    (project / "test_marked.py").write_text(MARKED)
    done = run_pytest(project, "test_marked.py")
    assert done.returncode == 1
    assert "3 failed, 1 passed" in done.stdout
    assert "1 limit(s) do not hold:" in done.stdout
    assert "pitch.rise_s = " in done.stdout
    assert ", limit 0.01" in done.stdout
    plot = project / "build" / "closed_loop" / "test_too_fast.png"
    assert f"plot: {plot}" in done.stdout
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "unknown key `speed` of the file" in done.stdout
    assert "unknown key `nonsense` of the file" in done.stdout


def test_the_plugin_imports_nothing_heavy() -> None:
    heavy = ("numpy", "fmpy", "pandas", "softneck.cosim", "softneck.core")
    code = f"import sys, softneck.testing._plugin; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
