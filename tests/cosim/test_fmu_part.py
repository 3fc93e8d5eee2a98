"""An FMU as a part: equal to the block it was made of, and clear about what it cannot do."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError
from softneck.cosim import FmuError, FmuPart, simulate_fmu
from softneck.cosim.parts._fmu_part import drive_fmu
from softneck.loop import BlockPart, Part
from softneck.signals import Recording

TS = 0.02


def _unpacked_folders() -> set[Path]:
    return set(Path(tempfile.gettempdir()).glob("softneck-unpacked-*"))


@pytest.mark.parametrize(("name", "block"), [("Lag", "lag"), ("Gain", "controller"), ("Neck", "neck"), ("Pi", "pi")])
def test_an_fmu_part_is_its_block(name: str, block: str, fmus: Path, toys: Any) -> None:
    original = getattr(toys, block)()
    ours: Part = BlockPart(original)
    fmu: Part = FmuPart(fmus / f"{name}.fmu")
    assert [(p.name, p.unit, p.boolean, p.missing) for p in fmu.inputs] == [
        (p.name, "1" if p.boolean else p.unit, p.boolean, p.missing) for p in ours.inputs
    ]
    assert [p.name for p in fmu.outputs] == [p.name for p in ours.outputs]
    assert (fmu.sample_time, fmu.role) == (ours.sample_time, ours.role)
    u = 0.3 * np.random.default_rng(0).standard_normal((100, len(fmu.inputs)))
    if block == "lag":
        u[:, 1] = u[:, 1] > 0.0
        u[::3, 2] = np.nan
    np.testing.assert_array_equal(fmu.start(1.0, {}), ours.start(1.0, {}))
    for k, row in enumerate(u):
        # The FMU carries the same text of the runtime: equal to the bit.
        np.testing.assert_array_equal(fmu.advance(1.0 + k * TS, row), ours.advance(1.0 + k * TS, row))
    fmu.close()


def test_parameters_of_both_types_take_effect(fmus: Path, toys: Any) -> None:
    parameters = {"pitch_start": 0.3, "noise_std": 0.1, "noise_seed": 5.0, "biased": True}
    state = toys.lag().initial_state(**parameters)
    with FmuPart(fmus / "Lag.fmu") as part:
        np.testing.assert_array_equal(part.start(0.0, parameters), state.outputs)


def test_a_part_starts_again_and_leaves_nothing(fmus: Path) -> None:
    before = _unpacked_folders()
    part = FmuPart(fmus / "Lag.fmu")
    row = np.array([1.0, 1.0, np.nan])
    seen = []
    for _ in range(3):
        part.start(0.0, {"noise_std": 0.1})
        seen.append([part.advance(k * TS, row).tolist() for k in range(5)])
    part.close()
    part.close()
    assert seen[0] == seen[1] == seen[2]
    assert _unpacked_folders() == before
    with pytest.raises(FmuError, match="is not running"):
        part.advance(0.0, row)


def test_an_error_carries_the_fmu_s_own_reason_and_the_part_lives_on(fmus: Path) -> None:
    with FmuPart(fmus / "Lag.fmu") as part:
        part.start(0.0, {})
        for _ in range(10):
            with pytest.raises(
                FmuError, match=r"Lag\.fmu: in the step from t = 0 s: .*motor_setpoint_1 was set to nan"
            ):
                part.advance(0.0, np.array([np.nan, 1.0, 0.0]))
        np.testing.assert_array_equal(part.start(0.0, {"pitch_start": 0.5}), [0.5, 1.0])
        with pytest.raises(FmuError, match="noise_std must be between 0 and 1"):
            part.start(0.0, {"noise_std": 3.0})
        with pytest.raises(SettingsError, match=r"`nonsense` is not a parameter of .*it has pitch_start"):
            part.start(0.0, {"nonsense": 3.0})


def test_each_part_keeps_its_own_log(fmus: Path) -> None:
    with FmuPart(fmus / "Gain.fmu") as one, FmuPart(fmus / "Gain.fmu") as two:
        one.start(0.0, {})
        two.start(0.0, {})
        one.advance(0.0, np.array([15.0, 0.0]))
        assert [text for _, text in one.messages] == [
            "Gain: pitch_reference = 15 is outside -0.8 to 0.8 rad. Is it in degrees?"
        ]
        assert not two.messages


def _changed(source: Path, target: Path, change: Callable[[str, bytes], tuple[str, bytes] | None]) -> Path:
    """Write a copy of an FMU whose members went through `change`."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            member = change(name, old.read(name))
            if member is not None:
                new.writestr(*member)
    return target


def _description(old: bytes, new: bytes) -> Callable[[str, bytes], tuple[str, bytes]]:
    def change(name: str, data: bytes) -> tuple[str, bytes]:
        if name == "modelDescription.xml":
            assert old in data
            data = data.replace(old, new)
        return name, data

    return change


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (b'fmiVersion="2.0"', b'fmiVersion="1.0"', FileFormatError, "is an FMI 1.0 FMU|cannot be read"),
        (b"<CoSimulation ", b"<ScheduledExecution ", FileFormatError, "is for no interface only; export it for Co-"),
        (b"<ModelVariables>", b"<ModelVariables", FileFormatError, "cannot be read"),
        (b' stepSize="0.02"', b"", SettingsError, "states no step size"),
        (b' stepSize="0.02"', b' stepSize="0. 02"', FileFormatError, "`0. 02` where a number is needed"),
        (b'Tool name="softneck"', b'Tool name="else"', SettingsError, "give its role in the loop"),
    ],
    ids=["version", "exchange", "damaged", "step", "no number", "role"],
)
def test_fmus_that_cannot_be_used_are_refused_with_a_reason(
    old: bytes, new: bytes, error: type[Exception], message: str, fmus: Path, tmp_path: Path
) -> None:
    path = _changed(fmus / "Lag.fmu", tmp_path / "Lag.fmu", _description(old, new))
    with pytest.raises(error, match=message):
        FmuPart(path)


