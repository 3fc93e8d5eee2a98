"""Parameters that change during a run: the loop of a re-designed controller without a jump, and other plants."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Slave

from softneck.core import Matrix, Vector
from softneck.design.linear._controller import ReferenceFilter, assemble, pi_axis
from softneck.design.linear._linear_parts_runtime import LinearArrays
from softneck.design.linear._pid import PidGains
from softneck.fmu import build_compiled_fmu, build_fmu, exported_block, unpacked
from softneck.runtime import Block, load_runtime

from ..data import with_starts
from ..importers import need
from .every_kind import MOTORS, TS, block_of, inputs_of, plain_run
from .test_importers import SCRIPTS

needs_c = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)
# Every gain by another factor, so that none can stand for another.
CHANGES = {"pi": {"K": 0.7, "Ti": 1.4}, "pid": {"K": 0.6, "Ti": 1.5, "Td": 0.8, "Tf": 2.0}}
KINDS = list(CHANGES)
AT, ROWS = 40, 100
SIGNALS = ["pitch_reference", "roll_reference", "pitch", "roll", *(f"motor_position_{j}" for j in (1, 2, 3))]


@cache
def _block(kind: str) -> Block:
    return with_starts(exported_block(block_of(kind)), use_motor_positions=1.0)


def _changed(kind: str, names: tuple[str, ...] = ("K", "Ti", "Td", "Tf")) -> dict[str, float]:
    start = {port.name: port.start for port in _block(kind).parameters}
    return {f"pitch_{name}": CHANGES[kind][name] * start[f"pitch_{name}"] for name in CHANGES[kind] if name in names}


def _redesigned(kind: str, changed: dict[str, float]) -> Block:
    """Return the block of the controller with other gains of pitch, by the functions of the design."""
    block = block_of(kind)
    p, start = LinearArrays(block.arrays), {port.name: port.start for port in _block(kind).parameters} | changed
    axes = []
    for axis in ("pitch", "roll"):
        gains: Any = [start[f"{axis}_{name}"] for name in CHANGES[kind]]
        axes.append(pi_axis(gains[0], gains[1], TS) if kind == "pi" else PidGains(*gains).axis(TS))
    made = assemble(axes, filters=[ReferenceFilter(0.0)] * 3, redefinition=(p.T, p.T_inverse), constants=p.constants)
    names = LinearArrays.names()
    law = ("A", "Br", "By", "C", "Dr", "Dy", "L", "align")
    arrays = dict(zip(names, block.arrays, strict=True)) | {n: dict(zip(names, made, strict=True))[n] for n in law}
    # The design of a PID may have chosen another conditioning than Hanus', which an axis with its gains keeps.
    kept = slice(1 if changed else 0, None)
    arrays["L"][:, kept] = p.L[:, kept]
    return Block(
        kind=kind, role="controller", runtime=block.runtime, sample_time=TS, arrays=tuple(arrays.values()),
        inputs=block.inputs, outputs=block.outputs, parameters=block.parameters,
    )  # fmt: skip


class _Plain:
    """A block stepped by its plain text."""

    def __init__(self, block: Block) -> None:
        self.block, self.runtime = block, load_runtime(block.runtime, compiled=False)
        self.names = [port.name for port in block.parameters]
        self.parameters = np.array([port.start for port in block.parameters])
        self.x, self.y = np.zeros(self.runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
        self.runtime.initialise(block.arrays, self.parameters, self.x, self.y)

    def set(self, **values: float) -> None:
        for name, value in values.items():
            self.parameters[self.names.index(name)] = value

    def step(self, _k: int, signals: dict[str, float]) -> Vector:
        u = np.array([signals.get(port.name, port.start) for port in self.block.inputs])
        self.runtime.step(self.block.arrays, self.parameters, self.x, u, self.y)
        return self.y.copy()


def _loop(controller: Any, change: Callable[[], None] | None, size: float = 0.02, *, away: bool = False) -> Matrix:
    """Return set-points and angles (ROWS, 5) of a loop around a plant of first order, `change` before sample AT.

    `away`: it begins tilted, with motors that hold it there.
    """
    p, y, rows = LinearArrays(block_of("pi").arrays), np.array([0.05, -0.03]) * away, []
    m = p.T_inverse @ np.array([*(y / 0.09), 0.1 * away])
    for k in range(ROWS):
        if k == AT and change is not None:
            change()
        r = np.array([size if k >= 5 else 0.0, -0.5 * size if k >= 30 else 0.0])  # roll moves while gains change
        m = controller.step(k, dict(zip(SIGNALS, [*r, *y, *m], strict=True)))
        rows.append([*m, *y])
        y = 0.9 * y + 0.009 * (p.T @ m)[:2]
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
def test_start_values_change_no_bit(kind: str) -> None:
    block, u = block_of(kind), inputs_of(block_of(kind), 200)
    designed = plain_run(block, u, use_motor_positions=1.0)
    np.testing.assert_array_equal(plain_run(_block(kind), u), designed)
    start = {port.name: port.start for port in _block(kind).parameters}
    for name in CHANGES[kind]:
        other = plain_run(_block(kind), u, **{f"roll_{name}": start[f"roll_{name}"] * (1.0 + 1e-9)})
        assert not np.array_equal(other, designed), name


@pytest.mark.parametrize("size", [0.02, 0.6], ids=["small", "in its limits"])
@pytest.mark.parametrize("kind", KINDS)
def test_gains_set_before_the_start_give_the_redesigned_controller(kind: str, size: float) -> None:
    controller = _Plain(_block(kind))
    controller.set(**_changed(kind))
    ours = _loop(controller, None, size, away=True)
    designed = _loop(_Plain(_redesigned(kind, _changed(kind))), None, size, away=True)
    # Sums in another order, fed back over 100 samples; 1e-16 of 1 rad in each.
    np.testing.assert_allclose(ours, designed, rtol=0, atol=1e-12)
    assert np.abs(ours - _loop(_Plain(_block(kind)), None, size, away=True)).max() > 1e-2 * size


class _Textbook:
    """Pitch by the textbook's PI or PID with parts P, I, D; on a change I keeps v (Astrom and Hagglund, chapter 13)."""

    def __init__(self, kind: str) -> None:
        p = LinearArrays(block_of(kind).arrays)
        self.kind, self.T_inverse, self.a, self.I, self.rf, self.yf = kind, p.T_inverse, p.Af[0, 0], 0.0, 0.0, 0.0
        self.gains = {port.name: port.start for port in _block(kind).parameters}
        self.other = _Plain(_redesigned(kind, {}))  # of roll
        self.T = p.T
        self.ahead: dict[str, float] = {}

    def _v(self, gains: dict[str, float], y: float) -> float:
        K, Ti = gains["pitch_K"], gains["pitch_Ti"]
        e = self.rf - y
        if self.kind == "pi":
            return K * e + self.I
        D = -K * gains["pitch_Td"] * (y - self.yf) / (gains["pitch_Tf"] + TS)
        return K * e + self.I + K * TS / Ti * e + D

    def step(self, k: int, signals: dict[str, float]) -> Vector:
        y, e = signals["pitch"], 0.0
        self.rf = self.a * self.rf + (1.0 - self.a) * signals["pitch_reference"]
        if self.ahead:
            before, self.gains, self.ahead = self._v(self.gains, y), {**self.gains, **self.ahead}, {}
            self.I += before - self._v(self.gains, y)
        v, e = self._v(self.gains, y), self.rf - y
        self.I += self.gains["pitch_K"] * TS / self.gains["pitch_Ti"] * e
        if self.kind == "pid":
            self.yf += TS / (self.gains["pitch_Tf"] + TS) * (y - self.yf)
        rest = self.T @ self.other.step(k, signals)
        return self.T_inverse @ np.array([v, rest[1], rest[2]])


