"""The evaluation of a study: a run that is worse never improves a group, and one that failed never vanishes."""

from __future__ import annotations

import math
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from softneck.core import DataError, SettingsError, metric_of
from softneck.cosim import group_runs, pareto_front, rank, worst_runs
from softneck.cosim.studies import _run_study
from softneck.cosim.studies._store import _spread, read_tables
from softneck.cosim.studies._study import Vary
from softneck.loop import metric_names
from softneck.robot import Robot

METRICS = metric_names(Robot.preset())
ERROR = "pitch.rms_error_deg"


def runs_of(values: Any, *, holds: Any = None, errors: Any = None, metric: str = ERROR) -> pd.DataFrame:
    n = len(values)
    table = {"run": range(n), "kind": ["a"] * n, metric: np.array(values, float)}
    table |= {"holds": pd.array([None] * n if holds is None else holds, "boolean"), "error": errors or [""] * n}
    return pd.DataFrame(table)


def grouped(runs: pd.DataFrame, metric: str = ERROR) -> dict[str, Any]:
    (row,) = group_runs(runs, ["kind"], [metric]).to_dict("records")
    return {str(key).removeprefix(f"{metric} "): value for key, value in row.items()}


def spread(values: Any, metric: str) -> tuple[float, ...]:
    found = grouped(runs_of(values, metric=metric), metric)
    return found["median"], found["95 %"], found["worst"]


@pytest.mark.parametrize("metric", METRICS)
def test_a_worse_run_never_improves_a_group_and_a_better_one_leaves_its_worst(metric: str) -> None:
    # Groups, ranks and fronts minimise: a metric that is better when larger needs its own direction there.
    assert not metric_of(metric).larger
    members = (3.0, 1.0, 2.0)
    base = spread(members, metric)
    assert base == (2.0, 3.0, 3.0)
    for order in permutations(members):
        assert spread(order, metric) == base
    for place in range(4):
        for worse in (4.0, math.inf, math.nan):
            found = spread((*members[:place], worse, *members[place:]), metric)
            assert found[2] == (4.0 if worse == 4.0 else math.inf)
            assert all(new >= old for new, old in zip(found, base, strict=True))
        better = spread((*members[:place], 0.5, *members[place:]), metric)
        assert better[2] == 3.0
        assert better[0] <= base[0]


def test_a_spread_is_of_observed_values() -> None:
    y = np.arange(1.0, 101.0)
    assert _spread(y[::-1]) == {"median": 50.0, "95 %": 95.0, "worst": 100.0}
    assert all(math.isnan(value) for value in _spread(np.zeros(0)).values())


def test_a_failed_run_counts_in_the_spread_and_in_the_share_that_holds() -> None:
    ok = runs_of((1.0, 2.0, 3.0), holds=[True, True, False])
    base = grouped(ok)
    assert (base["runs"], base["failed"], base["holds [%]"]) == (3, 0, pytest.approx(200.0 / 3.0))
    # A run that diverged has no metric and no verdict.
    for lost in (math.nan, 0.1):
        found = grouped(
            runs_of((1.0, 2.0, 3.0, lost), holds=[True, True, False, None], errors=["", "", "", "diverged"])
        )
        assert (found["runs"], found["failed"], found["holds [%]"]) == (4, 1, 50.0)
        assert found["worst"] == math.inf
        assert found["median"] == 2.0
    # Without limits nothing holds or fails.
    assert math.isnan(grouped(runs_of((1.0, 2.0)))["holds [%]"])
    assert math.isnan(grouped(runs_of((1.0, 2.0), errors=["", "gone"]))["holds [%]"])


@pytest.mark.parametrize("limits", [(), ("limit",)])
@pytest.mark.parametrize("holds", [True, False])
def test_a_run_tells_its_metrics_and_whether_its_limits_hold_if_it_has_some(
    limits: tuple[str, ...], holds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    setup = SimpleNamespace(limits=limits, loop=SimpleNamespace(parts={}))
    result = SimpleNamespace(metrics={"pitch": {"rms_error_deg": 1.5, "rise_s": 9.0}}, holds=holds)
    monkeypatch.setattr(_run_study, "make_loop", lambda *_, **__: setup)
    monkeypatch.setattr(_run_study, "run_setup", lambda *_, **__: result)
    point: Any = SimpleNamespace(run=3, sample=1, seed=7, labels={"kind": "a"}, values={})
    chunk = _run_study.Chunk("", {}, Path(), [point], (ERROR,))
    (row,) = _run_study.run_chunk(chunk)
    assert row.pop("seconds") >= 0.0
    expected = {"run": 3, "sample": 1, "seed": 7, "kind": "a", "error": ""}
    assert row == {**expected, ERROR: 1.5, "holds": holds if limits else None}
    # A run that broke off has no metric, and one whose worker died holds nothing.
    for error, said in ((DataError("it\nis gone"), "it is gone"), (ValueError("no"), "ValueError: no")):
        monkeypatch.setattr(_run_study, "run_setup", Mock(side_effect=error))
        (row,) = _run_study.run_chunk(chunk)
        assert (row["error"], row[ERROR], row["holds"]) == (said, None, None)
    dead = _run_study.failed_row(point, "died", (ERROR,))
    assert dead == {**expected, ERROR: None, "holds": False, "error": "died", "seconds": None}


def test_a_run_that_is_on_the_disk_twice_counts_once(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    for file, numbers in zip(files, ((2, 0), (0, 1)), strict=True):
        # As of a run that was repeated: the same numbers, in another time.
        runs = runs_of([10.0 + number for number in numbers]).assign(run=numbers, seconds=file.name == "b.csv")
        runs.to_csv(file, index=False)
    table = read_tables(files, {"kind": Vary("choices", labels=("a",))})
    assert table["run"].tolist() == [0, 1, 2]
    assert table[ERROR].tolist() == [10.0, 11.0, 12.0]


def test_groups_keep_their_own_runs() -> None:
    runs = runs_of((1.0, 5.0, 2.0, 7.0))
    runs["kind"] = ["a", "b", "a", "b"]
    table = group_runs(runs, ["kind"], [ERROR])
    assert table["kind"].tolist() == ["a", "b"]
    assert table[f"{ERROR} worst"].tolist() == [2.0, 7.0]


def test_the_ranking_puts_what_failed_last_then_what_breaks_limits() -> None:
    runs = runs_of(
        (0.1, 0.2, 3.0, math.nan, 1.0), holds=[None, False, True, True, None], errors=["gone", "", "", "", ""]
    )
    assert rank(runs, [ERROR])["run"].tolist() == [4, 2, 3, 1, 0]
    assert worst_runs(runs, [ERROR], 2)["run"].tolist() == [0, 1]
    assert worst_runs(runs, [ERROR])["run"].tolist() == [0, 1, 3]
    with pytest.raises(SettingsError, match="not a column"):
        rank(runs, ["roll.rms_error_deg"])
    with pytest.raises(SettingsError, match="not a column"):
        pareto_front(runs, ["roll.rms_error_deg"])


def test_only_finite_runs_that_did_not_fail_are_on_the_front() -> None:
    runs = runs_of((1.0, 2.0, 0.5, math.nan, math.inf, 3.0), errors=["", "", "gone", "", "", ""])
    runs["other"] = [3.0, 1.0, 0.1, 0.0, 0.0, 4.0]
    assert pareto_front(runs, [ERROR, "other"])["run"].tolist() == [0, 1]
