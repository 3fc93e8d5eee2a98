"""What goes wrong is said by name, as a status and in the log, and the FMU lives on."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from softneck.core import SettingsError
from softneck.fmu import build_fmu, unpacked

TS = 0.02


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_input_that_is_no_number_is_an_error_that_names_it(
    value: float, lag_fmu: Path, running: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(lag_fmu) as fmu:
        fmu.begin()
        with pytest.raises(FMICallException, match=r"fmi2SetReal failed with status 4"):
            fmu.set(motor_setpoint_1=value)
        text = f"Lag: motor_setpoint_1 was set to {value}; it must be finite."
        assert (3, text) in fmu.log
        said = capfd.readouterr().err
    # What a host did wrong is one line; where in the code it was noticed helps nobody.
    assert text in said
    assert "Traceback" not in said


def test_an_unforeseen_error_says_where_it_happened(
    lag_fmu: Path, running: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(lag_fmu) as fmu:
        fmu.begin()
        with pytest.raises(FMICallException, match="fmi2GetReal"):
            fmu.fmu.getReal([10_000])
        said = capfd.readouterr().err
    assert "Traceback" in said
    assert "IndexError" in said


class _Trap:
    """Pickled, a program: it makes the file `path`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._path,)


def test_a_pickle_among_the_arrays_is_never_opened(lag_fmu: Path, running: Any, tmp_path: Path) -> None:
    trap, hostile = tmp_path / "sprung", tmp_path / "Hostile.fmu"
    content = io.BytesIO()
    np.save(content, np.array([_Trap(trap)], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(lag_fmu) as honest, zipfile.ZipFile(hostile, "w") as target:
        for name in honest.namelist():
            target.writestr(name, content.getvalue() if name == "resources/arrays.npy" else honest.read(name))
    with pytest.raises(Exception, match="Failed to instantiate"), running(hostile):
        pass
    assert not trap.exists()


def test_missing_measurements_are_allowed_where_the_port_says_so(lag_fmu: Path, running: Any) -> None:
    with running(lag_fmu) as fmu:
        fmu.begin()
        fmu.set(extra=np.nan)
        with pytest.raises(FMICallException, match="fmi2SetReal"):
            fmu.set(extra=np.inf)


def test_the_fmu_survives_any_number_of_errors_and_a_reset(lag_fmu: Path, running: Any) -> None:
    # pythonfmu 0.7 releases the instance at every exception: without a remedy this crashes the process.
    with running(lag_fmu) as fmu:
        fmu.begin(pitch_start=0.1)
        for _ in range(30):
            with pytest.raises(FMICallException, match="fmi2SetReal"):
                fmu.set(motor_setpoint_1=np.nan)
        for k in range(5):
            fmu.fmu.doStep(k * TS, TS)
        survived = fmu.get("pitch")
        for _ in range(5):
            fmu.fmu.reset()
            fmu.begin(pitch_start=0.1)
            for k in range(5):
                fmu.fmu.doStep(k * TS, TS)
            assert fmu.get("pitch") == survived
            with pytest.raises(FMICallException, match="fmi2SetReal"):
                fmu.set(motor_setpoint_1=np.nan)


def test_a_model_that_diverges_says_when(toys: Any, tmp_path: Path, running: Any) -> None:
    path = build_fmu(toys.lag(pole=1e30), tmp_path / "Wild.fmu")
    with running(path) as fmu:
        fmu.begin(pitch_start=1.0)
        with pytest.raises(FMICallException, match="fmi2DoStep failed with status 4"):
            fmu.fmu.doStep(0.0, 20 * TS)
        assert "output pitch became" in fmu.log[-2][1]
        assert "t = 0.22 s" in fmu.log[-2][1]  # 1e30^10.3 is the largest float


def test_parameters_are_fixed_and_have_ranges(lag_fmu: Path, running: Any) -> None:
    with running(lag_fmu) as fmu:
        with pytest.raises(FMICallException, match="fmi2SetReal"):
            fmu.set(noise_std=2.0)
        assert "noise_std must be between 0 and 1 [rad]" in fmu.log[-2][1]
        fmu.begin()
        with pytest.raises(FMICallException, match="fmi2SetReal"):
            fmu.set(noise_std=0.5)
        assert "noise_std is fixed" in fmu.log[-2][1]
        with pytest.raises(FMICallException, match="fmi2SetReal"):
            fmu.set(pitch=0.5)
        assert "pitch is an output" in fmu.log[-2][1]


def test_a_reference_in_degrees_is_asked_about_once(controller_fmu: Path, running: Any) -> None:
    with running(controller_fmu) as fmu:
        fmu.begin()
        for _ in range(3):
            fmu.set(pitch_reference=15.0, pitch=15.0)
            fmu.fmu.doStep(0.0, TS)
        assert fmu.log == [(1, "Gain: pitch_reference = 15 is outside -0.8 to 0.8 rad. Is it in degrees?")]


_HOST = """
import sys
import fmpy
from fmpy.fmi2 import FMU2Slave
guid = fmpy.read_model_description(sys.argv[1]).guid
{change}
fmu = FMU2Slave(guid=guid, unzipDirectory=sys.argv[1], modelIdentifier="Lag", instanceName="child")
try:
    fmu.instantiate()
except Exception as error:
    print("refused:", error)
"""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("sys.modules['numpy'] = None", "softneck FMU: it needs numpy in the Python of this host"),
        ("sys.version_info = (3, 9)", "softneck FMU: it needs Python 3.11 or newer; this host runs"),
    ],
    ids=["numpy", "version"],
)
def test_a_host_that_lacks_something_is_told_at_instantiation(change: str, message: str, lag_fmu: Path) -> None:
    with unpacked(lag_fmu) as folder:
        script = _HOST.format(change=change)
        child = subprocess.run([sys.executable, "-c", script, str(folder)], capture_output=True, text=True, check=False)
    assert message in child.stderr
    assert "refused: Failed to instantiate model" in child.stdout
    assert child.returncode == 0


def test_a_runtime_that_takes_the_slave_s_names_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from softneck.fmu.python._module import slave_module

    text = "import numpy as np\n\n\ndef _fmu_print(a):\n    return a\n\n\ndef step(a, b, c, d, e):\n    return None\n"
    text += "\n\ndef state_size(a):\n    return 0\n"
    (tmp_path / "toy_clash_runtime.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SettingsError, match="defines _fmu_print"):
        slave_module("toy_clash_runtime")
