"""A controller's FMU where a foreign simulator connects references and angles alone: no motor positions, no flags."""

from __future__ import annotations

import json
import math
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import KINDS, Matrix, load, read_archive
from softneck.design import NmpcSettings
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.fmu.describe._description import with_modelled_drives
from softneck.identification import Play
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block, load_runtime
from softneck.signals import signal

from ..data import ROOT, slow_but
from ..oracles.small_blocks import GOLDEN_ROWS
from ..oracles.small_blocks import inputs_of as golden_inputs
from .every_kind import MOTORS, TS, block_of, plain_run

pytestmark = [
    pytest.mark.skipif(
        shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
    ),
    pytest.mark.usefixtures("plain_steps_of_blocks"),
]
# All that run as C; nonlinear predictive control is added below.
CONTROLLERS = ("pi", "pid", "fopi", "hinf", "lqg", "custom", "adaptive", "mpc")
POSITIONS = [f"motor_position_{j}" for j in (1, 2, 3)]
STEP = math.radians(15.0)
GOLDEN = ROOT / "tests" / "golden"
FILES = [
    path.stem for path in sorted(GOLDEN.glob("*.npz")) if KINDS[read_archive(path)[0]["kind"]].role == "controller"
]
_SHORT = [name for name in FILES if name != "nmpc"]


@cache
def _block(kind: str) -> Block:
    if kind != "nmpc":
        return block_of(kind)
    # The others are designed on Eq. 31; this one knows its neck.
    logged = record(signal("eq22", duration=60.0), VirtualNeck(NeckParameters.paper()), seed=1)
    model = Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(logged)
    return NmpcSettings(horizon=8, moves=3).design(model).block()


