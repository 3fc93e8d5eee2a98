"""Every function of recordings answers, or refuses in one line, where there is hardly anything recorded."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from softneck.core import DataError, SoftneckError
from softneck.identification import (
    Model,
    choose,
    choose_kind,
    compare,
    family,
    fit_drive,
    frequency_response,
    identify,
    make_draws,
    validate,
)
from softneck.identification.models._directions import bandwidth_of
from softneck.identification.models._left_out import all_rows, folds, other_motion
from softneck.robot import Robot
from softneck.signals import (
    Recording,
    assess_quality,
    check_channel,
    independent_motions,
    poor_excitation,
    resampled,
    why_at_rest,
)
from softneck.signals.quality._excitation import correlation, explained_variance, lightly_damped, spectrum
from softneck.signals.quality._followed import driven_mode

#: A robot of which nothing is known, as of a log without a robot file.
UNKNOWN = Robot.from_dict(
    {
        "name": "unknown",
        "motors": {"names": ["a", "b", "c"], "unit": "V"},
        "outputs": {"names": ["x", "y"], "unit": "mm"},
        "directions": {"kind": "identified"},
    }
)
MANY = 300
#: Rows, and the outputs that were never measured.
CASES = [(1, ()), (2, ()), (MANY, (1,)), (MANY, (0, 1))]


def recorded(rows: int, never: tuple[int, ...] = (), robot: Robot | None = None) -> Recording:
    """A lag behind three motors that wander, with its positions."""
    U = 0.05 * np.cumsum(np.random.default_rng(0).standard_normal((rows, 3)), axis=0)
    Y = np.zeros((rows, 2))
    for k in range(1, rows):
        Y[k] = 0.9 * Y[k - 1] + 0.01 * U[k - 1, :2]
    Y[:, list(never)] = np.nan
    return Recording.from_arrays(U, Y, motor_positions=U, robot=robot)


@cache
def whole() -> tuple[Recording, Model]:
    """A recording of many rows, and its model."""
    return recorded(MANY), identify("rls", recorded(MANY))


ANY: dict[str, Callable[[Recording], object]] = {
    "assess_quality": lambda data: (assess_quality(data).as_dict(), assess_quality(data).text()),
    "check_channel": lambda data: [check_channel(data, name) for name in data.channels],
    "poor_excitation": poor_excitation,
    "independent_motions": independent_motions,
    "why_at_rest": lambda data: why_at_rest(data, data),
    "lightly_damped": lightly_damped,
    "driven_mode": lambda data: [driven_mode(data, output) for output in (0, 1)],
    "spectrum": lambda data: spectrum(data, 4.0),
    "correlation": correlation,
    "explained_variance": explained_variance,
    "bandwidth_of": bandwidth_of,
    "fit_drive": fit_drive,
    "other_motion": other_motion,
    "folds": lambda data: folds(data, data, other_excitation=True),
    "all_rows": lambda data: all_rows("", data).fits(whole()[1]),
    "simulate": lambda data: whole()[1].simulate(data),
    "resampled": lambda data: resampled(data, 0.05),
    "validate": lambda data: validate(whole()[1], data),
    "compare": lambda data: compare(whole()[1], data),
}
REFUSED: dict[str, Callable[[Recording], object]] = {
    **{f"identify {kind}": lambda data, kind=kind: identify(kind, data)
       for kind in ("rls", "oe", "greybox", "play", "nlsm", "nn", "guarded")},
    "choose": lambda data: choose(data, whole()[0], kinds=("rls", "oe")),
    "choose, held out": lambda data: choose(whole()[0], data, kinds=("rls",)),
    "choose_kind": lambda data: choose_kind([data], name="data", train=0.7, seed=0, progress=lambda *_: None),
    "family": family,
    "frequency_response": frequency_response,
    "make_draws": lambda data: make_draws(data),
}  # fmt: skip


@pytest.mark.parametrize("robot", [None, UNKNOWN], ids=["neck", "unknown robot"])
@pytest.mark.parametrize(("rows", "never"), CASES)
@pytest.mark.parametrize("name", ANY)
def test_a_function_of_recordings_answers_or_refuses_in_one_line(
    name: str, rows: int, never: tuple[int, ...], robot: Robot | None
) -> None:
    said = ""
    try:
        ANY[name](recorded(rows, never, robot))
    except SoftneckError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize("robot", [None, UNKNOWN], ids=["neck", "unknown robot"])
@pytest.mark.parametrize(("rows", "never"), CASES)
@pytest.mark.parametrize("name", REFUSED)
def test_nothing_is_learned_from_hardly_anything(
    name: str, rows: int, never: tuple[int, ...], robot: Robot | None
) -> None:
    with pytest.raises(SoftneckError) as said:
        REFUSED[name](recorded(rows, never, robot))
    assert "\n" not in str(said.value)
    assert "diverged" not in str(said.value)


def test_a_recording_without_rows_is_refused() -> None:
    with pytest.raises(DataError, match="has no rows"):
        recorded(0)
