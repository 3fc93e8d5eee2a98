"""Studies: the same numbers whoever runs them, nothing lost, and what the runs say."""

from __future__ import annotations

import dataclasses
import math
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from softneck.core import FileFormatError, SettingsError, load
from softneck.cosim import (
    load_loop,
    load_study,
    make_loop,
    make_study,
    pareto_front,
    rank,
    read_runs,
    simulate,
    study,
    worst_runs,
)
from softneck.cosim.loops._loop_table import loop_table
from softneck.cosim.studies._run_study import failed_row
from softneck.cosim.studies._store import Store, read_study_description, write_worst
from softneck.loop._faults import make_fault
from softneck.loop._result import metric_names
from softneck.report import study_page
from softneck.robot import Robot
from softneck.robot._file import preset_text
from softneck.runtime import Port

from ..references import StepReference
from .study_parts import Gain, Lag

LOOP = """
duration_s = 1.0
[plant]
python = "study_parts:Lag"
parameters = { pole = 0.9 }
[controller]
python = "study_parts:Gain"
[reference]
kind = "step"
pitch_deg = 10.0
at_s = 0.2
[[fault]]
kind = "sensor_bias"
size_deg = 1.0
start_s = 0.6
[limits]
"pitch.overshoot_pct" = 20.0
"""
STUDY = """
loop = "loop.toml"
runs = 24
seed = 7
[vary]
"plant.parameters.pole" = { uniform = [0.85, 0.95] }
"controller.parameters.gain" = { grid = [2.0, 6.0] }
reference.pitch_deg = { choices = [5.0, 15.0] }
"fault.0.size_rad" = { normal = [0.02, 0.01] }
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a loop file, its parts and a study file."""
    shutil.copy(Path(__file__).with_name("study_parts.py"), tmp_path)
    (tmp_path / "loop.toml").write_text(LOOP)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


METRICS = metric_names(Robot.preset())


def numbers(runs: Any) -> pd.DataFrame:
    """All but how long it took."""
    return runs.drop(columns="seconds")


def test_a_run_is_its_loop(place: Path) -> None:
    """Every row holds what `simulate` says of the loop of that run."""
    made = load_study(place / "study.toml")
    runs: Any = study(made, workers=0)
    assert list(runs["run"]) == list(range(24))
    assert (runs["error"] == "").all()
    for run in (0, 5, 23):
        result = simulate(made.setup(run))
        for metric in METRICS:
            group, _, name = metric.partition(".")
            value = result.metrics[group][name]
            assert runs.loc[run, metric] == value or (value is None and np.isnan(runs.loc[run, metric])), metric
        assert bool(runs.loc[run, "holds"]) is result.holds


@pytest.mark.slow
def test_workers_change_no_bit(place: Path) -> None:
    made = load_study(place / "study.toml")
    here = numbers(study(made, workers=0))
    for workers in (1, 2):
        pd.testing.assert_frame_equal(here, numbers(study(made, workers=workers)), check_exact=True)


@pytest.mark.slow
def test_blocks_go_to_other_processes(folder: Path) -> None:
    """A loop of objects: a model, its filter and controller; compiled rows, and the bits of the ordinary loop."""
    parts: dict[str, Any] = {name: load(folder / f"{file}.npz") for name, file in
                             (("plant", "rls"), ("observer", "kalman"), ("controller", "pi"))}  # fmt: skip
    loop = {"duration_s": 1.0, **parts, "reference": StepReference(pitch=0.1, at=0.2)}
    vary = {"reference": {"grid": {"small": StepReference(pitch=0.05), "large": StepReference(pitch=0.2)}},
            "observer.parameters.noise_std": {"log_uniform": [1e-4, 1e-2]}}  # fmt: skip
    if "noise_std" not in {port.name for port in parts["observer"].block().parameters}:
        name = parts["observer"].block().parameters[0].name
        vary = {"reference": vary["reference"], f"observer.parameters.{name}": {"log_uniform": [1e-4, 1e-2]}}
    runs: Any = study(loop, vary=vary, runs=6, workers=1)
    made = make_study(loop, vary=vary, runs=6)
    for run in range(6):
        assert runs.loc[run, "pitch.iae"] == simulate(made.setup(run)).metrics["pitch"]["iae"]
    assert list(runs["reference"][:2]) == ["small", "large"]


