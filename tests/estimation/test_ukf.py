"""The unscented filter: equal to the linear one on linear models, better than holding on the virtual neck."""

from __future__ import annotations

import math
import runpy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, UkfObserver, UkfPart, consistency, ukf
from softneck.identification import Model, Network, Play, Rls
from softneck.loop import BlockPart, Loop, StepReference, run_loop
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import State
from softneck.signals import Recording, signal

from ..data import ROOT
from .necks import changed, neck

DISTURBED = KalmanSettings(disturbance_noise_std=math.radians(0.3))


@pytest.fixture(scope="module")
def training() -> Recording:
    return record(signal("eq22", duration=60.0), VirtualNeck(NeckParameters.paper()), seed=1)


@pytest.fixture(scope="module")
def test_run() -> Recording:
    return record(signal("eq22", duration=16.0), VirtualNeck(NeckParameters.paper()), seed=7)


@pytest.fixture(scope="module")
def second_order(training: Recording) -> Model:
    return Rls(na=2).fit([training])


@pytest.fixture(scope="module")
def play(training: Recording) -> Model:
    return Play(rate=6.0, widths=(0.3,), degree=2, ridge=1e-4).fit([training])


@pytest.mark.slow
@pytest.mark.parametrize("settings", [DISTURBED, replace(DISTURBED, sensor_delay=0.04)], ids=["in time", "40 ms late"])
def test_over_a_linear_model_it_is_the_linear_filter(
    second_order: Model, test_run: Recording, settings: KalmanSettings
) -> None:
    """The unscented transform is exact for linear systems; an ARX model of order 2 has two angles as its state."""
    spoilt = changed(test_run, list(range(3, 800, 5)), math.nan, "pitch")
    spoilt = changed(spoilt, slice(600, 640), math.nan, "roll")
    linear = settings.design(second_order).estimate(spoilt)
    unscented = ukf(second_order, settings)
    assert unscented.memory == 2
    told = unscented.estimate(spoilt)
    # They start from other covariances, which fades with the filter's poles; below 1e-9 rad after 8 s.
    late = slice(400, None)
    for name, size in (("pitch", 1e-9), ("roll", 1e-9), ("pitch_rate", 1e-7), ("aligned", 1e-9), ("covariance", 1e-12)):
        np.testing.assert_allclose(getattr(told, name)[late], getattr(linear, name)[late], rtol=0, atol=size)
    # An innovation of 2 has some 1e-3 rad below it.
    np.testing.assert_allclose(told.innovation[late], linear.innovation[late], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(told.accepted, linear.accepted)
    np.testing.assert_array_equal(told.healthy, linear.healthy)


@pytest.mark.slow
def test_its_nis_and_nees_are_those_of_the_linear_filter(training: Recording) -> None:
    model, part = Rls().fit([training]), training.rows(0, 600)
    noise = math.radians(0.05) * np.random.default_rng(2).standard_normal((2, 600))
    measured = {f"{a}_measured": part.channels[a] + e for a, e in zip(("pitch", "roll"), noise, strict=True)}
    part = part.with_channels(**measured)
    settings = replace(DISTURBED, sensor_delay=0.02)
    ours, theirs = (consistency(o, part, settle=300) for o in (ukf(model, settings), settings.design(model)))
    assert ours.nees is not None
    assert theirs.nees is not None
    # Both filters have forgotten their starts to 1e-9 rad, of some 1e-3 rad that an innovation of 1 stands for.
    assert ours.nis.mean == pytest.approx(theirs.nis.mean, rel=1e-5)
    assert ours.nees.mean == pytest.approx(theirs.nees.mean, rel=1e-5)
    assert "over rls, 20 ms" in ukf(model, settings).summary()


@pytest.mark.slow
def test_a_first_order_model_needs_one_angle_and_gains_nothing_from_more(training: Recording) -> None:
    model, part = Rls().fit([training]), training.rows(0, 400)
    one, three = ukf(model, DISTURBED), ukf(model, DISTURBED, memory=3)
    assert one.memory == 1
    # Rounding only: the further angles have no say.
    np.testing.assert_allclose(_angles(one, part), _angles(three, part), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_over_nonlinear_models_it_bridges_what_is_missing() -> None:
    """20 % dropouts and blackouts of 0.6 s on the virtual neck, as `examples/nonlinear_filter.py` prints them."""
    script: dict[str, Any] = runpy.run_path(str(ROOT / "examples" / "nonlinear_filter.py"))
    found = script["results"](script["scenario"](), Network(iterations=10, starts=1, refine=5))
    held, linear = np.array(found["raw, held"]), np.array(found["linear (rls)"])
    for name in ("unscented, play", "unscented, nn"):
        # Seen: 1.7 and 5.5 deg held, 0.24 and 0.74 linear, below 0.1 and 0.2 unscented.
        assert (np.array(found[name]) < 0.1 * held).all(), name
        assert (np.array(found[name]) < linear).all(), name


@pytest.mark.slow
def test_outliers_are_refused_and_a_lasting_change_is_taken_in_by_force(play: Model, test_run: Recording) -> None:
    test_run, observer = test_run.rows(0, 480), ukf(play)
    spoilt = changed(test_run, [300], 1.5, "pitch")
    estimates = observer.estimate(spoilt)
    assert not estimates.accepted[300]
    assert estimates.accepted[[299, 301]].all()
    left_out = observer.estimate(changed(test_run, [300], math.nan, "pitch"))
    # Gate or gap: the same filter, but for the wrong value.
    np.testing.assert_array_equal(estimates.pitch[300:310], left_out.pitch[300:310])
    shifted = test_run.channels["pitch"].copy()
    shifted[380:] += math.radians(25.0)
    estimates = observer.estimate(test_run.with_channels(pitch=shifted))
    assert not estimates.accepted[380:390].any()
    assert estimates.accepted[390]
    # 25 deg in a sample are no motion of a neck: the disturbance takes them up to the noise of the measurement.
    assert np.abs(estimates.pitch[440:] - shifted[440:]).max() < math.radians(0.5)


def test_its_state_is_plain_numbers_from_which_it_goes_on(play: Model, test_run: Recording) -> None:
    observer = ukf(play, replace(DISTURBED, sensor_delay=0.02, order="jacobi"), memory=4)
    spoilt = changed(test_run.rows(0, 60), slice(20, 24), math.nan, "pitch", "roll")
    # A Jacobi loop gives the set-points of now, a sample younger than a sequential one.
    rows = np.column_stack([spoilt.set_points, spoilt.outputs, np.ones(60)])
    state, outputs = observer.initial_state(), []
    for k, row in enumerate(rows):
        if k == 30:
            # As a file would give it back, to another filter of the same settings.
            state = State(np.frombuffer(state.values.tobytes()), state.parameters, state.outputs)
            observer = UkfObserver(observer.model, observer.settings, observer.memory)
        state, y = observer.step(state, row)
        outputs.append(y)
    whole = observer.estimate(spoilt)
    assert np.isfinite(state.values).all()
    np.testing.assert_array_equal(np.array(outputs)[:, 0], whole.pitch)
    np.testing.assert_array_equal(np.array(outputs)[:, 3], whole.roll_rate)


def test_both_orders_of_a_loop_give_the_same_estimates(play: Model, test_run: Recording) -> None:
    """What a Jacobi loop gives a sample earlier the filter keeps for a sample; without delay nothing else differs."""
    part = test_run.rows(0, 80)
    sequential, jacobi = (ukf(play, KalmanSettings(order=order), memory=2) for order in ("sequential", "jacobi"))
    np.testing.assert_array_equal(sequential.estimate(part).innovation, jacobi.estimate(part).innovation)


@pytest.mark.slow
def test_it_closes_the_loop_over_dropouts_and_its_part_resumes(play: Model, training: Recording) -> None:
    part = UkfPart(ukf(play, memory=8))
    result = run_loop(
        Loop(
            plant=BlockPart(VirtualNeck(replace(NeckParameters.paper(), dropout_rate=0.5, dropout_time=0.1)).block()),
            controller=BlockPart(PiSettings().design(Rls().fit([training])).block()),
            observer=part,
            reference=StepReference(pitch=np.radians(15.0), at=1.0),
            duration=8.0,
        )
    )
    # Integral action takes the mean to 15 deg; noise of 0.05 deg and creep of the neck remain.
    assert np.degrees(np.mean(result["pitch"][result.time > 6.0])) == pytest.approx(15.0, abs=0.5)
    assert np.isfinite(result["pitch_estimate"]).all()
    row = np.array([0.5, 0.2, 0.1, 0.2, 0.1, 1.0])
    saved = part.get_state()
    once = part.advance(8.0, row)
    part.set_state(saved)
    np.testing.assert_array_equal(part.advance(8.0, row), once)
    with pytest.raises(DataError, match="the state has 1 values"):
        part.set_state(bytes(8))
    with pytest.raises(SettingsError, match="not a parameter of an unscented filter"):
        part.start(0.0, {"measurement_noise_std": 1e-3})


def _angles(observer: UkfObserver, recording: Recording) -> np.ndarray:
    told = observer.estimate(recording)
    return np.column_stack([told.pitch, told.roll])


def test_there_is_no_fmu_of_it(play: Model) -> None:
    with pytest.raises(SettingsError, match="there is no FMU of it"):
        ukf(play).block()


@pytest.mark.parametrize(
    ("settings", "memory", "message"),
    [
        (KalmanSettings(form="gyro"), None, "form gyro has no meaning"),
        (KalmanSettings(steady=True), None, "constant gains has no meaning"),
        (KalmanSettings(sample_time=0.01), None, "must be the model's, 0.02 s"),
        (KalmanSettings(sensor_delay=0.015), None, "`sensor_delay` 0.015 s must be whole samples"),
        (KalmanSettings(), 0, "`memory` must be"),
        (KalmanSettings(), 13, "`memory` must be"),
    ],
)
def test_wrong_settings_are_refused(play: Model, settings: KalmanSettings, memory: int | None, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        ukf(play, settings, memory=memory)


def test_what_is_no_identified_model_and_wrong_data_are_refused(play: Model, test_run: Recording) -> None:
    with pytest.raises(SettingsError, match=r"needs an identified model.*got LinearNeck"):
        ukf(neck())  # pyright: ignore[reportArgumentType]
    observer = ukf(play)
    with pytest.raises(DataError, match="takes 6 inputs"):
        observer.step(observer.initial_state(), [0.0, 0.0, math.nan, 0.0, 0.0, 1.0])
    with pytest.raises(DataError, match="start it anew"):
        observer.step(State(np.zeros(3), np.zeros(0), np.zeros(6)), np.zeros(6))
    other = Recording(test_run.time / 2.0, 0.01, dict(test_run.channels))
    with pytest.raises(DataError, match=r"has sample time 0.01 s, the model 0.02 s"):
        observer.estimate(other)