def _driven(fmu: Any, change: dict[str, float]) -> Matrix:
    """Return the loop of a running FMU whose gains change on the way."""
    fmu.begin(use_motor_positions=1.0)

    def step(k: int, signals: dict[str, float]) -> Vector:
        fmu.set(**signals)
        fmu.fmu.doStep(k * TS, TS)
        return np.array(fmu.get(*MOTORS))

    return _loop(type("C", (), {"step": staticmethod(step)}), lambda: fmu.set(**change))


def _in_c(kind: str, folder: Path, running: Any, fmi: int, change: dict[str, float]) -> Matrix:
    """Return the loop of the compiled FMU in fmpy."""
    path = folder / f"C{fmi}.fmu"
    build_compiled_fmu(block_of(kind), path, fmi=fmi)
    if fmi == 2:
        with running(path) as fmu:
            return _driven(fmu, change)
    with unpacked(path) as resources:
        model = fmpy.read_model_description(str(resources))
        at = {v.name: v.valueReference for v in model.modelVariables}
        fmu3: Any = FMU3Slave(guid=model.guid, unzipDirectory=str(resources), modelIdentifier="C3", instanceName="c")
        fmu3.instantiate()
        fmu3.enterInitializationMode()
        fmu3.setBoolean([at["use_motor_positions"]], [True])
        fmu3.exitInitializationMode()

        def put(values: dict[str, float]) -> None:
            fmu3.setFloat64([at[name] for name in values], list(values.values()))

        def step3(k: int, signals: dict[str, float]) -> Vector:
            put(signals)
            fmu3.doStep(k * TS, TS)
            return np.array(fmu3.getFloat64([at[name] for name in MOTORS]))

        seen = _loop(type("C", (), {"step": staticmethod(step3)}), lambda: put(change))
        fmu3.freeInstance()
        return seen