def test_a_foreign_fmu_needs_role_and_sample_time_only(fmus: Path, tmp_path: Path) -> None:
    path = _changed(fmus / "Lag.fmu", tmp_path / "Lag.fmu", _description(b'Tool name="softneck"', b'Tool name="x"'))
    with FmuPart(path, role="plant", names={"motor_setpoint_1": "drive"}) as part:
        assert part.inputs[0].name == "drive"
        part.start(0.0, {})
    with pytest.raises(FileFormatError, match="has no variable speed; it has biased"):
        FmuPart(path, role="plant", names={"speed": "drive"})
    with pytest.raises(SettingsError, match="`role` must be one of plant"):
        FmuPart(path, role="wheel")


def test_an_fmu_for_another_platform_names_those_it_has(fmus: Path, tmp_path: Path) -> None:
    path = _changed(
        fmus / "Lag.fmu", tmp_path / "Lag.fmu", lambda name, data: None if "linux64" in name else (name, data)
    )
    with pytest.raises(FileFormatError, match=r"no binary for this platform \(linux64\); it has win64"):
        FmuPart(path)


def test_a_binary_that_does_not_load_is_said_so(fmus: Path, tmp_path: Path) -> None:
    path = _changed(
        fmus / "Lag.fmu", tmp_path / "Lag.fmu", lambda name, data: (name, b"no library" if "linux64" in name else data)
    )
    with pytest.raises(FileFormatError, match="its binary cannot be loaded"):
        FmuPart(path).start(0.0, {})


def test_a_wrong_guid_or_a_failing_module_is_an_fmu_error(fmus: Path, tmp_path: Path) -> None:
    path = _changed(
        fmus / "Lag.fmu",
        tmp_path / "Lag.fmu",
        lambda name, data: (name, b"{}" if name.endswith("block.json") else data),
    )
    before = _unpacked_folders()
    part = FmuPart(path)
    with pytest.raises(FmuError, match="instantiate"):
        part.start(0.0, {})
    part.close()
    assert _unpacked_folders() == before


def test_driving_an_fmu_is_running_its_block(fmus: Path, toys: Any) -> None:
    u = np.random.default_rng(0).standard_normal(60)
    block = toys.lag()
    state = block.initial_state(noise_std=0.2)
    _, expected = block.run(state, np.column_stack([u, np.ones(60), np.full(60, np.nan)]))
    expected = np.vstack([state.outputs, expected[:-1]])
    table = drive_fmu(fmus / "Lag.fmu", {"motor_setpoint_1": u}, parameters={"noise_std": 0.2}, start_time=7.0)
    np.testing.assert_array_equal(table, expected)
    pitch = drive_fmu(fmus / "Lag.fmu", {"motor_setpoint_1": u}, parameters={"noise_std": 0.2}, outputs=("pitch",))
    np.testing.assert_array_equal(pitch, expected[:, :1])
    controller = toys.controller()
    _, expected = controller.run(controller.initial_state(), np.column_stack([0.1 * u, np.zeros(60)]))
    np.testing.assert_array_equal(drive_fmu(fmus / "Gain.fmu", {"pitch_reference": 0.1 * u}), expected)


def test_a_free_run_starts_anew_with_each_run(fmus: Path, toys: Any, recording: Recording) -> None:
    block = toys.neck()
    expected = []
    for run in recording.runs():
        state = block.initial_state(pitch_start=0.1)
        _, outputs = block.run(state, np.column_stack([run.set_points, np.zeros(len(run))]))
        expected.append(np.vstack([state.outputs, outputs[:-1]]))
    table = simulate_fmu(fmus / "Neck.fmu", recording, parameters={"pitch_start": 0.1})
    np.testing.assert_array_equal(table, np.concatenate(expected))


def test_driving_with_wrong_names_lengths_or_sample_times_is_refused(fmus: Path, recording: Recording) -> None:
    path = fmus / "Neck.fmu"
    with pytest.raises(DataError, match=r"`speed` is not an input of .*motor_setpoint_1"):
        drive_fmu(path, {"speed": np.zeros(3)})
    with pytest.raises(DataError, match=r"one common length of at least 1; got \[2, 3\]"):
        drive_fmu(path, {"motor_setpoint_1": np.zeros(3), "payload": np.zeros(2)})
    with pytest.raises(DataError, match=r"`yaw` is not an output of .*it has pitch"):
        drive_fmu(path, {"payload": np.zeros(2)}, outputs=("yaw",))
    slow = Recording(2.0 * recording.time, 0.04, recording.channels, recording.run)
    with pytest.raises(DataError, match=r"runs at 0\.02 s and the recording is at 0\.04 s"):
        simulate_fmu(path, slow)


def test_an_fmu_in_a_folder_with_any_name_runs(fmus: Path, tmp_path: Path) -> None:
    place = tmp_path / "a b+c#d%e(é)"
    place.mkdir()
    shutil.copy(fmus / "Neck.fmu", place / "Neck.fmu")
    assert drive_fmu(place / "Neck.fmu", {"payload": np.zeros(2)}).shape == (2, 5)