def test_a_loop_object_and_its_table_are_one(folder: Path, loop_file: Path) -> None:
    """Whatever makes a loop, its table makes the same one again."""
    for setup in (load_loop(loop_file), make_loop({
        "duration_s": 0.5, "plant": str(folder / "rls.npz"), "controller": str(folder / "pi.npz"),
        "reference": {"kind": "sine", "pitch_deg": 5.0, "frequency_hz": 0.5}, "limits": {"pitch.iae": 1.0},
        "fault": [{"kind": "sensor_bias", "size_deg": 1.0, "start_s": 0.2},
                  {"kind": "sensor_dropout", "axis": "roll", "start_s": 9.0},
                  {"kind": "motor_slow", "motor": 2, "rate_deg_s": 30.0, "duration_s": 0.2}],
    })):  # fmt: skip
        again = make_loop(loop_table(setup), ".")
        assert again.loop.faults == setup.loop.faults
        assert again.limits == setup.limits
        first, second = simulate(setup), simulate(again)
        for name, values in first.signals.signals.items():
            assert values.tobytes() == second[name].tobytes(), name


def test_every_fault_has_keys_again() -> None:
    from softneck.loop._faults import fault_keys

    push = make_fault("push", {"x_n": 2.0, "y_n": 1.0, "start_s": 1.0, "duration_s": 0.5})
    for fault in (push, make_fault("payload_step", {"payload_kg": 0.5}), make_fault("motor_stuck", {"motor": 3})):
        keys = fault_keys(fault)
        assert make_fault(str(keys.pop("kind")), keys) == fault


def test_a_failing_run_is_recorded_and_the_study_goes_on(place: Path) -> None:
    vary = {"plant.parameters.fails": [0.0, 1.0], "plant.parameters.pole": [0.8, 0.9]}
    runs: Any = study(place / "loop.toml", vary=vary, workers=1)
    assert list(runs["error"] != "") == [False, False, True, True]
    assert runs["error"][2] == "the lag was told to fail"
    assert runs["pitch.iae"].notna().tolist() == [True, True, False, False]
    assert rank(runs, ["pitch.iae"])["run"].tolist()[2:] == [2, 3]


def test_values_out_of_range_fail_their_run_alone(place: Path) -> None:
    runs: Any = study(place / "loop.toml", vary={"reference.pitch_deg": [10.0, 60.0]}, workers=0)
    assert runs["error"][0] == ""
    assert "must be within" in runs["error"][1]


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(place: Path) -> None:
    """The process dies once, in the middle of a run; all runs are there, as if nothing had been."""
    vary = {"plant.parameters.once": [0.0, 1.0], "plant.parameters.pole": {"uniform": [0.8, 0.9]}}
    runs: Any = study(place / "loop.toml", vary=vary, runs=20, workers=2)
    assert (place / "died").exists()
    assert runs["run"].tolist() == list(range(20))
    assert (runs["error"] == "").all()
    pd.testing.assert_frame_equal(numbers(runs), numbers(study(place / "loop.toml", vary=vary, runs=20, workers=1)))


@pytest.mark.slow
def test_a_run_that_always_kills_its_worker_is_named(place: Path) -> None:
    runs: Any = study(place / "loop.toml", vary={"plant.parameters.deadly": [0.0, 1.0, 0.2, 0.3]}, workers=2)
    assert runs["run"].tolist() == list(range(4))
    dead = runs["plant.parameters.deadly"] == 1.0
    assert (runs["error"] != "").equals(dead)
    assert runs.loc[dead, "error"].str.contains("worker process died").all()


def test_resume_goes_on_where_it_stood(place: Path) -> None:
    made = load_study(place / "study.toml")
    whole: Any = study(made, workers=0)
    store = Store(made, place / "out")
    rows: Any = whole.to_dict("records")
    store.add([{**row, "holds": bool(row["holds"])} for row in rows[3:9]])
    assert read_runs(place / "out")["run"].tolist() == list(range(3, 9))
    runs: Any = study(made, workers=0, output=place / "out")
    pd.testing.assert_frame_equal(numbers(whole), numbers(runs), check_exact=True)
    assert runs["seconds"][3:9].tolist() == whole["seconds"][3:9].tolist()  # not run again
    assert sorted(path.name for path in (place / "out").iterdir()) == ["runs.csv", "study.json"]
    assert study(made, workers=0, output=place / "out")["seconds"].tolist() == runs["seconds"].tolist()