@needs_c
@pytest.mark.parametrize("kind", KINDS)
def test_a_gain_changed_in_a_running_loop_acts_as_in_the_textbook(kind: str, tmp_path: Path, running: Any) -> None:
    change, plain = _changed(kind), _Plain(_block(kind))
    expected = _loop(plain, lambda: plain.set(**change))
    unchanged = _loop(_Plain(_block(kind)), None)
    textbook = _Textbook(kind)
    # P, I and D summed apart: rounding alone.
    np.testing.assert_allclose(expected, _loop(textbook, lambda: textbook.ahead.update(change)), rtol=0, atol=1e-12)
    # No jump: the command at the change is that without, though pitch has an error then; what follows is not.
    np.testing.assert_allclose(expected[AT], unchanged[AT], rtol=0, atol=1e-12)
    assert np.abs(expected[AT + 1 :, 3] - unchanged[AT + 1 :, 3]).max() > 1e-5
    for fmi in (2, 3):
        # numpy's products sum in another order than C.
        np.testing.assert_allclose(_in_c(kind, tmp_path, running, fmi, change), expected, rtol=0, atol=1e-12)


def test_a_derivative_begins_without_a_jump() -> None:
    controller = _Plain(_block("pid"))
    Td = float(controller.parameters[controller.names.index("pitch_Td")])
    controller.set(pitch_Td=0.0)
    at_rest: dict[str, float] = dict.fromkeys(("pitch_reference", "pitch"), 0.1)
    held = [controller.step(k, at_rest) for k in range(20)][-1]
    assert np.abs(held).max() == 0.0  # it began where motors, angle and reference are
    controller.set(pitch_Td=Td)
    # Nothing moves: neither the first command with a derivative nor a later one does; only rounding of 1 rad.
    np.testing.assert_allclose([controller.step(k, at_rest) for k in range(20)], np.tile(held, (20, 1)), atol=1e-14)


@pytest.mark.parametrize("build", [build_fmu, pytest.param(build_compiled_fmu, marks=needs_c)])
def test_what_is_tunable_may_be_set_while_running(build: Any, tmp_path: Path, running: Any) -> None:
    path = tmp_path / "P.fmu"
    build(block_of("pi"), path)
    variables = {v.name: v for v in fmpy.read_model_description(str(path)).modelVariables}
    gains = [f"{axis}_{name}" for axis in ("pitch", "roll") for name in ("K", "Ti")]
    assert [name for name, v in variables.items() if v.variability == "tunable"] == gains
    change, plain = _changed("pi"), _Plain(_block("pi"))
    with running(path) as fmu:
        seen = _driven(fmu, change)
        np.testing.assert_allclose(seen, _loop(plain, lambda: plain.set(**change)), rtol=0, atol=1e-12)
        assert fmu.get("pitch_K") == [change["pitch_K"]]
        with pytest.raises(FMICallException):
            fmu.set(slew_limit=1.0)  # stays fixed
    assert any("slew_limit is fixed" in text for _, text in fmu.log)


