"""An FMU that nobody here wrote, FMI 2 and 3: as a plant by a name mapping, isolated, crashing, hanging."""

from __future__ import annotations

import math
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError
from softneck.cosim import FmuError, FmuPart, IsolatedPart, load_loop, shown_name, simulate
from softneck.cosim.loops._loop_file import LoopSetup
from softneck.loop import BlockPart, Loop, SensorFault

from ..references import StepReference
from ._foreign import NAMES, build_foreign

TS = 0.02
LOOP = """
duration_s = 2.0
[plant]
fmu = "Foreign{version}.fmu"
names = {{ u1 = "motor_setpoint_1", u2 = "motor_setpoint_2", u3 = "motor_setpoint_3", alpha = "pitch", beta = "roll" }}
sample_time_s = 0.02
parameters = {{ T = 0.3 }}
isolated = {isolated}
[controller]
fmu = "Pi.fmu"
[reference]
kind = "step"
pitch_deg = 5.0
at_s = 0.1
"""


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("foreign")
    return {version: build_foreign(folder, version) for version in (2, 3)}


def plant(path: Path, kind: type = FmuPart, **more: Any) -> Any:
    return kind(path, role="plant", sample_time=TS, names=NAMES, **more)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("kind", [FmuPart, IsolatedPart])
def test_the_linear_plant_gives_its_known_answer(version: int, kind: type, foreign: dict[int, Path]) -> None:
    part = plant(foreign[version], kind)
    assert [(port.name, port.unit) for port in part.outputs] == [("pitch", "deg"), ("roll", "deg")]
    part.start(0.0, {"T": 0.4, "k": 8.0})
    seen = [part.advance(k * TS, np.array([1.0, 0.5, -0.5])) for k in range(50)]
    part.close()
    n = np.arange(1, 51)
    rise = 1.0 - (1.0 - TS / 0.4) ** n
    # Forward Euler of a first-order lag is a geometric series; 50 roundings.
    np.testing.assert_allclose(np.array(seen), np.column_stack([8.0 * rise, 8.0 * rise]), rtol=1e-13)