def test_runs_read_back_to_the_bit(place: Path) -> None:
    names = {"1": 0.85, "NA": 0.86, 'a,"b"': 0.87, " two  words\r": 0.88}
    made = make_study(
        place / "loop.toml", vary={"plant.parameters.pole": {"grid": names}, "reference.pitch_deg": [1, 2]}
    )
    store = Store(made, place / "out")
    values = [0.1 + 0.2, 5e-324, -0.0, math.inf, -math.inf, None, 1.7976931348623157e308, 1e22 / 3]
    for run, value in enumerate(values):
        row = failed_row(made.points[run], 'a "fault", in\ntwo \udcff lines\0' + "x" * 200_000, METRICS)
        store.add([row | {METRICS[0]: value, "holds": (True, False, None)[run % 3]}])
    for table in (read_runs(place / "out"), store.finish(), read_runs(place / "out")):
        assert [repr(cell) for cell in table[METRICS[0]]] == [repr(math.nan if v is None else v) for v in values]
        assert table["plant.parameters.pole"].tolist() == [
            name for name in ("1", "NA", 'a,"b"', "two words") for _ in "12"
        ]
        assert table["reference.pitch_deg"].tolist() == [1, 2] * 4
        assert [None if pd.isna(cell) else cell for cell in table["holds"]] == [
            (True, False, None)[k % 3] for k in range(8)
        ]
        assert table["error"].str.startswith('a "fault", in two ').all()


def test_a_folder_of_another_study(place: Path) -> None:
    made = load_study(place / "study.toml")
    study(made, workers=0, output=place / "out")
    before = {path.name: path.read_bytes() for path in (place / "out").iterdir()}
    (place / "study.toml").write_text(STUDY.replace("seed = 7", "seed = 8"))
    with pytest.raises(SettingsError, match=r"holds another study \(other seed\)"):
        study(place / "study.toml", workers=0, output=place / "out")
    assert {path.name: path.read_bytes() for path in (place / "out").iterdir()} == before
    study(load_study(place / "study.toml"), workers=0, output=place / "out", force=True)
    assert (place / "out" / "study.json").read_bytes() != before["study.json"]


def test_a_changed_file_is_another_study(folder: Path, tmp_path: Path) -> None:
    for name in ("rls.npz", "pi.npz"):
        shutil.copy(folder / name, tmp_path)
    loop = {
        "duration_s": 0.4,
        "plant": "rls.npz",
        "controller": "pi.npz",
        "reference": {"kind": "step", "pitch_deg": 5.0},
    }
    made = make_study(loop, vary={"reference.pitch_deg": [1.0, 2.0]}, folder=tmp_path)
    before = made.digest
    (tmp_path / "pi.npz").write_bytes((folder / "kalman.npz").read_bytes())
    assert made.digest != before


def test_worst_cases_are_loop_files_with_the_same_metrics(place: Path) -> None:
    made = load_study(place / "study.toml")
    runs: Any = study(made, workers=0)
    paths = write_worst(made, runs, place / "out" / "deep" / "worst", count=2)
    for path, row in zip(paths, worst_runs(runs, made.objectives, 2).to_dict("records"), strict=True):
        result = simulate(load_loop(path))
        assert path.name == f"run_{row['run']:05d}.toml"
        for metric in METRICS:
            group, _, name = metric.partition(".")
            # The same table, read back from text: Python writes floats so that they come back to the bit.
            assert row[metric] == result.metrics[group][name] or np.isnan(row[metric]), metric


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("plant.parameters.mass", "no key `plant.parameters.mass`: the plant has deadly, fails, gain"),
        ("plant.mass", "write plant.parameters.NAME"),
        ("observer.parameters.noise_std", "no observer"),
        ("reference.yaw_deg", "`yaw_deg` is not part of a step reference"),
        ("fault.0.payload_kg", "`payload_kg` is not part of a sensor_bias"),
        ("fault.1.size_deg", r"its \[\[fault\]\] tables: 1 \(fault.0\)"),
        ("part.filter.file", r"its \[\[part\]\] tables: none"),
        ("limits", "no key `limits`"),
        ("payload", "no key `payload`"),
    ],
)
def test_keys_that_the_loop_does_not_have(key: str, message: str, place: Path) -> None:
    with pytest.raises(SettingsError, match=message):
        study(place / "loop.toml", vary={key: {"uniform": [0.0, 1.0]}}, runs=2, workers=0, output=place / "out")
    assert not (place / "out").exists()