@needs_c
def test_model_exchange_takes_a_gain_in_its_event(tmp_path: Path) -> None:
    path = tmp_path / "M.fmu"
    build_compiled_fmu(block_of("pi"), path)
    change, plain = _changed("pi"), _Plain(_block("pi"))
    expected = _loop(plain, lambda: plain.set(**change))
    with unpacked(path) as folder:
        model = fmpy.read_model_description(str(folder))
        at = {v.name: v.valueReference for v in model.modelVariables}
        fmu: Any = FMU2Model(guid=model.guid, unzipDirectory=str(folder), modelIdentifier="M", instanceName="m")
        fmu.instantiate()
        fmu.setBoolean([at["use_motor_positions"]], [1])
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()

        def step(k: int, signals: dict[str, float]) -> Vector:
            if k:
                fmu.enterContinuousTimeMode()
                fmu.setTime(k * TS)
                fmu.enterEventMode()
            fmu.setReal([at[name] for name in SIGNALS], [signals[name] for name in SIGNALS])
            if k == AT:  # after the sample was taken with the old gains: it is taken anew
                fmu.newDiscreteStates()
                fmu.setReal([at[name] for name in change], list(change.values()))
            fmu.newDiscreteStates()
            return np.array(fmu.getReal([at[name] for name in MOTORS]))

        seen = _loop(type("M", (), {"step": staticmethod(step)}), None)
        fmu.freeInstance()
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@needs_c
@pytest.mark.parametrize("importer", ["libcosim", "ecos"])
def test_another_master_changes_a_gain(importer: str, tmp_path: Path) -> None:
    need({"libcosim": "libcosimpy", "ecos": "ecospy"}[importer])
    path, block = tmp_path / "P.fmu", exported_block(block_of("pi"))
    build_compiled_fmu(block_of("pi"), path)
    u = inputs_of(block_of("pi"), 60, missing=False)
    change, plain = _changed("pi"), _Plain(block)
    expected = []
    start = {port.name: port.start for port in block.parameters}
    rows = []
    for k, row in enumerate(u):
        if k == 30:
            plain.set(**change)
        expected.append(plain.step(k, dict(zip([p.name for p in block.inputs], row, strict=True))))
        rows.append([*row, *((change if k >= 30 else start)[name] for name in change)])
    names = [*(port.name for port in block.inputs), *change]
    job, out = tmp_path / "job.npz", tmp_path / "out.npy"
    np.savez(job, step=TS, inputs=np.array(rows), names=names, outputs=MOTORS,
             booleans=np.array(["healthy", "enabled"]))  # fmt: skip
    script = [sys.executable, str(SCRIPTS / f"{importer}.py"), str(path), str(job), str(out)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=120, check=False)
    assert out.is_file(), done.stderr[-2000:]
    np.testing.assert_allclose(np.load(out), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["rls", "oe", "miso", "oe2"])
def test_a_plant_with_its_start_values_changes_no_bit(kind: str) -> None:
    block, u = block_of(kind), inputs_of(block_of(kind), 200)
    whole, identified = exported_block(block), plain_run(block, u, use_measurement=1.0)
    np.testing.assert_array_equal(plain_run(whole, u, use_measurement=1.0), identified)
    for port in whole.parameters[len(block.parameters) :]:
        assert port.tunable
        other = port.start + 1.0 if port.integer else port.start * (1.0 + 1e-9)
        assert not np.array_equal(plain_run(whole, u, use_measurement=1.0, **{port.name: other}), identified), port.name