@pytest.mark.parametrize("version", [2, 3])
def test_it_closes_a_loop_with_our_controller_and_its_degrees_are_converted(
    version: int, foreign: dict[int, Path], fmus: Path, tmp_path: Path
) -> None:
    for path in (foreign[version], fmus / "Pi.fmu"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    results = []
    for isolated in ("false", "true"):
        file = tmp_path / "loop.toml"
        file.write_text(LOOP.format(version=version, isolated=isolated))
        results.append(simulate(load_loop(file)))
    for name, values in results[0].signals.signals.items():
        np.testing.assert_array_equal(results[1][name], values, err_msg=name)
    result = results[0]
    assert result.frame["pitch [deg]"].iloc[-1] == pytest.approx(5.0, abs=0.5)  # a PI loop: it arrives
    u = result["motor_setpoint_1"] - 0.5 * (result["motor_setpoint_2"] + result["motor_setpoint_3"])
    y = np.zeros(100)
    for k in range(99):
        y[k + 1] = y[k] + TS / 0.3 * (10.0 * u[k] - y[k])
    np.testing.assert_allclose(result["pitch"], np.radians(y), rtol=1e-12, atol=1e-14)
    # Metrics judge radians against radians, whatever the FMU speaks.
    error = np.degrees(result["pitch_reference"]) - y
    assert result.metrics["pitch"]["rms_error_deg"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)


@pytest.mark.parametrize("version", [2, 3])
def test_faults_of_the_sensor_work_on_it(version: int, foreign: dict[int, Path], toys: Any) -> None:
    loop = Loop(
        plant=plant(foreign[version]), controller=BlockPart(toys.pi()), reference=StepReference(pitch=0.1),
        duration=1.0, faults=(SensorFault(kind="bias", axis="pitch", size=math.radians(2.0), start=0.5),),
    )  # fmt: skip
    result = simulate(loop)
    bias = result["pitch_measured"] - result["pitch"]
    np.testing.assert_allclose(bias, np.where(result.signals.time > 0.49, np.radians(2.0), 0.0), atol=1e-13)


# A child process takes a second or two to start: not every kind of trouble with every version.
@pytest.mark.parametrize(
    ("version", "mode", "message"),
    [
        pytest.param(2, 1.0, r"crashed in the step from t = 0\.2 s: its process was ended by SIGABRT", id="crash"),
        pytest.param(
            3,
            2.0,
            r"hung in the step from t = 0\.2 s: no answer within 0\.5 s; its process was ended",
            id="hang",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            2, 4.0, r"in the step from t = 0\.2 s: fmi2DoStep returned an error", id="error", marks=pytest.mark.slow
        ),
    ],
)
def test_a_bad_fmu_costs_one_run_only(
    version: int, mode: float, message: str, foreign: dict[int, Path], toys: Any
) -> None:
    part = plant(foreign[version], IsolatedPart, timeout=0.5)
    good = Loop(plant=part, controller=BlockPart(toys.pi()), reference=StepReference(pitch=0.1), duration=0.4)
    bad = Loop(
        plant=part, controller=BlockPart(toys.pi()), reference=StepReference(pitch=0.1), duration=0.4,
        plant_parameters={"mode": mode},
    )  # fmt: skip
    with pytest.raises(FmuError, match=message) as caught:
        simulate(bad)
    assert "\n" not in str(caught.value)
    assert np.isfinite(simulate(good)["pitch"]).all()
    assert not list(Path(tempfile.gettempdir()).glob("softneck-child-*"))


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_that_ends_itself_leaves_its_rows(version: int, foreign: dict[int, Path], toys: Any) -> None:
    def loop(mode: float, part: Any) -> LoopSetup:
        parts = {"plant": part, "controller": BlockPart(toys.pi()), "reference": StepReference(pitch=0.1)}
        plain = Loop(**parts, duration=0.4, plant_parameters={"mode": mode})
        return LoopSetup(loop=plain, limits={"pitch.overshoot_pct": 1e6})

    whole = simulate(loop(0.0, plant(foreign[version])))
    assert (len(whole.signals.time), whole.holds, whole.signals.ended) == (20, True, "")
    for kind in (FmuPart, *([IsolatedPart] if version == 2 else [])):
        result = simulate(loop(5.0, plant(foreign[version], kind)))
        assert len(result.signals.time) == 10  # whole rows before the step from 0.2 s
        for name, values in result.signals.signals.items():
            np.testing.assert_array_equal(values, whole[name][:10], err_msg=name)
        assert not result.holds  # of a run that was not finished nothing is known
        assert "in the step from t = 0.2 s it asked to end the simulation" in result.remarks[0]


def test_nan_and_errors_of_an_fmu_name_it(foreign: dict[int, Path], toys: Any) -> None:
    part = plant(foreign[2])
    for mode, error, message in ((3, DataError, "output `pitch` of the plant became nan"), (4, FmuError, "DoStep")):
        loop = Loop(
            plant=part, controller=BlockPart(toys.pi()), reference=StepReference(pitch=0.1), duration=0.4,
            plant_parameters={"mode": mode},
        )  # fmt: skip
        with pytest.raises(error, match=message):
            simulate(loop)


def test_an_instance_that_is_kept_is_reset_not_loaded_again(foreign: dict[int, Path], fmus: Path) -> None:
    part = plant(foreign[2])
    loop = Loop(plant=part, controller=FmuPart(fmus / "Pi.fmu"), reference=StepReference(pitch=0.1), duration=0.4)
    first = simulate(loop, keep=True)
    native = part._native
    second = simulate(loop, keep=True)
    assert part._native is native is not None
    loop.close()
    third = simulate(loop)
    for other in (second, third):
        np.testing.assert_array_equal(other["pitch"], first["pitch"])
    assert part._native is None


def test_arrays_of_fmi3_are_named_as_arrays(foreign: dict[int, Path], tmp_path: Path) -> None:
    sizes = b'<Dimension start="3"/><Dimension valueReference="7"/>'
    array = b'<Float64 name="w" valueReference="90" causality="input" start="0">' + sizes + b"</Float64>"
    path = tmp_path / foreign[3].name
    with zipfile.ZipFile(foreign[3]) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                data = data.replace(b"</ModelVariables>", array + b"</ModelVariables>")
            new.writestr(name, data)
    shown = [shown_name(v) for v in fmpy.read_model_description(str(path), validate=False).modelVariables]
    assert [name for name in shown if "[" in name] == ["w[3][mode]"]
    assert "w" not in [port.name for port in plant(path).inputs]
    with pytest.raises(FileFormatError, match="`w` is an array; the variables of a part are single numbers"):
        FmuPart(path, role="plant", sample_time=TS, names={"w": "motor_setpoint_1"})


def test_units_may_be_given_and_wrong_mappings_are_refused(foreign: dict[int, Path]) -> None:
    assert plant(foreign[2], units={"motor_setpoint_1": "deg"}).inputs[0].unit == "deg"
    with pytest.raises(FileFormatError, match="a unit is given for `yaw`, which is not one of its variables"):
        plant(foreign[2], units={"yaw": "deg"})
    with pytest.raises(FileFormatError, match="u1 and u2 are both named `a`"):
        FmuPart(foreign[3], role="plant", sample_time=TS, names={"u1": "a", "u2": "a"})
    with pytest.raises(SettingsError, match="states no step size"):
        FmuPart(foreign[3], role="plant", names=NAMES)
