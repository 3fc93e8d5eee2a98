"""The noise ceiling: found from repeats alone, and what a perfect model scores."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import WARM_UP, Rls, validate
from softneck.identification.validation._noise_ceiling import noise_ceiling, noise_deviation
from softneck.signals import Recording, concatenate, signal

from ...data import neck_recording, recording_from
from ._numbers import number

SIGMA = 3e-3


def played(seed: int, *, rows: int = 1000, noise: float = SIGMA) -> Recording:
    """The same experiment, with noise of its own."""
    return recording_from(signal("aprbs", duration=0.02 * rows, seed=4).set_points, noise=noise, seed=seed)


@pytest.mark.parametrize("count", [2, 5])
def test_the_noise_of_repeated_runs_is_found(count: int) -> None:
    recording = concatenate([played(seed) for seed in range(count)])
    # 950 (count - 1) degrees of freedom: 1/sqrt(2 * 950) = 2.3 %, four of these.
    assert noise_deviation(recording) == pytest.approx([SIGMA, SIGMA], rel=0.09)


@pytest.mark.slow
def test_the_ceiling_is_the_fit_of_the_truth() -> None:
    truth, runs = played(0, noise=0.0), [played(seed) for seed in (1, 2, 3)]
    model = Rls(delay=None, max_delay=0.1).fit(recording_from(signal("aprbs", duration=30.0, seed=2).set_points))
    recording = concatenate(runs)
    result = validate(model, recording)
    y = np.concatenate([run.outputs[WARM_UP:] for run in runs])
    e = np.concatenate([(run.outputs - truth.outputs)[WARM_UP:] for run in runs])
    for axis, name in enumerate(("pitch", "roll")):
        perfect = 100 * (1 - np.linalg.norm(e[:, axis]) / np.linalg.norm(y[:, axis] - y[:, axis].mean()))
        # The noise is known to 2 % of what it takes from 100.
        assert 100 - number(result.noise_ceiling[name]) == pytest.approx(100 - perfect, rel=0.06)
        # The model is the truth but for its start, which is measured.
        assert result.fits["inf"][name] == pytest.approx(result.noise_ceiling[name], abs=0.5)
    assert result.as_dict()["fits"]["noise_ceiling"] == result.noise_ceiling


def test_periods_inside_a_run_are_repeats_and_their_transient_is_not() -> None:
    period = signal("multisine", duration=8.0, seed=3).set_points
    recording = recording_from(np.vstack([period] * 4), noise=SIGMA, seed=1)
    # Three of four periods follow the settled start: 800 degrees of freedom, 2.5 %, four of these.
    assert noise_deviation(recording) == pytest.approx([SIGMA, SIGMA], rel=0.1)
    clean = recording_from(np.vstack([period] * 4))
    # A pole of 0.92 forgets its start of 0.2 rad to 0.92^50 = 1.5 % within the second left out; 3 mrad, then less.
    assert noise_deviation(clean) == pytest.approx([0.0, 0.0], abs=5e-4)


def test_nothing_is_found_where_nothing_repeats() -> None:
    assert noise_deviation(neck_recording(800, seed=1)) == [None, None]
    assert noise_deviation(concatenate([neck_recording(800, seed=s) for s in (1, 2)])) == [None, None]
    # Standing still is no experiment, however often it is repeated.
    still = recording_from(np.full((500, 3), 0.7), noise=SIGMA)
    assert noise_deviation(concatenate([still, still])) == [None, None]
    assert noise_ceiling(played(1), played(1).outputs) == [None, None]


def test_repeats_of_other_length_and_with_missed_samples_count_as_far_as_they_go() -> None:
    short = played(2).rows(0, 600)
    pitch = played(1).channels["pitch"].copy()
    pitch[::3] = np.nan
    recording = concatenate([played(1).with_channels(pitch=pitch), short])
    # 550 pairs, of pitch 367 of them: 1/sqrt(2 * 367) = 3.7 %, four of these.
    assert noise_deviation(recording) == pytest.approx([SIGMA, SIGMA], rel=0.15)


def test_set_points_that_differ_by_more_than_a_log_rounds_are_no_repeat() -> None:
    first = played(1)
    u = {f"motor_setpoint_{j}": first.channels[f"motor_setpoint_{j}"] for j in (1, 2, 3)}
    near = played(2).with_channels(**{name: values + 5e-4 for name, values in u.items()})
    far = played(2).with_channels(**{name: values + 5e-3 for name, values in u.items()})
    assert noise_deviation(concatenate([first, near]))[0] is not None
    assert noise_deviation(concatenate([first, far])) == [None, None]
