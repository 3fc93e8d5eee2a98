"""The parameter object: ranges, sources, files, presets, random necks, and what it refuses."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plant import _index_runtime as index
from softneck.signals import Excitation, signal


def test_the_runtime_reads_each_parameter_where_the_vector_has_it() -> None:
    places = {name[5:].lower(): value for name, value in vars(index).items() if name.startswith("NECK_")}
    expected = {name: place for place, name in enumerate((*NeckParameters.names(), "noise_seed"))}
    # The first of as many angles as there are motors.
    expected = {name: place for name, place in expected.items() if not name.startswith("tendon_angle_")}
    assert places == {**expected, "tendon_angle": 3}


def test_every_parameter_has_unit_range_text_and_source() -> None:
    for name in NeckParameters.names():
        about = NeckParameters.about(name)
        assert about["unit"]
        assert len(about["text"]) > 5
        assert len(about["source"]) > 3
        for preset in ("paper", "lab", "rough", "trunk"):
            assert about["low"] <= getattr(NeckParameters.preset(preset), name) <= about["high"]


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"bending_stiffness": -1.0}, r"`bending_stiffness` must be between 0.01 and 20 \[N m/rad\]; got -1"),
        ({"winch_radius": 0.0}, r"`winch_radius` must be between .* \[m\]; got 0"),
        ({"tendon_stiffness": float("nan")}, r"`tendon_stiffness` must be a finite number \[N/m\]; got nan"),
        ({"link_length": "long"}, r"`link_length` must be a number \[m\]; got 'long'"),
        ({"pretension": 50.0, "tendon_stiffness": 100.0, "bending_stiffness": 5.0}, "shorter than the link allows"),
        ({"compression_limit": 0.1}, "`compression_limit` must be below 0.9 of `link_length`"),
        ({"bending_stiffness": 0.05}, r"must exceed .* N m/rad to carry pretension and platform without buckling"),
    ],
)
def test_unphysical_numbers_are_named_with_value_unit_and_range(changes: dict, what: str) -> None:
    with pytest.raises(SettingsError, match=what):
        dataclasses.replace(NeckParameters.paper(), **changes)


def test_a_file_overrides_a_preset(tmp_path: Path) -> None:
    path = tmp_path / "neck.toml"
    path.write_text('preset = "lab"\nbending_damping = 0.3\npretension = 2\n')
    expected = NeckParameters.lab().replace(bending_damping=0.3, pretension=2.0)
    assert NeckParameters.from_toml(path) == NeckParameters.preset(str(path)) == expected


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("stiffness = 1.0\n", "`stiffness` is not a parameter of the neck"),
        ("winch_radius = -1\n", r"neck.toml: `winch_radius` must be between"),
        ("winch_radius = [1]\n", r"`winch_radius` must be a number \[m\]"),
        ('preset = "v3"\n', "`preset` must be one of paper, lab, rough, trunk; got 'v3'"),
        ("winch_radius = \n", "is not valid TOML"),
        ("\x80", "is not valid TOML"),
    ],
)
def test_a_bad_file_is_refused_by_its_name(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "neck.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises((FileFormatError, SettingsError), match=what) as error:
        NeckParameters.from_toml(path)
    assert str(path) in str(error.value)


def test_a_missing_file_is_named() -> None:
    with pytest.raises(FileFormatError, match=re.escape("nowhere.toml: no such file")):
        NeckParameters.preset("nowhere.toml")


def test_random_necks_differ_repeat_and_stand(tmp_path: Path) -> None:
    first = [NeckParameters.paper().sample(np.random.default_rng(seed)) for seed in range(20)]
    again = [NeckParameters.paper().sample(np.random.default_rng(seed)) for seed in range(20)]
    assert first == again
    assert len({neck.bending_stiffness for neck in first}) == 20
    assert all(neck.winch_radius == NeckParameters.paper().winch_radius for neck in first)
    U = np.zeros((100, 8))
    U[:, :3] = (1.0, -0.5, -0.5)
    for neck in first:
        block = VirtualNeck(neck).block()
        assert 0.03 < block.run(block.initial_state(), U)[1][-1, 0] < 0.3


def test_the_labs_sensors_differ_and_leave_the_neck_alone() -> None:
    paper = NeckParameters.paper()
    one, two = paper.with_sensor("mpu9250"), paper.with_sensor("3dm-gx5")
    assert one.drift_std > 5 * two.drift_std
    assert one.bending_stiffness == two.bending_stiffness == paper.bending_stiffness
    with pytest.raises(SettingsError, match="`sensor` must be one of mpu9250, 3dm-gx5"):
        paper.with_sensor("imu")


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"sample_time": 0.0}, r"`sample_time` must be between 0.001 and 0.1 \[s\]; got 0"),
        ({"internal_step": 0.05}, r"`internal_step` must be between .* got 0.05"),
        ({"noise_seed": -1}, "`noise_seed` must be an integer from 0"),
        ({"noise_seed": 1.5}, "`noise_seed` must be an integer from 0"),
    ],
)
def test_times_and_seeds_that_do_not_fit_are_refused(settings: dict, what: str) -> None:
    with pytest.raises(SettingsError, match=what):
        VirtualNeck(NeckParameters.paper()).block(**settings)


@pytest.mark.parametrize(
    ("value", "what"), [(6.5, "is 6.5 rad at t = 0.04 s"), (np.nan, "is nan rad"), (-np.inf, "is -inf rad")]
)
def test_set_points_beyond_the_limit_or_not_finite_are_refused(value: float, what: str) -> None:
    P = np.zeros((5, 3))
    P[2, 1] = value
    excitation = Excitation("mine", np.arange(5) * 0.02, P)
    with pytest.raises(DataError, match=rf"`motor_setpoint_2` of mine {what}.* within \+-6 rad"):
        record(excitation, VirtualNeck(NeckParameters.paper()))


def test_a_payload_that_no_neck_carries_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"`payload` must be between 0 and 5 \[kg\]; got -1"):
        record(signal("steps"), VirtualNeck(NeckParameters.paper()), payload=-1.0)
