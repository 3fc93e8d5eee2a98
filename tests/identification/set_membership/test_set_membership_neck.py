"""What set membership reaches in free run, from set-points alone: virtual neck and a real arm (issue 5)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import Matrix
from softneck.identification import INFINITE, WARM_UP, Model, SetMembership, nrmse_fit, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, import_log, read_layout, signal

from ...data import LAYOUTS

TESTS = ("steps", "sine", "rotation")


@pytest.fixture(scope="module")
def tests() -> dict[str, Recording]:
    """The paper's three tests on preset `paper`, seeds as in the demo."""
    neck = VirtualNeck(NeckParameters.paper())
    return {name: record(signal(name), neck, seed=seed) for seed, name in enumerate(TESTS, start=2)}


@pytest.fixture(scope="module")
def eq22() -> tuple[Recording, Recording]:
    """Eq. 22: 7,000 rows to identify, 3,000 to validate."""
    return record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1).split(0.7)


@pytest.fixture(scope="module")
def paper(eq22: tuple[Recording, Recording]) -> Model:
    return SetMembership().fit(eq22[0])


def free_run(model: Model, recording: Recording) -> float:
    """The worse axis' fit [%]."""
    return min(fit or 0.0 for fit in validate(model, recording, horizons=(1, INFINITE)).fits[INFINITE].values())


def coverage(recording: Recording, outputs: Matrix) -> float:
    """The part of the samples within the bounds."""
    y, Y = recording.outputs[WARM_UP:], outputs[WARM_UP:]
    return float(((Y[:, [5, 7]] <= y) & (y <= Y[:, [6, 8]])).mean())


@pytest.mark.slow
def test_eq21_with_a_chosen_scale_runs_free(
    paper: Model, eq22: tuple[Recording, Recording], tests: dict[str, Recording]
) -> None:
    # Measured 96.3/96.1; 74.9/78.3, 87.3/91.9, 91.1/90.4: it feeds back its own output, and on steps, which Eq. 22
    # has none of, errors stay. 2 points below, as compilers round otherwise and a fed-back rounding grows.
    least = {"validation": 94.0, "steps": 72.0, "sine": 85.0, "rotation": 88.0}
    for name, recording in {"validation": eq22[1], **tests}.items():
        assert free_run(paper, recording) >= least[name], name


@pytest.mark.slow
def test_one_step_ahead_the_bounds_of_eq21_hold(paper: Model, eq22: tuple[Recording, Recording]) -> None:
    assert coverage(eq22[1], paper.predict(eq22[1])) >= 0.97  # the issue's; 99.9 % measured


@pytest.mark.slow
@pytest.mark.nightly
def test_the_residual_form_from_mixed_excitation(tests: dict[str, Recording]) -> None:
    # Of five seeds that whose epsilon, chosen as 4 times the noise, gave the widest bounds.
    mixed = record(signal("mixed", duration=140.0, seed=1), VirtualNeck(NeckParameters.paper()), seed=11)
    model = SetMembership(form="residual").fit(mixed)
    assert len(mixed) == 7000
    for name, recording in tests.items():
        assert free_run(model, recording) >= 85.0, name  # the issue's; over five seeds 89.7 and more
        assert coverage(recording, model.simulate(recording)) >= 0.97, name  # over five seeds all of them
        # An epsilon below what the base leaves unexplained let gamma and the width grow to 1,000 deg.
        assert np.degrees(np.mean(model.simulate(recording)[:, 6] - model.simulate(recording)[:, 5])) < 25.0, name


@pytest.fixture(scope="module")
def arm(shared_data: Path) -> tuple[Recording, Recording]:
    """The real arm: rows 1 to 13,000 to train on, the rest to test. Its yaw drifts, pitch alone is scored."""
    layout = dataclasses.replace(read_layout(LAYOUTS / "arm_multisine.toml"), rows=(0, 20_000))
    whole = import_log(shared_data / "arm_multisine/arm_multisine_400s.csv", layout).recording
    return whole.rows(0, 13_000), whole.rows(13_000, 20_000)


@pytest.mark.slow
def test_on_the_real_arm_both_forms_beat_any_linear_model(arm: tuple[Recording, Recording]) -> None:
    train, test = arm
    y = test.outputs[WARM_UP:, 0]
    # The best of them is chosen on the test itself: more than a linear model can claim.
    linear = max(_laguerre_fit(train, test, pole, order) for pole in (0.9, 0.95) for order in (2, 8))
    # Measured: 73.8 at most, also for output-error models of orders 1 to 4 and FIR of up to 8 s; here 93.3, 92.6.
    for form, margin in (("paper_eq21", 15.0), ("residual", 10.0)):
        fit = nrmse_fit(y, SetMembership(form=form).fit(train).simulate(test)[WARM_UP:, 0])
        assert fit >= linear + margin, form


def _laguerre_fit(train: Recording, test: Recording, pole: float, order: int) -> float:
    """Least squares of pitch over Laguerre filters of all three set-points: nothing fed back, a global optimum."""
    u = np.concatenate([train.set_points, test.set_points])
    columns = [np.ones(len(u))]
    for motor in u.T:
        x = np.asarray(lfilter([0.0, np.sqrt(1.0 - pole**2)], [1.0, -pole], motor))
        columns.append(x)
        for _ in range(order - 1):
            x = np.asarray(lfilter([-pole, 1.0], [1.0, -pole], x))
            columns.append(x)
    X, n = np.column_stack(columns), len(train)
    # 10 s for the filters to forget that they started from nothing.
    theta = np.linalg.lstsq(X[500:n], train.outputs[500:, 0])[0]
    return nrmse_fit(test.outputs[WARM_UP:, 0], X[n + WARM_UP :] @ theta)