@pytest.mark.parametrize("build", [build_fmu, pytest.param(build_compiled_fmu, marks=needs_c)])
def test_gain_and_dead_time_of_a_state_space_change_while_running(build: Any, tmp_path: Path, running: Any) -> None:
    block, path = exported_block(block_of("miso")), tmp_path / "Plant.fmu"
    build(block_of("miso"), path)
    start = {port.name: port.start for port in block.parameters}
    u = np.random.default_rng(5).uniform(-1.0, 1.0, (160, 3))
    u[:40], u[80:] = [1.0, -1.0, 0.5], u[79]  # held, so that the slowest pole leaves 1e-3 of what was before

    def run(changes: dict[int, dict[str, float]]) -> Matrix:
        seen = []
        with running(path) as fmu:
            fmu.begin(**changes.get(0, {}))
            for k, row in enumerate(u):
                fmu.set(**(changes.get(k, {}) if k else {}), **dict(zip(MOTORS, row, strict=True)))
                fmu.fmu.doStep(k * TS, TS)
                seen.append(fmu.get("pitch", "roll"))
        return np.array(seen)

    as_it_is, doubled = run({}), {"pitch_gain": 2.0 * start["pitch_gain"]}
    # From rest: the answer is scaled, alone that of the output; or as many samples later. To rounding.
    np.testing.assert_allclose(run({0: doubled}), as_it_is * [2.0, 1.0], rtol=0, atol=1e-14)
    late = run({0: {"dead_time": start["dead_time"] + 3.0}})
    np.testing.assert_allclose(late[3:], as_it_is[:-3], rtol=0, atol=1e-14)
    # On the way: nothing jumps, and the answers to later set-points are the scaled ones, those to earlier ones fade.
    changed = run({40: doubled})
    np.testing.assert_array_equal(changed[:40], as_it_is[:40])
    # A pole at 0.9 moves towards twice the value by a tenth of it in a sample.
    assert 0.0 < abs(changed[40, 0] - as_it_is[40, 0]) < 0.15 * abs(as_it_is[39, 0])
    np.testing.assert_allclose(changed[-1], as_it_is[-1] * [2.0, 1.0], rtol=1e-3)
    with pytest.raises(ValueError, match="dead_time"):
        Block.initial_state(block, dead_time=start["dead_time"] + 11.0)


def test_plants_of_other_forms_have_none() -> None:
    for kind in ("nn", "play"):
        assert not any(port.tunable for port in exported_block(block_of(kind)).parameters)


@pytest.mark.parametrize("build", [build_fmu, pytest.param(build_compiled_fmu, marks=needs_c)])
def test_a_plant_changed_while_running_is_the_textbooks(build: Any, tmp_path: Path, running: Any) -> None:
    block, path = exported_block(block_of("rls")), tmp_path / "Plant.fmu"
    build(block_of("rls"), path)
    start = {port.name: port.start for port in block.parameters}
    T = block_of("rls").arrays[4]  # the redefinition
    u = np.random.default_rng(5).uniform(-1.0, 1.0, (80, 3))
    value = {name: start[f"pitch_{name}"] for name in ("gain", "time_constant", "dead_time")}
    changes = {20: ("gain", 1.5 * value["gain"]), 35: ("time_constant", 2.0 * value["time_constant"]),
               50: ("dead_time", 4.0), 65: ("dead_time", 1.0)}  # fmt: skip
    y, seen, expected = 0.0, [], []
    with running(path) as fmu:
        fmu.begin()
        for k, row in enumerate(u):
            if k in changes:
                name, new = changes[k]
                fmu.set(**{f"pitch_{name}": new})
                value[name] = new
            fmu.set(**dict(zip(MOTORS, row, strict=True)))
            fmu.fmu.doStep(k * TS, TS)
            seen.append(fmu.get("pitch")[0])
            p, late = np.exp(-TS / value["time_constant"]), k - int(value["dead_time"])
            y = p * y + value["gain"] * (1.0 - p) * (T[0] @ u[late] if late >= 0 else 0.0)
            expected.append(y)
        with pytest.raises(FMICallException):
            fmu.set(pitch_dead_time=start["pitch_dead_time"] + 11.0)  # beyond the maximum that it declares
    # The start values have 15 digits of the model's; 80 samples of a stable recursion.
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-13)
