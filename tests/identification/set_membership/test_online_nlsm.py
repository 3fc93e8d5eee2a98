"""The kind that learns while it runs, against Algorithm 1 over the same rows, `nlsm` and `OnlineCones`."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load
from softneck.core._kinds import make_settings
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.identification import Model, OnlineCones, SetMembership
from softneck.identification.models._model import _input_rows
from softneck.identification.models._regressors import regression
from softneck.identification.set_membership._online_nlsm import OnlineSetMembership
from softneck.runtime import State, load_runtime
from softneck.runtime._bundle import declared
from softneck.runtime._layout import Arrays, StateVector
from softneck.signals import Recording

from ...data import neck_recording
from .hard_sets import algorithm_1

ROWS = 120
EPSILON, WEIGHT = 0.002, 10.0


@cache
def online(capacity: int = 1000) -> Model:
    return OnlineSetMembership(capacity=capacity, epsilon=EPSILON, output_weight=WEIGHT).fit(
        neck_recording(200, seed=3)
    )


@cache
def still() -> Model:
    return SetMembership(epsilon=EPSILON, output_weight=WEIGHT).fit(neck_recording(200, seed=3))


@cache
def changed() -> Recording:
    """Motions that the set has not seen, of a neck that bends half as far again: bounds break."""
    recording = neck_recording(ROWS, seed=8)
    return recording.with_channels(**{name: 1.5 * recording.channels[name] for name in ("pitch", "roll")})


@cache
def other() -> Recording:
    """The same with samples that were missed."""
    pitch = changed().channels["pitch"].copy()
    pitch[[40, 41, 70]] = np.nan
    return changed().with_channels(pitch=pitch)


def ran(model: Model, rows: int = ROWS) -> tuple[State, np.ndarray]:
    """Return state and outputs after so many rows with measurements, from rest."""
    block = model.block()
    return block.run(block.initial_state(use_measurement=1.0), _input_rows(other(), "measured")[:rows])


def part(model: Model, state: State, name: str) -> np.ndarray:
    runtime = model.block().runtime
    named = declared(runtime, Arrays)(list(model.block().arrays))
    return state.values[declared(runtime, StateVector).parts(named)[name]]


def learnable(model: Model, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return scaled regressors (N, n) and outputs (N,) of the rows whose whole history was measured, by training."""
    y, H = other().outputs[:, axis], int(model.arrays["history"][0])
    X, targets = regression(changed(), model.arrays["table"], axis)
    first = ROWS - len(targets)
    known = [k for k in range(max(H, first), ROWS) if np.isfinite(y[k - H : k + 1]).all()]
    return np.array([X[k - first] * model.arrays["scale"] for k in known]), y[known]


def by_algorithm_1(model: Model, axis: int, capacity: int) -> tuple[float, int]:
    """Return the epsilon that the rows ask for, and how many points tell something; row by row over all points."""
    gamma, epsilon = model.arrays["bounds"][axis]
    W, v = model.arrays["points"][axis].T, model.arrays["values"][axis]
    learnt: list[tuple[np.ndarray, float]] = []
    for w, y in zip(*learnable(model, axis), strict=True):
        kept = learnt[-capacity:]
        points = np.vstack([W, *(point[None] for point, _ in kept)])
        low, high = algorithm_1(w, points, np.append(v, [value for _, value in kept]), gamma, 0.0)
        epsilon += max(y - high - epsilon, low - epsilon - y, 0.0)
        if not low >= y >= high:
            learnt.append((w, y))
    return epsilon, len(learnt)


def test_without_a_measurement_it_is_nlsm_to_the_bit() -> None:
    free = _input_rows(other(), "measured", outputs=False)
    for model in (online(), still()):
        assert np.isnan(free[:, 3:5]).all(), model.kind
    seen, expected = (
        model.block().run(model.initial_state(other()), free)[1] for model in (online(), still())
    )  # the start is a neck that is held, as if measured: nothing is learnt of that
    np.testing.assert_array_equal(seen, expected)
    told = _input_rows(other(), "measured")
    seen, expected = (m.block().run(m.block().initial_state(use_measurement=0.0), told)[1] for m in (online(), still()))
    np.testing.assert_array_equal(seen, expected)


@pytest.mark.parametrize("capacity", [1000, 6])
def test_it_learns_what_algorithm_1_over_the_same_rows_does(capacity: int) -> None:
    model = online(capacity)
    state, _ = ran(model)
    for axis in range(2):
        epsilon, learnt = by_algorithm_1(model, axis, capacity)
        # Sums of squares in one order or another: some ulp of cones of a radian.
        assert part(model, state, "widened")[axis] == pytest.approx(epsilon - EPSILON, abs=1e-12)
        assert part(model, state, "widened")[axis] > 0.0
        assert part(model, state, "learnt")[axis] == learnt > 6