def test_other_settings_that_cannot_be(place: Path) -> None:
    vary = {"reference.pitch_deg": [1.0, 2.0]}
    with pytest.raises(SettingsError, match="not a metric that can be an objective"):
        study(place / "loop.toml", vary=vary, objectives=["pitch.error"])
    with pytest.raises(SettingsError, match="`workers` must be a whole number"):
        study(place / "loop.toml", vary=vary, workers=-1)
    with pytest.raises(SettingsError, match="not both"):
        study(place / "loop.toml", vary=vary, workers=1, dask="tcp://127.0.0.1:1")
    (place / "study.toml").write_text(f"size = 3\n{STUDY}")
    with pytest.raises(SettingsError, match=r"unknown key `size` of a study"):
        load_study(place / "study.toml")
    with pytest.raises(SettingsError, match="cannot be sent to another process"):
        study({**{"duration_s": 0.2, "plant": "paper", "reference": StepReference()}, "controller": _Unsendable()},
              vary={"order": ["sequential", "jacobi"]}, workers=1)  # fmt: skip


class _Unsendable:
    """A part that holds what no process can send."""

    role, sample_time, inputs = "controller", 0.02, ()

    def __init__(self) -> None:
        from softneck.runtime import Port

        self.outputs = tuple(Port(name=f"motor_setpoint_{j}", unit="rad") for j in (1, 2, 3))
        self.lock = threading.Lock()

    def start(self, time: float, parameters: Any) -> Any:  # noqa: ARG002
        return np.zeros(3)

    def advance(self, time: float, inputs: Any) -> Any:  # noqa: ARG002
        return np.zeros(3)

    def close(self) -> None: ...


def test_the_front_holds_all_that_nobody_beats() -> None:
    """Against the definition, pair by pair."""
    rng = np.random.default_rng(0)
    values = np.round(rng.uniform(size=(200, 3)), 1)  # ties on purpose
    values[5, 1] = np.nan
    runs: Any = pd.DataFrame(values, columns=["a", "b", "c"]).assign(error="", run=range(200))
    runs.loc[7, "error"] = "failed"
    good = [i for i in range(200) if i not in (5, 7)]
    beaten = {i for i in good for j in good if (values[j] <= values[i]).all() and (values[j] < values[i]).any()}
    assert set(pareto_front(runs, ["a", "b", "c"])["run"]) == set(good) - beaten


def test_ranking_puts_limits_before_objectives() -> None:
    runs = pd.DataFrame({"run": range(4), "error": ["", "", "", "x"], "holds": [False, True, True, False],
                         "m": [0.0, 2.0, 1.0, np.nan]}).astype({"holds": "boolean"})  # fmt: skip
    assert rank(runs, ["m"])["run"].tolist() == [2, 1, 0, 3]
    assert worst_runs(runs, ["m"], 2)["run"].tolist() == [3, 0]
    with pytest.raises(SettingsError, match="not a column of the runs"):
        rank(runs, ["n"])


def test_the_virtual_neck_needs_no_fmu(folder: Path, tmp_path: Path) -> None:
    """`neck` names a preset or a neck file, at the loop's sample time."""
    (tmp_path / "stiff.toml").write_text("bending_stiffness = 0.9\n")
    text = 'duration_s = 0.5\nsample_time_s = 0.02\nfolder = "{folder}"\n[plant]\nneck = "{neck}"\n'
    text += (
        '[observer]\nfile = "kalman.npz"\n[controller]\nfile = "pi.npz"\n[reference]\nkind = "step"\npitch_deg = 5.0\n'
    )
    found = {}
    for neck in ("paper", str(tmp_path / "stiff.toml")):
        (tmp_path / "loop.toml").write_text(text.format(folder=folder, neck=neck))
        found[neck] = simulate(load_loop(tmp_path / "loop.toml"))["pitch"]
    (tmp_path / "loop.toml").write_text(text.format(folder=folder, neck="paper"))
    setup = load_loop(tmp_path / "loop.toml")
    stiff = dataclasses.replace(setup.loop, plant_parameters={"bending_stiffness": 0.9})
    np.testing.assert_array_equal(simulate(stiff)["pitch"], found[str(tmp_path / "stiff.toml")])
    assert np.abs(found["paper"] - found[str(tmp_path / "stiff.toml")]).max() > 1e-3
    (tmp_path / "loop.toml").write_text(text.format(folder=folder, neck="rubber"))
    with pytest.raises(FileFormatError, match=r"\[plant\]: there is no file .*rubber"):
        load_loop(tmp_path / "loop.toml")


