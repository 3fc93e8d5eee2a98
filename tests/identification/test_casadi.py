"""One step of each kind of model as a CasADi function: that of its runtime, from its runtime's text."""

from __future__ import annotations

import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from softneck import load
from softneck.core import SettingsError
from softneck.identification import Model, Network
from softneck.signals import Recording

from ..data import guarded_of, short_neck

KINDS = ("rls", "mimo", "oe", "oe2", "play", "nn", "greybox", "guarded")
# Sums in another order and another libm's tanh, sine and root: some ulp of numbers of order one. Most kinds are equal
# to the bit; over 1,000 samples the largest difference of all was 9e-16.
ROUNDING = 1e-12


def walked(model: Model, rows: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (rows + 1, n), random set-points (rows, 3) and outputs of a free run from a tilted start."""
    block, rng = model.block(), np.random.default_rng(7)
    state = block.initial_state(use_measurement=0.0, noise_std=0.0, pitch_start=0.1, roll_start=-0.05)
    u = np.zeros(3)
    states, given, outputs = [state.values], [], []
    for k in range(rows):
        # Walks as far as the range, and at times jumps, so that drives stall and tendons go slack.
        u = rng.uniform(-6.0, 6.0, 3) if k % 20 == 0 else np.clip(u + rng.normal(0.0, 0.4, 3), -6.0, 6.0)
        state, y = block.step(state, [*u, *[math.nan] * (len(block.inputs) - 3)])
        states.append(state.values)
        given.append(u)
        outputs.append(y)
    return np.array(states), np.array(given), np.array(outputs)


@pytest.mark.parametrize("kind", KINDS)
def test_the_function_is_the_runtime(kind: str, models: dict[str, Model]) -> None:
    f = models[kind].casadi()
    states, given, outputs = walked(models[kind])
    assert (f.name_in(), f.name_out()) == (["x", "u"], ["x_next", "y"])
    for k, u in enumerate(given):
        x_next, y = f(states[k], u)
        np.testing.assert_allclose(np.array(x_next)[:, 0], states[k + 1], rtol=ROUNDING, atol=ROUNDING)
        np.testing.assert_allclose(np.array(y)[:, 0], outputs[k], rtol=ROUNDING, atol=ROUNDING)


def test_a_division_by_zero_in_a_branch_that_is_not_taken_is_harmless() -> None:
    """The compression of a link without a stop is divided by its place, zero, where coils touch: they never do."""
    model = load(Path(__file__).parents[1] / "golden" / "greybox.npz")
    f = model.casadi()
    states, given, outputs = walked(model, 50)
    slope = f.factory("slope", ["x", "u"], ["jac:y:x"])
    for k, u in enumerate(given):
        np.testing.assert_allclose(np.array(f(states[k], u)[1])[:, 0], outputs[k], rtol=ROUNDING, atol=ROUNDING)
        assert np.isfinite(np.array(slope(states[k], u))).all()


@pytest.mark.slow
def test_a_network_of_the_papers_size_too(neck: Recording) -> None:
    model = Network(iterations=2).fit(neck)
    f = model.casadi()
    states, given, outputs = walked(model, 50)
    for k, u in enumerate(given):
        np.testing.assert_allclose(np.array(f(states[k], u)[1])[:, 0], outputs[k], rtol=ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize("kind", KINDS)
def test_its_derivative_is_that_of_differences(kind: str, models: dict[str, Model]) -> None:
    f, (states, given, _) = models[kind].casadi(), walked(models[kind], 60)
    slope = f.factory("slope", ["x", "u"], ["jac:y:x", "jac:y:u"])
    rng, size, h = np.random.default_rng(1), states.shape[1], 1e-6
    for k in range(5, 60, 9):
        along = np.where(np.abs(states[k]) < 1e3, rng.standard_normal(size), 0.0)  # not the random generator's integers
        move = rng.standard_normal(3)
        A, B = (np.array(part) for part in slope(states[k], given[k]))
        ends = [np.array(f(states[k] + s * h * along, given[k] + s * h * move)[1])[:, 0] for s in (1.0, -1.0)]
        # Central differences: h^2 times a third derivative, and 1e-16 / h; a corner within h would show as 1e-1.
        np.testing.assert_allclose(A @ along + B @ move, (ends[0] - ends[1]) / (2.0 * h), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", ["greybox", "play"])
def test_derivatives_at_rest_are_numbers(kind: str, models: dict[str, Model]) -> None:
    """Nothing moves there: sizes of vectors and the neck's bend are zero, and their derivatives have a corner."""
    model = models[kind]
    rest = model.block().initial_state(use_measurement=0.0).values
    for x in (rest, np.zeros_like(rest)):
        slope = model.casadi().factory("slope", ["x", "u"], ["jac:x_next:x", "jac:y:u"])(x, np.zeros(3))
        assert all(np.isfinite(np.array(part)).all() for part in slope)


def test_it_is_a_function_to_build_with(models: dict[str, Model]) -> None:
    """Many steps as one expression, as optimal control takes them."""
    model, rows = models["play"], 30
    f = model.casadi().mapaccum(rows)
    states, given, outputs = walked(model, rows)
    x, y = f(states[0], given.T)
    np.testing.assert_allclose(np.array(y).T, outputs, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(np.array(x)[:, -1], states[-1], rtol=ROUNDING, atol=ROUNDING)
    assert isinstance(f, ca.Function)


def test_a_search_in_a_set_is_refused_by_name(models: dict[str, Model]) -> None:
    for kind, name in (("nlsm", "nlsm"), ("residual", "nlsm")):
        with pytest.raises(SettingsError, match=f"a model of kind `{name}` searches its set"):
            models[kind].casadi()
    with pytest.raises(SettingsError, match="a model of kind `nlsm` searches its set"):
        guarded_of([models["rls"], models["nlsm"]], short_neck()).casadi()