@pytest.fixture(scope="module")
def neck(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("neck") / "Neck.fmu"
    build_compiled_fmu(VirtualNeck(NeckParameters.paper().without_noise()).block(), path)
    return path


@pytest.fixture(scope="module", params=slow_but([*CONTROLLERS, "nmpc"], ["pi", "hinf", "mpc"]))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def path(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp(kind) / f"{kind}.fmu"
    if kind == "nmpc":  # has no C
        return build_fmu(_block(kind), target)
    build_compiled_fmu(_block(kind), target)
    return target


def _step(running: Any, neck: Path, path: Path, *, connected: bool, **parameters: float) -> Matrix:
    """Return pitch (time,) of a step at 0.5 s in a master of three lines."""
    pitch = []
    with running(neck) as plant, running(path) as controller:
        plant.begin()
        controller.begin(**parameters)
        for k in range(200):
            angles = plant.get("pitch", "roll")
            controller.set(pitch_reference=STEP if k >= 25 else 0.0, pitch=angles[0], roll=angles[1])
            if connected:
                controller.set(**dict(zip(POSITIONS, plant.get(*POSITIONS), strict=True)))
            controller.fmu.doStep(k * TS, TS)
            plant.set(**dict(zip(MOTORS, controller.get(*MOTORS), strict=True)))
            plant.fmu.doStep(k * TS, TS)
            pitch.append(angles[0])
    return np.array(pitch)


def _rise(pitch: Matrix) -> float:
    return TS * float(np.argmax(pitch > 0.9 * STEP) - np.argmax(pitch > 0.1 * STEP))


def test_a_step_settles_as_it_does_with_positions(kind: str, path: Path, neck: Path, running: Any) -> None:
    whole = _step(running, neck, path, connected=True, use_motor_positions=1.0)
    alone = _step(running, neck, path, connected=False)
    # Without a model inside pitch ends at 2 to 9 deg, as far as the lead limit lets set-points go from 0.
    assert np.abs(alone[-50:] - STEP).max() < math.radians(0.5)
    # The neck's loaded drives are 20 ms behind the model's at most: measured 0.5 deg, one sample and 0.1 %.
    assert np.abs(alone - whole).max() < math.radians(0.6)
    assert _rise(alone) == pytest.approx(_rise(whole), abs=1.5 * TS)
    assert abs(alone.max() - whole.max()) < 0.005 * STEP


def _stuck(running: Any, path: Path, **parameters: float) -> Matrix:
    """Return set-points (time, 3) while nothing moves: 4 s of a step forwards, then 2 s of one backwards."""
    rows = []
    with running(path) as controller:
        controller.begin(**parameters)
        assert controller.get("healthy", "enabled") == [1.0, 1.0]  # that nobody ever sets
        for k in range(300):
            controller.set(pitch_reference=STEP if k < 200 else -STEP)
            controller.fmu.doStep(k * TS, TS)
            rows.append(controller.get(*MOTORS))
    return np.array(rows)


def test_set_points_do_not_run_away_from_the_motors(kind: str, path: Path, running: Any) -> None:
    limits = {port.name: port.start for port in _block(kind).parameters}
    lead, slew = limits["lead_limit"], limits["slew_limit"] * TS
    jammed = _stuck(running, path, use_motor_positions=1.0)
    assert np.abs(jammed).max() <= lead + 1e-9
    free = _stuck(running, path)
    assert np.abs(free).max() <= limits["position_limit"] + 1e-9
    # Where the model has its motors, by another program: first order at 10.5 1/s, 60 ms late, shown one sample later.
    motors, drive, late = np.zeros(3), math.exp(-10.5 * TS), [np.zeros(3)] * 4
    for u in free:
        assert np.abs(u - motors).max() <= lead + 1e-9
        late = [u, *late[:-1]]
        motors = drive * motors + (1.0 - drive) * late[-1]
    for u in (jammed, free):
        assert np.abs(np.diff(u, axis=0)).max() <= slew + 1e-9
        # Nothing wound up in 4 s: set-points turn back as soon as the reference filter does, fopi's after 0.3 s.
        assert u[199, 0] > 0.3
        assert u[220, 0] < u[199, 0] - 0.2


def test_compiled_it_computes_what_python_does(kind: str, path: Path, running: Any) -> None:
    if kind == "nmpc":
        pytest.skip("has no C")
    rows = golden_inputs(_block(kind), 60, "missing")
    names = [port.name for port in _block(kind).inputs]
    for parameter in (0.0, 1.0):
        expected = plain_run(_block(kind), rows, use_motor_positions=parameter)
        with running(path) as fmu:
            fmu.begin(use_motor_positions=parameter)
            for k, (row, outputs) in enumerate(zip(rows, expected, strict=True)):
                fmu.set(**dict(zip(names, row, strict=True)))
                fmu.fmu.doStep(k * TS, TS)
                # As in `test_native_kinds`: sums in another order.
                np.testing.assert_allclose(fmu.get(*MOTORS), outputs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", slow_but(FILES, _SHORT))
def test_files_of_before_give_the_same_bits_with_positions(name: str) -> None:
    block = load(GOLDEN / f"{name}.npz").block()
    rows = golden_inputs(block, GOLDEN_ROWS, "missing")
    seen = plain_run(block, rows, use_motor_positions=1.0)
    runtime, state, before = load_runtime(block.runtime, compiled=False), block.initial_state(), np.zeros_like(seen)
    runtime.run_steps(block.arrays, state.parameters, state.values.copy(), rows, before)
    np.testing.assert_array_equal(seen, before)
    written = np.array(json.loads((GOLDEN / "outputs.json").read_text(encoding="utf-8"))[name])[1:]
    # What the version that wrote the file answered, compiled by numba: as in `test_golden`.
    np.testing.assert_allclose(seen, written, rtol=1e-12, atol=1e-12)
    assert np.abs(seen - plain_run(block, rows)).max() > 0.01


def test_connected_positions_say_where_the_modelled_motors_begin() -> None:
    block = block_of("pi")
    rows = np.array([[port.start for port in block.inputs]] * 3)
    rows[:, 5:8] = 1.0, 0.5, -0.5
    rows[1:, 9] = 0.0  # not enabled after the first sample: set-points stay
    begun = plain_run(block, rows)
    np.testing.assert_array_equal(begun, plain_run(block, rows, use_motor_positions=1.0))
    assert np.abs(begun - rows[:, 5:8]).max() < 0.5


def test_what_is_no_controller_or_has_drives_stays_as_it_is(toys: Any) -> None:
    for block in (block_of("rls"), toys.controller(), toys.pi()):
        assert with_modelled_drives(block) is block
    whole = with_modelled_drives(block_of("pi"))  # as an SSP file of ours has it, read out of a Python FMU
    assert with_modelled_drives(whole) is whole
