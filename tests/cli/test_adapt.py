"""`softneck identify --from` and `softneck observer --change`: files, JSON, what cannot be; replay of a loop."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.core import load
from softneck.cosim import load_loop, simulate
from softneck.design import PiSettings
from softneck.identification import OutputError, Rls, load_model
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import concatenate, read_recording, signal, write_recording

from .conftest import Call


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A linear model of the virtual neck, motion of it under a payload and without, and a neck that stands."""
    made, neck = tmp_path_factory.mktemp("adapt"), VirtualNeck(NeckParameters.paper())
    model = OutputError().fit(record(signal("eq22", duration=30.0), neck, seed=1))
    model.save(made / "oe.npz")
    Rls().fit(record(signal("eq22", duration=10.0), neck, seed=1)).save(made / "rls.npz")
    PiSettings().design(model).save(made / "pi.npz")
    loaded = record(signal("rotation"), neck, seed=5, payload=1.0)
    write_recording(made / "today.csv", loaded)
    still = {name: np.full(500, 0.5) for name in loaded.robot.set_points}
    write_recording(made / "still.csv", loaded.rows(0, 500).with_channels(**still))
    write_recording(
        made / "quiet.csv", concatenate([record(signal(name), neck, seed=2) for name in ("steps", "sine", "rotation")])
    )
    return made


def test_the_model_that_is_written_is_that_of_python(call: Call, folder: Path) -> None:
    said = call("identify", "oe", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz", "--json")
    assert said.code == 0, said.err
    told = json.loads(said.out)
    assert told["adapted"]
    assert told["fit_after"][0] >= told["fit_before"][0]
    expected = load_model(folder / "oe.npz").adapted(read_recording(folder / "today.csv"))
    for name, array in load_model("new.npz").arrays.items():
        np.testing.assert_array_equal(array, expected.arrays[name])


def test_a_model_that_is_kept_is_said_to_be(call: Call, folder: Path) -> None:
    said = call("identify", "oe", folder / "still.csv", "--from", folder / "oe.npz", "-o", "new.npz")
    assert said.code == 0, said.err
    assert "the old model, kept: the window hardly moves the neck" in said.out
    for name, array in load_model("new.npz").arrays.items():
        np.testing.assert_array_equal(array, load_model(folder / "oe.npz").arrays[name])


def test_what_cannot_be_adapted_is_one_line_and_no_file(call: Call, folder: Path) -> None:
    said = call("identify", "rls", folder / "today.csv", "--from", folder / "rls.npz", "-o", "new.npz")
    assert said.code == 2
    assert "`rls` cannot adapt" in said.error
    assert (
        call(
            "identify", "oe", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz", "--set", "window=0"
        ).code
        == 2
    )
    of_another_kind = call("identify", "rls", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz")
    assert (of_another_kind.code, "is of kind oe, not rls" in of_another_kind.error) == (2, True)
    assert call("identify", "pi", folder / "today.csv", "--from", folder / "pi.npz", "-o", "new.npz").code == 2
    assert not Path("new.npz").exists()


def test_a_change_detector_beside_a_loop_is_replayed_from_its_log_to_the_bit(call: Call, folder: Path) -> None:
    said = call("observer", folder / "oe.npz", "--change", "--data", folder / "quiet.csv", "-o", "change.npz", "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["kind"] == "change"
    Path("loop.toml").write_text(
        'duration_s = 10.0\nsample_time_s = 0.02\n[plant]\nneck = "paper"\nparameters = { payload = 1.0 }\n'
        f'[controller]\nfile = "{folder / "pi.npz"}"\n[reference]\nkind = "rotation"\ninclination_deg = 12.0\n'
        '[[part]]\nname = "watch"\nfile = "change.npz"\n',
        encoding="utf-8",
    )
    result = simulate(load_loop("loop.toml"))
    told = np.column_stack([result.signals[name] for name in ("changed", "since_s", "fit")])
    detector = load("change.npz", role="observer")
    # What the log says: the set-points of one sample before, as the loop's order has them, the measurement of now.
    names = [*(f"motor_setpoint_{j}" for j in (1, 2, 3)), "pitch_measured", "roll_measured", "measurement_valid"]
    rows = np.column_stack([result.signals[name] for name in names])
    rows[1:, :3], rows[0, :3] = rows[:-1, :3].copy(), 0.0
    np.testing.assert_array_equal(detector.block().run(detector.initial_state(), rows)[1], told)


def test_a_change_detector_needs_undisturbed_motion(call: Call, folder: Path) -> None:
    said = call("observer", folder / "oe.npz", "--change", "-o", "change.npz")
    assert said.code == 2
    assert "--change needs --data" in said.error
    assert call("observer", folder / "oe.npz", "--change", "--gyro", "-o", "change.npz").code == 2