@pytest.mark.slow
def test_parts_vary_by_their_files(folder: Path) -> None:
    """Plants and controllers on a grid: an identified model, the virtual neck, an FMU of it; each run is its loop."""
    loop = {"duration_s": 0.5, "plant": "rls.npz", "observer": "kalman.npz", "controller": "pi.npz",
            "reference": {"kind": "step", "pitch_deg": 5.0}}  # fmt: skip
    vary = {
        "plant": ["rls.npz", "paper", "VirtualNeck.fmu"],
        "controller.file": ["pi.npz"],
        "reference.roll_deg": [0.0, 2.0],
    }
    made = make_study(loop, vary=vary, folder=folder)
    runs: Any = study(made, workers=0)
    assert runs["error"].tolist() == [""] * 6
    assert runs["plant"].tolist() == ["rls.npz"] * 2 + ["paper"] * 2 + ["VirtualNeck.fmu"] * 2
    assert not list(Path(tempfile.gettempdir()).glob("softneck-*/**/*.so"))  # no FMU is left unpacked
    for run in range(6):
        # FMUs were reset between runs, and came out as new ones do.
        assert runs.loc[run, "pitch.iae"] == simulate(made.setup(run)).metrics["pitch"]["iae"], run
    with pytest.raises(FileFormatError, match="there is no file"):
        study(make_study(loop, vary={"controller.file": ["pi.npz", "none.npz"]}, folder=folder), workers=0)


class Tank(Lag):
    """Of the robot below: its level follows the first of two pressures."""

    inputs = tuple(Port(name=f"motor_setpoint_{j}", unit="Pa") for j in (1, 2))
    outputs = (Port(name="level", unit="m"),)

    def start(self, time_s: float, parameters: Any) -> np.ndarray:
        super().start(time_s, {"gain": 1e-7, **parameters})
        return np.zeros(1)

    def advance(self, time_s: float, inputs: np.ndarray) -> np.ndarray:
        return super().advance(time_s, inputs)[:1]


class Valve(Gain):
    """The first pressure is the gain times the error of the level."""

    inputs = (Port(name="level_reference", unit="m"), Port(name="level", unit="m"))
    outputs = Tank.inputs

    def start(self, time_s: float, parameters: Any) -> np.ndarray:
        return super().start(time_s, {"gain": 4e6, **parameters})[:2]

    def advance(self, time_s: float, inputs: np.ndarray) -> np.ndarray:
        return super().advance(time_s, inputs)[:2]


def test_a_study_goes_by_the_outputs_and_units_of_its_robot(tmp_path: Path) -> None:
    tank = Robot.from_dict({
        "name": "tank", "motors": {"names": ["a", "b"], "unit": "bar"}, "outputs": {"names": ["level"], "unit": "mm"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    loop = {
        "duration_s": 1.0, "plant": Tank(), "controller": Valve(), "robot": tank,
        "reference": {"kind": "step", "level": 43.0}, "limits": {"level.rms_error_mm": 50.0},
    }  # fmt: skip
    made = make_study(loop, vary={"reference.level": {"grid": [41.0, 44.0]}})
    assert made.objectives == ("level.rms_error_mm", "motors.total_variation_bar")
    runs: Any = study(made, workers=0, output=tmp_path / "out")
    assert (runs["error"] == "").all()
    for run in (0, 1):
        for group, table in simulate(made.setup(run)).metrics.items():
            for name, value in table.items():
                found = runs.loc[run, f"{group}.{name}"]
                assert found == value or (value is None and np.isnan(found)), name
    # What goes by the step is as large a part of each; what is in mm goes with it.
    assert runs.loc[0, "level.rms_error_mm"] / 41.0 == pytest.approx(runs.loc[1, "level.rms_error_mm"] / 44.0)
    assert not {"pitch.rms_error_deg", "motors.max_rad"} & set(runs.columns)
    page = study_page(read_study_description(tmp_path / "out"), runs)
    assert "has level.rms_error_mm" in page
    with pytest.raises(SettingsError, match=r"`pitch.rms_error_deg` is not a metric .*level.rise_s.*motors.max_bar"):
        make_study(loop, vary={}, objectives=["pitch.rms_error_deg"])


def test_a_study_of_fmus_is_of_the_robot_beside_its_loop(tmp_path: Path) -> None:
    """Their loop file alone is of that robot as well."""
    (tmp_path / "robot.toml").write_text(preset_text("antagonist"))
    parts = 'duration_s = 1.0\nplant = { fmu = "p.fmu" }\ncontroller = { fmu = "c.fmu" }\n'
    (tmp_path / "loop.toml").write_text(parts + '[reference]\nkind = "step"\npitch_deg = 5.0\n')
    made = make_study(tmp_path / "loop.toml", vary={})
    assert made.loop["robot"] == "robot.toml"
    assert not [name for name in made.metrics if name.startswith("roll")]