def test_the_bounds_contain_all_that_was_learnt_and_all_that_it_started_from() -> None:
    model = online()
    state, _ = ran(model)
    for axis in range(2):
        cones = as_cones(model, state, axis)
        X, y = learnable(model, axis)
        X, y = np.vstack([X, model.arrays["points"][axis].T]), np.append(y, model.arrays["values"][axis])
        low, high = cones.bounds(X)
        assert (low - 1e-12 <= y).all()
        assert (y <= high + 1e-12).all()  # rounding, as above


def as_cones(model: Model, state: State, axis: int) -> OnlineCones:
    """Return `OnlineCones` fed the points of the set and then the rows learnt, with the epsilon of now."""
    gamma, epsilon = model.arrays["bounds"][axis]
    cones = OnlineCones(epsilon=float(epsilon + part(model, state, "widened")[axis]) + 1e-12, gamma=float(gamma))
    cones.add(model.arrays["points"][axis].T, model.arrays["values"][axis])
    cones.add(*learnable(model, axis))
    # No row denies the gamma that was identified: that is what epsilon has grown for.
    assert cones.gamma[0] == gamma
    return cones


def test_its_bounds_are_those_of_online_cones_fed_the_same_rows() -> None:
    model = online()
    state, outputs = ran(model)
    for axis in range(2):
        w = part(model, state, "awaited").reshape(2, -1)[axis]
        low, high = as_cones(model, state, axis).bounds(w[None])
        # 1e-12 more epsilon and rounding.
        np.testing.assert_allclose(outputs[-1, 5 + 2 * axis : 7 + 2 * axis], [low[0], high[0]], rtol=0, atol=1e-11)


def test_plain_python_and_any_cut_replay_to_the_bit() -> None:
    block, rows = online(6).block(), _input_rows(other(), "measured")
    end, whole = ran(online(6))
    state, first = block.run(block.initial_state(use_measurement=1.0), rows[:50])
    last, second = block.run(state, rows[50:])
    np.testing.assert_array_equal(np.vstack([first, second]), whole)
    np.testing.assert_array_equal(last.values, end.values)
    plain, values = np.zeros_like(whole), block.initial_state(use_measurement=1.0).values.copy()
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, end.parameters, values, rows, plain)
    np.testing.assert_array_equal(plain, whole)
    np.testing.assert_array_equal(values, end.values)


@pytest.mark.slow
def test_fmus_of_both_backends_learn_the_same(tmp_path: Path) -> None:
    from softneck.cosim.parts._free_run import drive_fmu

    if shutil.which("cc") is None:
        pytest.skip("no C compiler here")
    block, rows = online(6).block(), _input_rows(other(), "measured")
    start = block.initial_state(use_measurement=1.0)
    expected = np.vstack([start.outputs, ran(online(6))[1][:-1]])
    given = {port.name: rows[:, i] for i, port in enumerate(block.inputs)}
    for build in (build_fmu, build_compiled_fmu):
        path = tmp_path / f"{build.__name__}.fmu"
        build(block, path)
        seen = drive_fmu(path, given, parameters={"use_measurement": 1.0})
        np.testing.assert_array_equal(seen, expected)


def test_learning_makes_one_step_ahead_better() -> None:
    def error(model: Model) -> float:
        return float(np.nanmean((model.predict(other())[:, :2] - other().outputs) ** 2))

    assert error(online()) < error(still())


def test_a_file_keeps_it_and_bad_ones_are_refused(tmp_path: Path) -> None:
    online(6).save(tmp_path / "o.npz")
    opened = load(tmp_path / "o.npz")
    np.testing.assert_array_equal(ran(opened)[1], ran(online(6))[1])
    for name, bad, words in (("learning", np.array([0.5]), "points that may be learnt"), ("b", np.ones((2, 1)), "b")):
        replace(opened, arrays={**opened.arrays, name: bad}).save(tmp_path / f"{name}.npz")
        with pytest.raises(FileFormatError, match=words):
            load(tmp_path / f"{name}.npz")
    for setting, given in (("capacity", 0), ("form", "residual"), ("epsilon", -1.0)):
        with pytest.raises(SettingsError, match=setting):
            make_settings(OnlineSetMembership, {setting: given})
