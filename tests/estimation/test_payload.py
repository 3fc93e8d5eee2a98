"""The observer over a model of several payloads: an extended filter with the payload as one more state."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from softneck.core import load
from softneck.estimation import KalmanSettings, NonlinearObserver, consistency
from softneck.estimation._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE
from softneck.estimation._observer import fit_levels_and_delays
from softneck.estimation._offline import run_filter
from softneck.identification import GreyBox, Model
from softneck.identification.structured._loaded_greybox_runtime import loaded_neck
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import State
from softneck.signals import Recording, signal

from ..foreign_necks.necks import ForeignNeck
from ..foreign_necks.necks import record as record_foreign
from .necks import jumping, ramped, without

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

NOISE, REST, RATIO, START = math.radians(0.05), math.radians(0.1), 0.6, math.radians(40.0)
STEP = 0.02
# All is taken in, and the estimate is of the measurement's instant.
PLAIN = KalmanSettings(sensor_delay=0.0)


def log(payload: float, rows: int = 800, seed: int = 1) -> Recording:
    played = signal("eq22", duration=rows * 0.02)
    found = record(played, VirtualNeck(NeckParameters.paper()), seed=seed, payload=payload)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.fixture(scope="module")
def model() -> Model:
    """Two coarse steps of the search: enough for a law, not for a fit."""
    return GreyBox(evaluations=2, sensor_delay=2).fit([log(0.0), log(1.0)])


@pytest.fixture(scope="module")
def run() -> Recording:
    return log(0.6, 400, 7)


def designed(settings: KalmanSettings, model: Model) -> NonlinearObserver:
    found = settings.design(model)
    assert isinstance(found, NonlinearObserver)
    return found


def plain(settings: KalmanSettings, model: Model) -> NonlinearObserver:
    return without(designed(settings, model), KALMAN_GATE, KALMAN_FROZEN)


def test_a_jump_moves_both_copies_as_a_ramp_of_the_motors_rate_does(model: Model, run: Recording) -> None:
    slow = plain(PLAIN, model)
    free = replace(slow, slew=None)
    told, expected = slow.estimate(jumping(run)), free.estimate(ramped(jumping(run), 15.6))
    np.testing.assert_array_equal(told.outputs, expected.outputs)
    np.testing.assert_array_equal(told.covariance, expected.covariance)


class _Copy:
    """The model in free run, whose payload may change at any time."""

    def __init__(self, model: Model, payload: float, motors: np.ndarray) -> None:
        self.block = model.block()
        self.state = self.block.initial_state(use_measurement=0.0, payload=payload)
        for _ in range(300):
            self.move(motors, payload)

    def move(self, motors: np.ndarray, payload: float) -> np.ndarray:
        inputs = np.full(len(self.block.inputs), np.nan)
        inputs[:3] = motors
        parameters = self.state.parameters.copy()
        parameters[-1] = payload
        self.state, out = self.block.step(State(self.state.values, parameters, self.state.outputs), inputs)
        return out[:2].copy()


def test_it_is_filterpys_extended_filter(model: Model, run: Recording) -> None:
    # At the heaviest payload, where it begins, the coarse model is so wrong that the gate would refuse less noise.
    observer = plain(replace(PLAIN, measurement_noise_std=20.0 * NOISE), model)
    # Walk of a tenth of the range, 1 kg, in a second.
    walk = 0.1 * math.sqrt(0.02)
    # It begins at the heaviest.
    payload, Z, U = 1.0, run.outputs, run.set_points
    thought, more = _Copy(model, payload, U[0]), _Copy(model, payload + STEP, U[0])
    # Disturbances, timing errors of one sample that last for some seconds, and the payload.
    kept = float(observer.walk_start[2])
    ekf: Any = ExtendedKalmanFilter(dim_x=5, dim_z=2)
    ekf.P, ekf.R = np.diag([START**2, START**2, 1.0, 1.0, 1.0]), (20.0 * NOISE) ** 2 * np.eye(2)
    ekf.F = np.diag([1.0, 1.0, kept, kept, 1.0])
    ekf.x, fastest, told, masses = np.zeros(5), 0.0, [], []
    for k, z in enumerate(Z):
        held = U[max(k - 1, 0)]
        before = thought.state.outputs[:2].copy()
        y, beside = thought.move(held, payload), more.move(held, payload + STEP)
        fastest = max(0.95 * fastest, float(np.abs(y - before).max()))
        H = np.column_stack([np.eye(2), np.diag(y - before), (beside - y) / STEP])
        ekf.Q = np.diag([REST**2 + (RATIO * fastest) ** 2] * 2 + [1.0 - kept**2] * 2 + [walk**2])
        ekf.predict()
        ekf.update(z - y, lambda _, H=H: H, lambda x, H=H: H @ x)
        payload, ekf.x[4] = float(np.clip(payload + ekf.x[4], 0.0, 1.0)), 0.0
        told.append(y + H @ ekf.x)
        masses.append(payload)
    outputs, _ = run_filter(observer, run)
    # One Joseph form against one without, over 400 samples.
    np.testing.assert_allclose(outputs[:, -1], masses, rtol=0, atol=1e-8)
    np.testing.assert_allclose(outputs[:, :2], told, rtol=0, atol=1e-9)
    assert np.ptp(masses) > 0.1


def test_of_one_payload_it_is_the_filter_over_the_model_of_that_payload(model: Model, run: Recording) -> None:
    arrays = {name: array for name, array in model.arrays.items() if name != "payload"}
    bare = replace(model, arrays={**arrays, "neck": loaded_neck(arrays["neck"], model.arrays["payload"], 0.4)})
    one = replace(model, arrays={**model.arrays, "payload": np.r_[0.4, 0.4, model.arrays["payload"][2:]]})
    ours, theirs = plain(PLAIN, one).estimate(run), plain(PLAIN, bare).estimate(run)
    # The outputs one after the other, and both at once.
    np.testing.assert_allclose(ours.outputs, theirs.outputs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9)
    np.testing.assert_allclose(ours.innovation, theirs.innovation, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.log_det, theirs.log_det, rtol=1e-9, atol=1e-12)


def test_what_is_not_measured_tells_nothing_of_the_payload(model: Model, run: Recording) -> None:
    dark = run.with_channels(pitch=np.full(len(run), math.nan))
    outputs, states = run_filter(designed(KalmanSettings(), model), dark)
    assert (outputs[:, -1] == 1.0).all()
    assert (outputs[200:, 5] == 0.0).all()
    assert np.isfinite(states).all()


def test_an_outlier_moves_neither_angle_nor_payload(model: Model, run: Recording) -> None:
    observer = designed(KalmanSettings(sensor_delay=0.0), model)
    hit, gap = run.outputs.copy(), run.outputs.copy()
    hit[300], gap[300] = 1.0, math.nan
    told = [run_filter(observer, run.with_channels(pitch=z[:, 0], roll=z[:, 1]))[0] for z in (hit, gap)]
    np.testing.assert_array_equal(told[0][300:, [0, 1, 6]], told[1][300:, [0, 1, 6]])


@pytest.mark.parametrize("factor", [0.2, 3.0])
def test_the_payload_stays_between_those_of_the_recordings(model: Model, run: Recording, factor: float) -> None:
    far = run.with_channels(pitch=factor * run.channels["pitch"], roll=factor * run.channels["roll"])
    masses = run_filter(plain(PLAIN, model), far)[0][:, -1]
    assert masses.min() >= 0.0
    assert masses.max() <= 1.0
    assert {0.0, 1.0} & set(masses)


def test_a_jacobi_loop_gives_it_the_set_points_a_sample_early(model: Model, run: Recording) -> None:
    rows = [run_filter(plain(replace(PLAIN, order=order), model), run)[0] for order in ("sequential", "jacobi")]
    np.testing.assert_array_equal(rows[0][:, [0, 1, 6]], rows[1][:, [0, 1, 6]])


def test_a_step_of_the_sensor_is_believed_after_so_many_refusals(model: Model, run: Recording) -> None:
    """By force, and then wholly: what was refused ten times is where the neck is."""
    shift = np.where(np.arange(len(run)) < 300, 0.0, 0.5)
    moved = run.with_channels(pitch=run.channels["pitch"] + shift, roll=run.channels["roll"] + shift)
    outputs, _ = run_filter(designed(KalmanSettings(sensor_delay=0.0), model), moved)
    error = np.abs(outputs[:, :2] - moved.outputs).max(axis=1)
    assert error[309] > math.radians(10.0)
    # The innovation's gain is all but one, of 28 deg.
    assert error[310] < math.radians(0.1)


def test_its_file_says_the_payload(model: Model, run: Recording, tmp_path: Path) -> None:
    observer = designed(KalmanSettings(), model)
    observer.save(tmp_path / "o.npz")
    again = load(tmp_path / "o.npz", role="observer")
    np.testing.assert_array_equal(again.estimate(run).outputs, observer.estimate(run).outputs)
    assert [port.name for port in again.block().outputs][-2:] == ["healthy", "payload"]
    assert "0 to 1 kg" in again.summary()
    assert consistency(observer, run).mean > 0.0


def test_levels_from_data_are_kept_only_where_they_are_better(model: Model) -> None:
    """Beside the payload that the observer itself estimates; the rows are not those of the model's training."""
    found = fit_levels_and_delays(designed(KalmanSettings(), model), [log(0.6, 700, 11)])
    assert found.checks[found.kept] == min(found.checks.values())
    assert set(found.checks) == {"default", "noise"}
    assert not {"rest_noise_std", "motion_noise_ratio"} <= set(found.not_identifiable) - set(found.fit.at_bound)


@pytest.mark.slow
def test_it_finds_what_hangs_on_a_neck_of_other_equations() -> None:
    """A third of the range while the neck moves far, and an angle as if the payload were known."""

    def foreign(payload: float, seed: int, rows: int) -> Recording:
        return record_foreign(signal("eq22"), ForeignNeck(name="column", seed=1), seed=seed, payload=payload).rows(
            0, rows
        )

    several = GreyBox(sensor_delay=2).fit([foreign(payload, 1, 2000) for payload in (0.0, 0.4, 0.8)])
    rng = np.random.default_rng(0)
    settings = KalmanSettings(sensor_delay=0.0, measurement_noise_std=math.radians(0.25))
    for payload in (0.0, 0.6):
        true = foreign(payload, 9, 1000)
        z = true.outputs + math.radians(0.25) * rng.standard_normal((1000, 2))
        z[rng.random(1000) < 0.2] = z[600:650] = math.nan
        outputs, _ = run_filter(designed(settings, several), true.with_channels(pitch=z[:, 0], roll=z[:, 1]))
        error = np.degrees(outputs[100:, :2] - true.outputs[100:])
        assert abs(outputs[500:, -1] - payload).max() < 0.27
        assert np.sqrt((error**2).mean()) < 0.4
