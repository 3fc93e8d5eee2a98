"""The whole state of an FMU: saved and restored, it replays to the bit, wherever it is restored."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

TS = 0.02
PARAMETERS = {"pitch_start": 0.3, "noise_std": 0.1, "noise_seed": 5.0, "biased": 1.0}


def _walk(fmu: Any, inputs: np.ndarray, first: int, last: int, part: float = 1.0) -> list[list[float]]:
    """Step from sample `first` to `last`; return pitch as hexadecimal-exact floats."""
    rows = []
    for k in range(first, last):
        fmu.set(motor_setpoint_1=inputs[k, 0], driven=inputs[k, 1], extra=inputs[k, 2])
        fmu.fmu.doStep(k * TS, part * TS)
        rows.append(fmu.get("pitch", "measurement_valid"))
        if part < 1.0:
            fmu.fmu.doStep((k + part) * TS, (1.0 - part) * TS)
    return rows


def test_rollback_in_place_replays_to_the_bit(lag_fmu: Path, lag_inputs: np.ndarray, running: Any) -> None:
    with running(lag_fmu) as fmu:
        fmu.begin(**PARAMETERS)
        _walk(fmu, lag_inputs, 0, 50)
        state = fmu.fmu.getFMUstate()
        first = _walk(fmu, lag_inputs, 50, 120)
        for _ in range(3):
            fmu.fmu.setFMUstate(state)
            assert _walk(fmu, lag_inputs, 50, 120) == first
        fmu.fmu.freeFMUstate(state)


def test_a_state_between_samples_keeps_the_pending_output(lag_fmu: Path, lag_inputs: np.ndarray, running: Any) -> None:
    with running(lag_fmu) as fmu:
        fmu.begin(**PARAMETERS)
        _walk(fmu, lag_inputs, 0, 50)
        fmu.fmu.doStep(50 * TS, 0.4 * TS)  # sample 50 is taken, its outputs are not shown yet
        shown, state = fmu.get("pitch"), fmu.fmu.getFMUstate()
        fmu.fmu.doStep(50.4 * TS, 0.6 * TS)
        after = fmu.get("pitch")
        _walk(fmu, lag_inputs, 51, 60)
        fmu.fmu.setFMUstate(state)
        assert fmu.get("pitch") == shown != after
        fmu.fmu.doStep(50.4 * TS, 0.6 * TS)
        assert fmu.get("pitch") == after
        fmu.fmu.freeFMUstate(state)


def test_a_serialised_state_carries_inputs_and_parameters_to_another_instance(
    lag_fmu: Path, lag_inputs: np.ndarray, running: Any
) -> None:
    names = ("motor_setpoint_1", "driven", "extra", "pitch", *PARAMETERS)
    with running(lag_fmu) as one, running(lag_fmu) as two:
        one.begin(2.0, **PARAMETERS)
        one.set(motor_setpoint_1=1 / 3, driven=0.0)
        one.fmu.doStep(2.0, 1.3 * TS)
        state = one.fmu.getFMUstate()
        text = one.fmu.serializeFMUstate(state)
        one.fmu.freeFMUstate(state)
        two.begin(**{**PARAMETERS, "noise_seed": 9.0})
        restored = two.fmu.deSerializeFMUstate(text)
        two.fmu.setFMUstate(restored)
        np.testing.assert_array_equal(two.get(*names), one.get(*names))  # NaN in `extra` as well
        assert two.fmu.serializeFMUstate(restored) == text
        two.fmu.freeFMUstate(restored)
        for fmu in (one, two):
            fmu.fmu.doStep(2.0 + 1.3 * TS, 0.9 * TS)
        assert two.get("pitch") == one.get("pitch")


_CHILD = """
import json, sys
import fmpy
from fmpy.fmi2 import FMU2Slave
for name in ("softneck", "numba", "scipy"):
    sys.modules[name] = None  # a host with numpy alone
folder, guid, name, references, state, rows = json.loads(sys.stdin.read())
fmu = FMU2Slave(guid=guid, unzipDirectory=folder, modelIdentifier=name, instanceName="child")
fmu.instantiate(loggingOn=True)
fmu.setupExperiment(startTime=0.0)
fmu.enterInitializationMode()
fmu.exitInitializationMode()
fmu.setFMUstate(fmu.deSerializeFMUstate(bytes.fromhex(state)))
seen = []
for k, u, driven in rows:
    fmu.setReal(references[:1], [u])
    fmu.setBoolean(references[1:2], [driven])
    fmu.doStep(k * 0.02, 0.02)
    seen.append(fmu.getReal(references[2:])[0].hex())
fmu.terminate()
fmu.freeInstance()
print(json.dumps(seen))
"""


def test_a_state_replays_in_another_process_that_has_numpy_alone(
    lag_fmu: Path, lag_inputs: np.ndarray, running: Any
) -> None:
    lag_inputs[:, 2] = 0.25
    with running(lag_fmu) as fmu:
        fmu.begin(**PARAMETERS)
        _walk(fmu, lag_inputs, 0, 50)
        state = fmu.fmu.serializeFMUstate(fmu.fmu.getFMUstate())
        fmu.set(extra=0.25)
        here = [row[0].hex() for row in _walk(fmu, lag_inputs, 50, 120)]
        references = [fmu.references[name] for name in ("motor_setpoint_1", "driven", "pitch")]
        rows = [[k, lag_inputs[k, 0], int(lag_inputs[k, 1])] for k in range(50, 120)]
        task = [fmu.fmu.unzipDirectory, fmu.fmu.guid, "Lag", references, state.hex(), rows]
        child = subprocess.run(
            [sys.executable, "-c", _CHILD], input=json.dumps(task), capture_output=True, text=True, check=False
        )
    assert (child.returncode, child.stderr) == (0, "")
    assert json.loads(child.stdout) == here


def test_a_state_of_another_fmu_or_a_damaged_one_is_refused(lag_fmu: Path, controller_fmu: Path, running: Any) -> None:
    with running(lag_fmu) as lag, running(controller_fmu) as other:
        other.begin()
        foreign = other.fmu.serializeFMUstate(other.fmu.getFMUstate())
        lag.begin(**PARAMETERS)
        before = lag.get("pitch")
        own = lag.fmu.serializeFMUstate(lag.fmu.getFMUstate())
        for text in (foreign, b"garbage", b"\xff\xfe", b"[1]", own.replace(b'"memory": "', b'"memory": "00')):
            with pytest.raises(FMICallException, match="fmi2SetFMUstate"):
                lag.fmu.setFMUstate(lag.fmu.deSerializeFMUstate(text))
            assert "FMU state" in lag.log[-2][1]
        assert lag.get("pitch") == before
