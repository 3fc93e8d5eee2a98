"""Both backends on one model: steps out of turn or past the stop time, and set-points that it never saw."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave, fmi3LogMessageCallback

from softneck.fmu import build_compiled_fmu, build_fmu, unpacked

from .every_kind import MOTORS, TS, block_of, recording

_compiled = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)
# The status of a step refused: error; pythonfmu's binary knows "discard" and "fatal" alone.
BACKENDS = [
    pytest.param(build_fmu, 2, id="python"),
    pytest.param(build_compiled_fmu, 3, id="compiled", marks=_compiled),
]
BUILDERS = [pytest.param(entry.values[0], id=entry.id, marks=entry.marks) for entry in BACKENDS]


@pytest.mark.parametrize(("build", "status"), BACKENDS)
def test_a_step_before_the_initialisation_has_ended_is_refused(
    build: Callable[..., Any], status: int, tmp_path: Path, running: Any
) -> None:
    build(block_of("rls"), tmp_path / "Neck.fmu")
    with running(tmp_path / "Neck.fmu") as fmu:
        with pytest.raises(FMICallException, match=f"fmi2DoStep failed with status {status}"):
            fmu.fmu.doStep(0.0, TS)
        assert fmu.log == [(3, "Neck: a step before the initialisation has ended.")]
        fmu.begin()
        for size in (np.nan, -TS, 1e300):
            with pytest.raises(FMICallException, match=f"status {status}"):
                fmu.fmu.doStep(0.0, size)
            assert fmu.log[-1] == (3, f"Neck: a step from 0 s over {size:g} s cannot be taken.")
        fmu.fmu.doStep(0.0, TS)
        with pytest.raises(FMICallException, match="status"):
            fmu.fmu.setupExperiment(startTime=np.inf)
        assert "the start time is inf; it must be finite." in fmu.log[-2 if build is build_fmu else -1][1]


@pytest.mark.parametrize(("build", "status"), BACKENDS)
def test_a_step_past_the_stop_time_is_refused_and_changes_nothing(
    build: Callable[..., Any], status: int, tmp_path: Path, running: Any
) -> None:
    build(block_of("rls"), tmp_path / "Neck.fmu")
    with running(tmp_path / "Neck.fmu") as fmu:
        fmu.fmu.setupExperiment(startTime=0.0, stopTime=3 * TS)
        fmu.fmu.enterInitializationMode()
        fmu.fmu.exitInitializationMode()
        fmu.set(motor_setpoint_1=1.0)
        time = 0.0
        for _ in range(3):  # 3 * 0.02 and 0.02 + 0.02 + 0.02 differ in the last digit
            fmu.fmu.doStep(time, TS)
            time += TS
        before = fmu.get("pitch")
        with pytest.raises(FMICallException, match=f"fmi2DoStep failed with status {status}"):
            fmu.fmu.doStep(time, TS)
        assert fmu.log == [(3, "Neck: a step from 0.06 s over 0.02 s goes past the stop time of 0.06 s.")]
        assert fmu.get("pitch") == before
        fmu.fmu.reset()
        fmu.begin()  # without a stop time
        for k in range(5):
            fmu.fmu.doStep(k * TS, TS)


@_compiled
def test_fmi_3_refuses_a_step_past_the_stop_time(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("rls"), tmp_path / "Neck.fmu", fmi=3)
    log: list[tuple[int, str]] = []
    with unpacked(tmp_path / "Neck.fmu") as folder:
        token = fmpy.read_model_description(str(folder)).instantiationToken
        fmu = FMU3Slave(guid=token, unzipDirectory=str(folder), modelIdentifier="Neck", instanceName="test")
        fmu.instantiate(logMessage=fmi3LogMessageCallback(lambda _e, s, _c, text: log.append((s, text.decode()))))
        fmu.enterInitializationMode(startTime=0.0, stopTime=2 * TS)
        fmu.exitInitializationMode()
        fmu.doStep(0.0, 2 * TS)
        with pytest.raises(FMICallException, match="fmi3DoStep failed with status 3"):
            fmu.doStep(2 * TS, TS)
        fmu.freeInstance()
    assert log == [(3, "Neck: a step from 0.04 s over 0.02 s goes past the stop time of 0.04 s.")]


@pytest.mark.parametrize("build", BUILDERS)
def test_a_set_point_that_the_model_never_saw_is_said_once(
    build: Callable[..., Any], tmp_path: Path, running: Any
) -> None:
    build(block_of("rls"), tmp_path / "Neck.fmu")
    description = fmpy.read_model_description(str(tmp_path / "Neck.fmu"))
    stated = {
        v.name: (float(v.min or "nan"), float(v.max or "nan")) for v in description.modelVariables if v.name in MOTORS
    }
    seen = recording().set_points
    assert stated == dict(zip(MOTORS, zip(seen.min(axis=0), seen.max(axis=0), strict=True), strict=True))
    low, high = stated["motor_setpoint_1"]
    assert low < 0.0 < high
    with running(tmp_path / "Neck.fmu") as fmu:
        fmu.begin()
        fmu.set(motor_setpoint_1=high)
        assert fmu.log == []
        for value in (60.0, 1e300, 60.0):
            fmu.set(motor_setpoint_1=value)
            fmu.fmu.doStep(0.0, 0.0)
        said = f"Neck: motor_setpoint_1 = 60 is outside {low:g} to {high:g} rad. Is it in degrees?"
        assert fmu.log == [(1, said)]
        # A little further than it was trained is no sign of degrees.
        near = stated["motor_setpoint_2"][1] + 0.1
        fmu.set(motor_setpoint_2=near)
        assert "Is it" not in fmu.log[-1][1]
        assert len(fmu.log) == 2
