"""What a study draws: laws of its points, and ranges that are none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import SettingsError
from softneck.cosim.studies import _study
from softneck.cosim.studies._study import StudyPoints, flatten_keys, make_vary


def points(vary: dict[str, Any], runs: int | None = None, seed: int = 0) -> StudyPoints:
    return StudyPoints({key: make_vary(key, given) for key, given in vary.items()}, runs, seed)


def test_grids_alone_give_each_combination_once() -> None:
    found = points({"a": [1, 2, 3], "b": {"grid": ["x", "y"]}})
    assert [tuple(found[run].values.values()) for run in range(len(found))] == [
        (1, "x"), (1, "y"), (2, "x"), (2, "y"), (3, "x"), (3, "y")
    ]  # fmt: skip


def test_all_points_of_the_grid_see_the_same_samples() -> None:
    """Controllers are compared on equal plants: differences between them are theirs."""
    found = points({"c": ["p", "q", "r"], "k": {"uniform": [0.0, 1.0]}, "s": {"seed": True}}, runs=30)
    for sample in range(10):
        runs = [found[3 * sample + i] for i in range(3)]
        assert [run.values["c"] for run in runs] == ["p", "q", "r"]
        assert len({(run.values["k"], run.values["s"], run.seed, run.sample) for run in runs}) == 1


@given(runs=st.integers(1, 60), seed=st.integers(0, 10**6))
def test_a_latin_hypercube_has_one_run_in_each_layer_of_each_key(runs: int, seed: int) -> None:
    found = points({"a": {"uniform": [-1.0, 3.0]}, "b": {"log_uniform": [1e-3, 10.0]}}, runs, seed)
    values = np.array([list(found[run].values.values()) for run in range(runs)])
    quantiles = np.column_stack([(values[:, 0] + 1.0) / 4.0, np.log(values[:, 1] / 1e-3) / np.log(1e4)])
    # A layer is 1/60 wide at least; 1e-9 keeps rounding from moving a draw over its edge.
    layers = np.floor(quantiles * runs + 1e-9 * (0.5 - quantiles)).astype(int)
    assert (np.sort(layers, axis=0) == np.arange(runs)[:, None]).all()


def test_choices_are_balanced_in_a_latin_hypercube() -> None:
    found = points({"a": {"choices": ["p", "q", "r", "s"]}}, runs=40)
    names, counts = np.unique([found[run].values["a"] for run in range(40)], return_counts=True)
    assert dict(zip(names, counts, strict=True)) == dict.fromkeys("pqrs", 10)


def test_normal_draws_have_their_mean_and_deviation() -> None:
    found = points({"a": {"normal": [2.0, 0.5]}}, runs=2_000)
    values = np.array([found[run].values["a"] for run in range(2_000)])
    # Stratified: the mean is off by far less than 0.5 / sqrt(2000) = 0.011.
    assert values.mean() == pytest.approx(2.0, abs=2e-3)
    assert values.std() == pytest.approx(0.5, rel=0.01)


def test_another_seed_draws_others() -> None:
    first, second = (points({"a": {"uniform": [0, 1]}}, 5, seed)[0] for seed in (0, 1))
    assert first.values != second.values
    assert first.seed != second.seed


def test_labels_of_choices() -> None:
    named = make_vary("c", {"grid": {"fast": 1, "slow": object()}})
    assert named.labels == ("fast", "slow")
    assert make_vary("c", {"choices": [{"file": "pi.npz"}, "x"]}).labels == ("pi.npz", "x")
    # An object by its kind, else by its class; a table without a text by its values; equal ones by their number.
    pi = SimpleNamespace(kind="pi")
    assert make_vary("c", {"choices": [pi, set(), {"a": 1, "b": 2.5}]}).labels == ("pi", "set", "a = 1, b = 2.5")
    assert make_vary("c", {"choices": [pi, SimpleNamespace(kind="pi"), True]}).labels == ("pi 1", "pi 2", "True")
    assert make_vary("c", {"choices": [2, 0.5]}).labels == (2, 0.5)


def test_nested_and_quoted_keys_are_the_same() -> None:
    nested = {"plant": {"parameters": {"payload": {"uniform": [0, 1]}}}, "duration_s": [1.0, 2.0]}
    assert dict(flatten_keys(nested)) == {"plant.parameters.payload": {"uniform": [0, 1]}, "duration_s": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"uniform": [1.0, 1.0]}, "range from 1 to 1 is empty"),
        ({"uniform": [2.0, 1.0]}, "the lower bound first"),
        ({"uniform": [1.0]}, "takes two numbers"),
        ({"uniform": [0.0, float("nan")]}, "takes two numbers"),
        ({"log_uniform": [0.0, 1.0]}, "positive bounds"),
        ({"normal": [0.0, 0.0]}, "standard deviation must be positive"),
        ({"grid": []}, "the grid is empty"),
        ({"choices": []}, "the choices is empty"),
        ({"grid": [1, 2, 1]}, "a value twice"),
        ({"grid": [1], "uniform": [0, 1]}, "exactly one of"),
        ({"triangle": [0, 1]}, "exactly one of"),
        (5.0, "exactly one of"),
        ({"seed": 5}, "seed = true"),
    ],
)
def test_ranges_that_are_none(given: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=message) as caught:
        make_vary("plant.parameters.payload", given)
    assert "plant.parameters.payload" in str(caught.value)


@pytest.mark.parametrize(
    ("vary", "runs", "message"),
    [
        ({}, 10, "varies nothing"),
        ({"a": [1, 2]}, 0, "between 1 and 1000000; got 0"),
        ({"a": {"uniform": [0, 1]}}, None, "`runs` is missing"),
        ({"a": {"uniform": [0, 1]}}, -3, "between 1 and 1000000; got -3"),
        ({"a": {"uniform": [0, 1]}}, 2.5, "whole number"),
        ({"a": [1, 2]}, 3, "2 points and nothing is random"),
        ({"a": [1, 2, 3], "b": {"uniform": [0, 1]}}, 2, "3 points; `runs` is 2"),
    ],
)
def test_numbers_of_runs_that_cannot_be(vary: dict[str, Any], runs: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        points(vary, runs)


@pytest.mark.parametrize(
    ("given", "ends"),
    [({"uniform": [-1, 3]}, (-1.0, 3.0)), ({"log_uniform": [0.01, 100.0]}, (0.01, 100.0)),
     ({"choices": ["p", "q", "r"]}, ("p", "r"))],
)  # fmt: skip
def test_a_draw_goes_from_the_first_end_to_the_last(given: dict[str, Any], ends: tuple[Any, Any]) -> None:
    made = make_vary("a", given)
    assert not made.is_grid
    # Quantiles are within 1e-12 of the ends.
    for u, end in zip((1e-12, 1.0 - 1e-12), ends, strict=True):
        value, label = made.pick(u)
        assert value == label
        assert value == (end if isinstance(end, str) else pytest.approx(end, rel=1e-9))
    assert made.pick(1.0)[0] == (ends[1] if isinstance(ends[1], str) else pytest.approx(ends[1], rel=1e-12))
    middle = {"uniform": 1.0, "log_uniform": 1.0, "choices": "q"}[made.kind]
    assert made.pick(0.5)[0] == (middle if isinstance(middle, str) else pytest.approx(middle))
    normal = make_vary("a", {"normal": [2, 0.5]})
    assert normal.pick(0.5)[0] == pytest.approx(2.0)
    assert normal.pick(0.9772498680518208)[0] == pytest.approx(3.0)  # two deviations


def test_each_sample_has_a_seed_of_its_own_that_any_generator_takes() -> None:
    found = points({"a": [1, 2], "s": {"seed": True}}, runs=399)
    assert len(found) == 399
    seeds = [found[run].seed for run in range(399)]
    assert seeds[::2] == seeds[1::2] + seeds[-1:]  # both points of the grid, and the last sample has one
    assert len(set(seeds)) == 200
    assert all(0 <= seed < 2**31 - 2 for seed in seeds)
    last = found[398]
    assert (last.run, last.sample, last.values, last.labels) == (398, 199, {"a": 1, "s": seeds[-1]}, last.values)


def test_numbers_of_runs_have_their_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_study, "_MAX_RUNS", 6)
    assert len(points({"a": [1, 2, 3], "b": [1, 2]})) == len(points({"a": {"uniform": [0, 1]}}, 6)) == 6
    assert len(points({"a": [1, 2, 3], "b": [1, 2]}, 6)) == 6
    assert len(points({"a": [1, 2], "b": {"uniform": [0, 1]}}, 2)) == 2
    assert len(points({"a": {"uniform": [0, 1]}}, 1)) == 1
    with pytest.raises(SettingsError, match="the grid has 8 points; at most 6 fit"):
        points({"a": [1, 2, 3, 4], "b": [1, 2]})
    for runs in (7, 0, True):
        with pytest.raises(SettingsError, match="between 1 and 6"):
            points({"a": {"uniform": [0, 1]}}, runs)
    with pytest.raises(SettingsError, match="`runs` is missing"):
        points({"s": {"seed": True}})


@pytest.mark.parametrize(
    ("given", "fits"),
    [({"uniform": [0, True]}, False), ({"uniform": (0, 1)}, True), ({"uniform": "01"}, False),
     ({"uniform": [0.0, float("inf")]}, False), ({"uniform": [0, 1, 2]}, False), ({"normal": [5.0, 1e-9]}, True),
     ({"normal": [1.0, 0.5]}, True), ({"normal": [0.0, -1.0]}, False), ({"log_uniform": [1e-9, 1.0]}, True),
     ({"log_uniform": [-1.0, 1.0]}, False), ({"uniform": [-1.0, 0.0]}, True), ({"grid": "ab"}, False),
     ({"grid": [1, "1"]}, True), ({}, False), ({"seed": True}, True), ({"seed": 1}, False)],
)  # fmt: skip
def test_a_range_is_two_numbers_in_their_order(given: Any, fits: bool) -> None:
    if fits:
        assert make_vary("k", make_vary("k", given)).kind == next(iter(given))
        return
    with pytest.raises(SettingsError, match="`k`"):
        make_vary("k", given)


@pytest.mark.parametrize("run", [-1, 4, 99])
def test_a_study_has_its_runs_and_settings_within_their_ranges(run: int) -> None:
    loop = {"duration_s": 1.0, "plant": {"neck": "paper"}, "reference": {"kind": "step", "pitch_deg": 5.0, "at_s": 0.2}}
    made = _study.make_study(loop, vary={"reference.pitch_deg": [1.0, 2.0], "duration_s": [3.0, 4.0]})
    assert [made.table(k)["duration_s"] for k in (0, 3)] == [3.0, 4.0]
    with pytest.raises(SettingsError, match=f"the study has runs 0 to 3; there is no run {run}"):
        made.table(run)
    for seed in (-1, True, 2.5):
        with pytest.raises(SettingsError, match="`seed` must be"):
            replace(made, seed=seed)  # pyright: ignore[reportArgumentType]
    for dask in ("head:8786", 5, ""):
        with pytest.raises(SettingsError, match="`dask` must be"):
            replace(made, dask=dask)  # pyright: ignore[reportArgumentType]
    assert replace(made, seed=0, dask="tcp://head:8786").dask == "tcp://head:8786"
