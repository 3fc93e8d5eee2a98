"""A loop file describes a loop: the same as one written in Python, and it says what is wrong with it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, SoftneckError, file_hash
from softneck.cosim import FmuPart, load_loop, simulate
from softneck.fmu import build_fmu
from softneck.loop import BlockPart, Loop, NeckFault, SensorFault
from softneck.signals import read_recording, write_recording

from ..references import StepReference
from .conftest import LOOP


def _python_loop(toys: Any, order: str = "sequential") -> Loop:
    return Loop(
        plant=BlockPart(toys.neck()),
        controller=BlockPart(toys.pi()),
        reference=StepReference(pitch=math.radians(15.0), at=1.0),
        duration=4.0,
        order=order,
        plant_inputs={"payload": 0.5},
        plant_parameters={"pitch_start": 0.01},
    )


@pytest.mark.parametrize("order", ["sequential", "jacobi"])
def test_a_loop_over_fmus_is_the_loop_over_their_blocks(order: str, loop_file: Path, toys: Any) -> None:
    loop_file.write_text(f'order = "{order}"\n{loop_file.read_text()}')
    over_fmus = simulate(load_loop(loop_file))
    in_python = simulate(_python_loop(toys, order))
    assert set(over_fmus.signals.signals) == set(in_python.signals.signals)
    for name in in_python.signals.signals:
        np.testing.assert_array_equal(over_fmus[name], in_python[name], err_msg=name)
    assert over_fmus.order == order


def test_jacobi_differs_from_sequential(toys: Any) -> None:
    one, two = simulate(_python_loop(toys)), simulate(_python_loop(toys, "jacobi"))
    assert not np.array_equal(one["pitch"], two["pitch"])


def test_the_result_states_metrics_and_limits(loop_file: Path) -> None:
    result = simulate(load_loop(loop_file))
    assert [(row["metric"], row["limit"]) for row in result.limits] == [
        ("pitch.overshoot_pct", 5.0),
        ("pitch.settling_s", 1.0),
    ]
    assert result.holds
    assert result.real_time_factor > 1.0
    report = result.report()
    assert set(report) == {"metrics", "limits", "real_time_factor"}
    assert set(report["metrics"]) == {"pitch", "roll", "motors"}
    json.dumps(report, allow_nan=False)
    loop_file.write_text(loop_file.read_text().replace('settling_s" = 1.0', 'settling_s" = 0.1'))
    broken = simulate(load_loop(loop_file))
    assert not broken.holds
    assert [row["holds"] for row in broken.limits] == [True, False]


def test_the_frame_and_the_recording_say_their_units(loop_file: Path, tmp_path: Path) -> None:
    result = simulate(load_loop(loop_file))
    frame = result.frame
    assert list(frame.columns[:3]) == ["time [s]", "pitch [deg]", "roll [deg]"]
    assert "motor_setpoint_1 [rad]" in frame.columns
    # degrees(radians(x)) is x but for rounding of the last digit
    np.testing.assert_allclose(np.radians(frame["pitch [deg]"]), result["pitch"], rtol=1e-14)
    np.testing.assert_array_equal(frame["motor_setpoint_2 [rad]"], result["motor_setpoint_2"])
    write_recording(tmp_path / "run.parquet", result.recording())
    back = read_recording(tmp_path / "run.parquet")
    np.testing.assert_allclose(back.outputs[:, 0], result["pitch"], rtol=1e-14)
    np.testing.assert_array_equal(back.set_points[:, 1], result["motor_setpoint_2"])


def test_the_certificate_holds_the_hash_of_every_file(loop_file: Path) -> None:
    setup = load_loop(loop_file)
    expected = {name: file_hash(loop_file.parent / f"{stem}") for name, stem in (
        ("loop", "loop.toml"), ("plant", "Neck.fmu"), ("controller", "Pi.fmu"))}  # fmt: skip
    certificate = simulate(setup).certificate()
    assert {name: file["sha256"] for name, file in certificate["files"].items()} == expected
    assert certificate["holds"] is True
    assert certificate["duration_s"] == pytest.approx(4.0, rel=1e-12)
    json.dumps(certificate, allow_nan=False)


def test_a_recorded_reference_is_followed(loop_file: Path, toys: Any) -> None:
    first = simulate(load_loop(loop_file))
    write_recording(loop_file.parent / "wish.parquet", first.recording())
    text = loop_file.read_text()
    begin, end = text.index("[reference]"), text.index("[limits]")
    loop_file.write_text(f'{text[:begin]}[reference]\nkind = "recording"\nfile = "wish.parquet"\n')
    again = simulate(load_loop(loop_file))
    np.testing.assert_allclose(again["pitch_reference"], first["pitch_reference"], rtol=1e-14)
    assert again.files["reference"][1] == file_hash(loop_file.parent / "wish.parquet")
    assert end > begin


def test_a_plant_written_in_python_stands_beside_the_file(loop_file: Path, toys: Any) -> None:
    (loop_file.parent / "my_loop_parts.py").write_text(
        "import toy_blocks\n\n\ndef plant():\n    return toy_blocks.neck()\n\n\ndef wrong():\n    return 3\n"
    )
    text = loop_file.read_text().replace('fmu = "Neck.fmu"', 'python = "my_loop_parts:plant"')
    loop_file.write_text(text)
    result = simulate(load_loop(loop_file))
    np.testing.assert_array_equal(result["pitch"], simulate(_python_loop(toys))["pitch"])
    assert result.certificate()["files"]["plant"]["path"].endswith("my_loop_parts.py")
    for name, message in (("wrong", "returned a int"), ("absent", "cannot be called"), ("", "cannot be called")):
        loop_file.write_text(text.replace("my_loop_parts:plant", f"my_loop_parts:{name}"))
        with pytest.raises(SettingsError, match=message):
            load_loop(loop_file)


def test_simulate_takes_a_table_a_file_or_a_loop(loop_file: Path, toys: Any) -> None:
    known = simulate(_python_loop(toys))
    table = {
        "duration_s": 4.0, "plant": {"object": toys.neck(), "parameters": {"payload": 0.5, "pitch_start": 0.01}},
        "controller": toys.pi(), "reference": {"kind": "step", "pitch_deg": 15.0, "at_s": 1.0},
    }  # fmt: skip
    for loop in (table, loop_file, str(loop_file), load_loop(loop_file)):
        np.testing.assert_array_equal(simulate(loop)["pitch"], known["pitch"])
    with pytest.raises(SettingsError, match="`duration_s` is missing"):
        simulate({})
    with pytest.raises(FileFormatError, match=r"none\.toml: no such file"):
        simulate("none.toml")
    with pytest.raises(SettingsError, match="`loop` must be a Loop, a loop file or a table of its keys; got a int"):
        simulate(3)  # pyright: ignore[reportArgumentType]


def test_parts_of_one_loop_may_be_mixed(loop_file: Path, toys: Any) -> None:
    mixed = _python_loop(toys)
    mixed = Loop(
        plant=FmuPart(loop_file.parent / "Neck.fmu"),
        controller=mixed.controller,
        reference=mixed.reference,
        duration=mixed.duration,
        plant_inputs=mixed.plant_inputs,
        plant_parameters=mixed.plant_parameters,
    )
    np.testing.assert_array_equal(simulate(mixed)["roll"], simulate(_python_loop(toys))["roll"])


def test_faults_of_the_file_are_those_of_the_loop(loop_file: Path, toys: Any) -> None:
    loop_file.write_text(
        loop_file.read_text()
        + '[[fault]]\nkind = "sensor_bias"\naxis = "pitch"\nsize_deg = 1.0\nstart_s = 2.0\nduration_s = 0.5\n'
        + '[[fault]]\nkind = "payload_step"\npayload_kg = 0.1\nstart_s = 3.0\n'
    )
    setup = load_loop(loop_file)
    assert setup.loop.faults == (
        SensorFault(kind="bias", axis="pitch", size=math.radians(1.0), start=2.0, duration=0.5),
        NeckFault(values={"payload": 0.1}, start=3.0),
    )
    result = simulate(setup)
    bias = result["pitch_measured"] - result["pitch"]
    inside = (result.signals.time > 1.99) & (result.signals.time < 2.49)
    # One rounding of the sum.
    np.testing.assert_allclose(bias, np.where(inside, math.radians(1.0), 0.0), atol=1e-16)
    np.testing.assert_allclose(result["payload"], 0.5 + 0.1 * (result.signals.time > 2.99), rtol=1e-15)


def test_an_fmu_between_reference_and_controller(loop_file: Path, toys: Any) -> None:
    """The toy gain makes a motor set-point of an angle; here its output is what the controller shall follow."""
    build_fmu(toys.controller(gain=0.5), loop_file.parent / "Gain.fmu")
    text = loop_file.read_text()
    loop_file.write_text(
        f'{text}\n[[part]]\nname = "filter"\nfmu = "Gain.fmu"\nnames = {{ motor_setpoint_1 = "wanted" }}\n'
        'parameters = { gain = 0.25, pitch = 0.0 }\n[connections]\n"controller.pitch_reference" = "filter.wanted"\n'
    )
    result = simulate(load_loop(loop_file))
    block = toys.controller(gain=0.5)
    inputs = np.column_stack([result["pitch_reference"], np.zeros(200)])
    _, expected = block.run(block.initial_state(gain=0.25), inputs)
    # Of the same sample: nothing is delayed. Compiled and plain Python differ by rounding.
    np.testing.assert_allclose(result["wanted"], expected[:, 0], rtol=1e-12, atol=1e-15)
    assert set(result.certificate()["files"]) == {"loop", "plant", "controller", "filter"}


def test_the_measured_angle_is_judged_on_request(loop_file: Path) -> None:
    fault = '[[fault]]\nkind = "sensor_bias"\nsize_deg = 5.0\naxis = "roll"\n'
    values = {}
    for angle in ("true", "measured"):
        loop_file.write_text(f'angle = "{angle}"\n{LOOP}{fault}')
        result = simulate(load_loop(loop_file))
        values[angle] = result.metrics["roll"]["rms_error_deg"]
        assert result.certificate()["angle"] == angle
    assert values["true"] != values["measured"]


def _judge(path: Path) -> list[Any]:
    return simulate(load_loop(path)).limits


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration_s = 4.0", "duration = 4.0", "unknown key `duration` of the file; it takes duration_s"),
        ("duration_s = 4.0", "", "`duration_s` is missing"),
        ("duration_s = 4.0", 'duration_s = "4"', "`duration_s` must be a number; got '4'"),
        ("duration_s = 4.0", "duration_s = -1.0", "`duration` must be positive"),
        ("sample_time_s = 0.02", "sample_time_s = 0.01", "the fastest part runs at 0.02 s"),
        ("sample_time_s = 0.02", 'order = "random"', "`order` must be one of sequential, jacobi"),
        ('fmu = "Neck.fmu"', 'fmu = "absent.fmu"', r"\[plant\]: there is no file"),
        ('fmu = "Neck.fmu"', "fmu = 3", r"\[plant\] fmu must be a text"),
        ('fmu = "Neck.fmu"', "", "needs exactly one of fmu, model, neck, python; it has none"),
        ('fmu = "Neck.fmu"', 'fmu = "Neck.fmu"\nmodel = "a.npz"', "it has fmu, model"),
        ('fmu = "Neck.fmu"', 'model = "Neck.fmu"', "is not a softneck file"),
        ('fmu = "Neck.fmu"', 'fmu = "Neck.fmu"\nspeed = 1', r"unknown key `speed` of \[plant\]"),
        ("payload = 0.5", "mass = 0.5", "`mass` is not a parameter"),
        ("payload = 0.5", 'payload = "heavy"', "must be a number; got 'heavy'"),
        ('kind = "step"', 'kind = "jump"', r"\[reference\] kind must be one of step, ramp"),
        ('kind = "step"', 'kind = "recording"', r"unknown key `pitch_deg` of \[reference\]"),
        ("pitch_deg = 15.0", "pitch = 15.0", "may be in rad or deg"),
        ('"pitch.overshoot_pct"', '"pitch.beauty"', "limit on unknown metric `pitch.beauty`"),
        (
            "[limits]",
            "[[fault]]\nkind = 'bias'\n[limits]",
            r"\[\[fault\]\] 1: unknown kind of fault `bias`; use one of sensor_dropout",
        ),
        ("[limits]", "[bounds]", "unknown key `bounds` of the file"),
        ("[limits]", "[[fault]]\nkind = 'push'\ny_n = 1.0\n[limits]", "needs the plant's input `push_y`"),
        ("[limits]", "[fault]\nkind = 'push'\n[limits]", r"`fault` must be a list of tables: \[\[fault\]\]"),
        ("[limits]", "[[part]]\nfmu = 'Pi.fmu'\n[limits]", r"each \[\[part\]\] needs a `name`"),
        (
            "[limits]",
            "[connections]\n'controller.pitch' = 'plant.yaw'\n[limits]",
            "`plant.yaw`: there is no such output",
        ),
        ("[limits]", "[connections]\n'controller.pitch' = 1\n[limits]", "must be a name or a table with `from`"),
        ('fmu = "Neck.fmu"', 'fmu = "Neck.fmu"\nisolated = 1', r"\[plant\] isolated must be true or false"),
        ('fmu = "Neck.fmu"', 'fmu = "Neck.fmu"\nnames = { speed = "pitch" }', "has no variable speed"),
        ('fmu = "Neck.fmu"', 'fmu = "Neck.fmu"\nnames = "pitch"', r"\[plant\] names must be a table of names"),
        ('fmu = "Pi.fmu"', 'fmu = "Pi.fmu"\nsample_time_s = 0.03', "sample times do not divide: plant 0.02 s"),
        ("sample_time_s = 0.02", 'angle = "felt"', "`angle` must be one of true, measured"),
    ],
)
def test_a_wrong_loop_file_is_refused_in_one_line(old: str, new: str, message: str, loop_file: Path) -> None:
    text = loop_file.read_text()
    assert old in text
    loop_file.write_text(text.replace(old, new, 1))
    with pytest.raises(SoftneckError, match=message) as caught:
        _judge(loop_file)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_loop_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        load_loop(tmp_path / "absent.toml")
    (tmp_path / "text.toml").write_text("no = toml =")
    with pytest.raises(FileFormatError, match="is not valid TOML"):
        load_loop(tmp_path / "text.toml")
