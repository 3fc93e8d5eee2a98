"""The evaluation of a study: a run that is worse never improves a group, and one that failed never vanishes."""

from __future__ import annotations

import json
import math
import sys
import tomllib
from concurrent.futures import BrokenExecutor, CancelledError, Future
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from softneck.core import DataError, FileFormatError, OutputFileError, SettingsError, metric_of
from softneck.cosim import LoopSetup, group_runs, held_runs, make_study, pareto_front, rank, read_runs, worst_runs
from softneck.cosim.loops._loop_table import OBJECT
from softneck.cosim.studies import _run_study, _store, _study
from softneck.cosim.studies._store import Store, _spread, column_types, pareto_rows, write_worst
from softneck.cosim.studies._study import Vary
from softneck.loop import Loop, metric_names
from softneck.plots import distribution_chart
from softneck.report._study_page import kept_runs
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
        # The page, the command's JSON and the sentence count it too.
        runs = runs_of((1.0, lost), holds=[True, None], errors=["", "diverged"])
        assert held_runs(runs).tolist() == [True, False]
        assert kept_runs(runs) == "1 of 2 runs keep all limits"
    # A run of a group that has no name is no run less.
    runs = runs_of((1.0, 2.0, 3.0)).assign(kind=["a", None, math.nan])
    assert sum(group_runs(runs, ["kind"], [ERROR])["runs"].tolist()) == 3
    # Without limits nothing holds or fails.
    assert math.isnan(grouped(runs_of((1.0, 2.0)))["holds [%]"])
    assert math.isnan(grouped(runs_of((1.0, 2.0), errors=["", "gone"]))["holds [%]"])


@pytest.mark.parametrize("lost", [math.nan, math.inf])
def test_shares_of_a_group_are_of_all_its_runs(lost: float) -> None:
    """Among those that ended alone, a group of which half diverged would look like one of which none did."""
    groups = {"a": np.array([1.0, 2.0, lost, lost]), "b": np.array([1.0, 2.0]), "c": np.array([lost])}
    (panel,) = distribution_chart({ERROR: groups}, "t").panels
    assert {curve.label: curve.y.sum() for curve in panel.curves} == {"a": 50.0, "b": 100.0}


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


def test_a_line_that_was_not_finished_is_no_run_and_the_study_goes_on_behind_it(tmp_path: Path) -> None:
    made = make_study({"duration_s": 1.0, "plant": {"neck": "paper"}}, vary={"reference.at_s": [0.1, 0.2]}, runs=2)
    store, row = Store(made, tmp_path), {"sample": 0, "seed": 0, "reference.at_s": 0.1, "holds": True, "error": ""}
    for run in (2, 0, 1):
        store.add([{"run": run, **row}])
        assert run in store.done
    whole = (tmp_path / "runs.csv").read_bytes()
    (tmp_path / "runs.csv").write_bytes(whole + whole.splitlines(keepends=True)[1][:-9])  # as of a process that died
    assert read_runs(tmp_path)["run"].tolist() == [0, 1, 2]
    again = Store(made, tmp_path)
    assert again.done == {0, 1, 2}
    again.add([{"run": 3, **row}])
    assert again.finish()["run"].tolist() == [0, 1, 2, 3]
    assert (tmp_path / "runs.csv").read_bytes().endswith(b"\n")
    (tmp_path / "runs.csv").write_text("run,sample,seed,holds,error\n1,0,0,True,\n")
    with pytest.raises(FileFormatError, match="has other columns than this study writes"):
        Store(made, tmp_path)


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


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_a_front_is_what_none_beats_in_whatever_order_runs_and_objectives_stand(columns: int) -> None:
    values = np.random.default_rng(columns).integers(0, 5, (60, columns)).astype(float)
    beaten = [any((other <= one).all() and (other < one).any() for other in values) for one in values]
    for order in (slice(None), slice(None, None, -1)):
        np.testing.assert_array_equal(pareto_rows(values[order]), ~np.array(beaten)[order])
        np.testing.assert_array_equal(pareto_rows(values[:, order]), ~np.array(beaten))
    assert pareto_rows(np.empty((0, columns))).tolist() == []


@pytest.mark.parametrize("absent", ["run", "holds", "error"])
def test_a_file_of_runs_without_a_column_is_refused(absent: str, tmp_path: Path) -> None:
    file, vary = tmp_path / "a.csv", {"kind": Vary("choices", labels=("a",))}
    runs_of((1.0, 2.0)).drop(columns=absent).to_csv(file, index=False)
    with pytest.raises(FileFormatError, match=f"no column `{absent}`"):
        _store._read(file, vary)
    runs_of((1.0, 2.0)).to_csv(file, index=False)
    file.write_text(file.read_text() + "3,a,1.0,,,7\n")  # a row that is longer than the header
    with pytest.raises(FileFormatError, match="cannot be read"):
        _store._read(file, vary)


# -- workers that die --------------------------------------------------------------------------------------------------


class Pool:
    """An executor in this process: chunks with runs of `kills` break it, others end as `answer` says."""

    def __init__(self, answer: Any, kills: Any = (), refuses: int = 0) -> None:
        self.answer, self.kills, self.refuses, self.chunks = answer, set(kills), refuses, list[list[int]]()
        self.starts: list[int] = []

    def submit(self, _: Any, chunk: Any) -> Future:
        runs = [point.run for point in chunk.points]
        if self.refuses > 0:
            self.refuses -= 1
            raise BrokenExecutor
        self.chunks.append(runs)
        future: Future = Future()
        try:
            if self.kills.intersection(runs):
                raise BrokenExecutor
            future.set_result(self.answer(runs))
        except Exception as error:
            future.set_exception(error)
        return future

    def shutdown(self, **how: Any) -> None:
        assert how == {"wait": True, "kill_workers": True}

    def start(self, size: int) -> Any:
        self.starts.append(size)
        return self


class Rows:
    """A store in memory."""

    def __init__(self, done: Any = ()) -> None:
        self.done, self.rows = set(done), dict[int, str]()

    def add(self, rows: Any) -> None:
        assert not self.rows.keys() & {row["run"] for row in rows}, "a run is written once"
        self.rows |= {row["run"]: row["error"] for row in rows}
        self.done.update(self.rows)


def finished(runs: list[int], seconds: float | None = 0.01) -> list[dict[str, Any]]:
    return [{"run": run, "error": "", "seconds": seconds} for run in runs]


def run_all(pool: Pool, count: int = 12, done: Any = (), size: int = 2) -> tuple[Rows, list[tuple[float, str]]]:
    """Return what is written of a study of so many runs, and what is said of its course."""
    points = [SimpleNamespace(run=k, sample=0, seed=0, labels={}) for k in range(count)]
    study: Any = SimpleNamespace(points=points, digest="d", loop={}, folder=Path(), metrics=())
    store, said = Rows(done), list[tuple[float, str]]()
    workers = _run_study.WorkerPool(size, pool, pool.start)  # pyright: ignore[reportArgumentType]
    _run_study._StudyRun(study, store, workers, lambda *told: said.append(told)).run()  # pyright: ignore[reportArgumentType]
    return store, said


@pytest.mark.parametrize("size", [1, 3])
def test_each_run_that_is_left_is_run_once_and_the_course_is_said(size: int) -> None:
    pool = Pool(finished)
    store, said = run_all(pool, done=(0, 5), size=size)
    assert sorted(run for chunk in pool.chunks for run in chunk) == [k for k in range(12) if k not in (0, 5)]
    assert set(store.rows.values()) == {""}
    shares = [share for share, _ in said]
    assert shares == sorted(shares)
    assert said[-1] == (1.0, "12 of 12")
    assert pool.starts == []
    assert run_all(Pool(finished), done=range(12))[1] == []


@pytest.mark.parametrize("kills", [(3,), (0, 11), tuple(range(12))])
def test_a_run_that_kills_its_worker_twice_alone_is_named_and_no_other_is_lost(kills: tuple[int, ...]) -> None:
    pool = Pool(finished, kills)
    store, said = run_all(pool)
    died = "its worker process died 2 times with it alone"
    assert store.rows == {run: died if run in kills else "" for run in range(12)}
    assert [pool.chunks.count([run]) >= 2 for run in kills] == [True] * len(kills)
    assert said[-1] == (1.0, f"12 of 12, {len(kills)} failed")
    # New workers after each death: one alone to find which it was, all of them where runs are left.
    assert set(pool.starts) <= {1, 2}
    assert pool.starts[0] == 1


def test_a_pool_that_breaks_when_work_is_given_loses_nothing() -> None:
    pool = Pool(finished, refuses=2)
    assert run_all(pool)[0].rows == dict.fromkeys(range(12), "")
    assert pool.starts[:2] == [1, 1]
    # What was ready when another worker died is kept and not run again.
    ends, lost = Pool(finished, kills=(1,)), []
    store, _ = run_all(ends, count=4, size=4)
    assert store.rows.keys() == {0, 1, 2, 3}
    assert [ends.chunks.count([run]) for run in (0, 2, 3)] == [1, 1, 1]
    assert lost == []


def test_a_worker_that_fails_otherwise_costs_the_run_that_is_alone_with_it() -> None:
    def answer(runs: list[int]) -> Any:
        if 7 in runs:
            raise ValueError("it cannot be sent")
        return finished(runs)

    store, _ = run_all(Pool(answer), count=40)
    assert store.rows == {k: "its worker failed: ValueError: it cannot be sent" if k == 7 else "" for k in range(40)}


@pytest.mark.parametrize(
    ("error", "said"),
    [(CancelledError(), "the Dask scheduler is gone"), (OutputFileError("disk is full"), "disk is full")],
)
def test_what_ends_a_study_is_raised_and_no_run_is_blamed_for_it(error: Exception, said: str) -> None:
    def answer(_: list[int]) -> Any:
        raise error

    with pytest.raises(OutputFileError, match=said):
        run_all(Pool(answer))


@pytest.mark.parametrize(
    ("seconds", "ended", "left", "wanted"),
    [(0.0, 0, 100, 1), (0.1, 1, 800, 5), (1.0, 1, 800, 1), (0.1, 1, 16, 2), (0.1, 1, 17, 3), (1e-9, 1, 9000, 200),
     (0.1, 10, 8000, 50), (0.1, 1, 1, 1), (0.0, 5, 9000, 1)],
)  # fmt: skip
def test_a_chunk_takes_half_a_second_and_leaves_each_worker_its_share(
    seconds: float, ended: int, left: int, wanted: int
) -> None:
    """A quarter of what each of two workers has left at most, and never more than 200 runs."""
    study: Any = SimpleNamespace(points=[None] * left, digest="")
    store, workers = Rows(), _run_study.WorkerPool(2, Pool(finished))  # pyright: ignore[reportArgumentType]
    course = _run_study._StudyRun(study, store, workers, lambda *_: None)  # pyright: ignore[reportArgumentType]
    course._seconds, course._ended = seconds, ended
    assert course._chunk() == wanted


def test_two_chunks_for_each_worker_are_out_and_one_alone_after_a_death() -> None:
    class Slow(Pool):
        def submit(self, _: Any, chunk: Any) -> Future:
            self.chunks.append([point.run for point in chunk.points])
            return Future()

    pool = Slow(finished)
    study: Any = SimpleNamespace(points=[SimpleNamespace(run=k) for k in range(99)], digest="", loop={}, folder=Path(),
                                 metrics=())  # fmt: skip
    course = _run_study._StudyRun(study, Rows(), _run_study.WorkerPool(3, pool, pool.start), lambda *_: None)  # pyright: ignore[reportArgumentType]
    course._submit_next()
    assert pool.chunks == [[k] for k in range(6)]
    course._submit_next()
    assert len(pool.chunks) == 6
    course._suspects.extend([50, 51])
    course._submit_next()  # not while others run
    assert len(pool.chunks) == 6
    course._running.clear()
    course._submit_next()
    assert (pool.chunks[-1], list(course._suspects)) == ([50], [51])
    # After a death one worker is left, with one suspect and nothing beside it; then all of them begin again.
    course._running.clear()
    course._restart()
    assert pool.starts == [1]
    course._submit_next()
    assert (pool.chunks[-1], list(course._suspects)) == ([51], [])
    course._submit_next()
    assert pool.chunks[-1] == [51]
    course._running.clear()
    course._submit_next()
    assert pool.starts == [1, 3]
    assert pool.chunks[-6:] == [[k] for k in range(6, 12)]


def test_parts_of_one_class_with_other_numbers_are_other_studies(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mine:
        def __init__(self, gain: float) -> None:
            self.gain = gain

    for steps in (True, False):
        monkeypatch.setattr(_study, "own_object", lambda value, steps=steps: object() if steps else value)
        one, same, other = (_study._plain(Mine(gain)) for gain in (1.0, 1.0, 2.0))
        assert one == same
        # Of what does not step its class alone is known.
        assert (one != other) is steps


def test_a_loop_in_a_study_file_starts_at_its_folder_and_a_file_beside_it_is_a_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_study, "make_study", lambda loop, **told: (loop, told))
    file, table = tmp_path / "steps.toml", {"duration_s": 1.0}
    rest = {"vary": {"a": 1}, "runs": 2, "seed": 3}
    told = {"name": "steps", **rest}
    assert _study._from_table(file, {"loop": table, **rest}) == (table, {"folder": tmp_path, **told})
    assert _study._from_table(file, {"loop": "in/loop.toml", **rest}) == (
        tmp_path / "in" / "loop.toml", {"folder": None, **told},
    )  # fmt: skip


def test_a_study_is_continued_by_the_same_and_by_no_other_order_of_its_keys(tmp_path: Path) -> None:
    """Runs are numbered along the first key, then the second: another order would mix two tables of runs."""
    step = {"kind": "step", "pitch_deg": 5.0, "at_s": 0.2}
    keys = {"reference.pitch_deg": {"grid": [1.0, 2.0]}, "reference.at_s": {"grid": [0.1, 0.2]}}
    loop: dict[str, Any] = {"duration_s": 1.0, "plant": {"neck": "paper"}, "reference": step}
    one, again = (make_study(loop, vary=keys) for _ in range(2))
    turned = make_study(loop, vary=dict(reversed(keys.items())))
    # The order of the loop's own keys is no other study.
    same = make_study(dict(reversed(loop.items())), vary=keys)
    assert one.digest == again.digest == same.digest
    assert [p.labels for p in one.points] != [p.labels for p in turned.points]
    Store(one, tmp_path)
    for study in (one, again, same):
        assert Store(study, tmp_path).done == set()
    with pytest.raises(SettingsError, match=r"another study \(other order of vary\)"):
        Store(turned, tmp_path)
    with pytest.raises(SettingsError, match=r"another study \(other seed\)"):
        Store(replace(one, seed=1), tmp_path)
    assert Store(turned, tmp_path, force=True).done == set()
    with pytest.raises(SettingsError, match="`objectives` is empty"):
        replace(one, objectives=())
    assert make_study(loop, vary=keys, objectives=()).objectives == one.objectives


@pytest.mark.parametrize(
    ("one", "other"),
    [(Path("a"), Path("b")), ({"x": 1.0}, {"x": 2.0}), ([1, "a", None], [1, "a", True]), ((1, 2), (2, 1)),
     ({"x": [Path("a")]}, {"x": [Path("b")]}), (1, "1")],
)  # fmt: skip
def test_what_a_study_varies_is_told_apart_in_its_description(one: Any, other: Any) -> None:
    told = [json.dumps(_study._plain(value)) for value in (one, one, other)]
    assert told[0] == told[1] != told[2]
    assert _study._plain(Path("a/b")) == "a/b"
    assert _study._plain({1: (2.5, None)}) == {"1": [2.5, None]}


def test_a_cluster_is_asked_for_each_run_anew_and_has_two_chunks_for_each_of_its_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Dask keeps results of pure functions by their arguments; runs write what their loops measured, each time."""
    pool, client = Mock(), Mock()
    client.scheduler_info.return_value = {"workers": {"a": {"nthreads": 2}, "b": {"nthreads": 3}}}
    client.get_executor.return_value = pool
    monkeypatch.setattr(_run_study, "_client", lambda _: client)
    with _run_study.open_workers(None, "tcp://there") as workers:
        assert (workers.size, workers.pool, workers.start) == (5, pool, None)
    client.get_executor.assert_called_once_with(pure=False)
    client.scheduler_info.assert_called_once_with(n_workers=-1)  # all of them, not the first five
    pool.shutdown.assert_called_once_with(wait=False)
    client.close.assert_called_once()
    with pytest.raises(SettingsError, match="not both"), _run_study.open_workers(2, "tcp://there"):
        pass
    for number in (-1, True, 2.5):
        with pytest.raises(SettingsError, match="`workers` must be"), _run_study.open_workers(number, None):  # pyright: ignore[reportArgumentType]
            pass
    with _run_study.open_workers(0, None) as workers:
        assert (workers.size, type(workers.pool)) == (1, _run_study.SameProcess)


@pytest.mark.parametrize(
    ("vary", "values", "kind"),
    [(Vary("grid", (1, 2), (1, 2)), [1, 2], "int64"), (Vary("grid", (1, 0.5), (1, 0.5)), [1.0, 0.5], "float64"),
     (Vary("grid", ("1", "x"), ("1", "x")), ["1", "x"], "str"),
     (Vary("grid", (True, "x"), (True, "x")), ["True", "x"], "str"),
     (Vary("choices", (True, False), (True, False)), ["True", "False"], "str"), (Vary("seed"), [7, 8], "int64"),
     (Vary("uniform", (0.0, 1.0)), [0.1, 1.0 / 3.0], "float64")],
)  # fmt: skip
def test_what_was_varied_is_read_back_as_it_was_written(vary: Vary, values: Any, kind: str, tmp_path: Path) -> None:
    table = runs_of((1.0, math.inf), holds=[True, None], errors=["", "it\u2028is, gone"]).assign(kind=values)
    table.to_csv(tmp_path / "a.csv", index=False)
    found = _store._read(tmp_path / "a.csv", {"kind": vary})
    assert column_types(["kind", "run", ERROR], {"kind": vary}) == {"kind": kind, "run": "int64", ERROR: "float64"}
    assert found["kind"].tolist() == values
    assert [type(value) for value in found["kind"].tolist()] == [type(value) for value in values]
    assert found["error"].tolist() == table["error"].tolist()
    assert found["holds"].tolist() == [True, pd.NA]
    assert found[ERROR].tolist() == [1.0, math.inf]


def test_a_cell_is_one_line_that_every_reader_of_tables_takes() -> None:
    assert _store._cell(" a\n b\tc ") == "a b c"
    assert _store._cell("a\0b") == "a?b"
    assert _store._cell("\ud800") == "\\ud800"  # half a character
    assert len(_store._cell("x" * 5000)) == 2000
    assert (_store._cell(1.5), _store._cell(None), _store._cell("")) == (1.5, None, "")


@pytest.mark.parametrize("text", ["{}", "[]", "1", "{", '{"format": 1}', None])
def test_a_folder_that_describes_no_study_is_refused(text: str | None, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "study.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"study\.json"):
        read_runs(tmp_path)
    (tmp_path / "study.json").write_text('{"study": {"vary": {"a": {"kind": "grid", "labels": [1, 2]}, "b": 3}}}')
    found = read_runs(tmp_path)
    assert (list(found.columns), len(found), found["run"].dtype) == (["run"], 0, np.int64)


@pytest.mark.parametrize("inner", [{}, {"folder": "parts"}])
def test_the_worst_runs_are_loop_files_that_start_where_the_study_does(inner: dict[str, str], tmp_path: Path) -> None:
    runs = runs_of((1.0, 3.0, 2.0, math.nan), errors=["", "", "", "it diverged"])
    study: Any = SimpleNamespace(
        objectives=[ERROR],
        name="mine",
        folder=tmp_path / "study",
        table=lambda run: {"duration_s": float(run), **inner},
    )
    paths = write_worst(study, runs, tmp_path / "out" / "worst", count=2)
    assert [path.name for path in paths] == ["run_00003.toml", "run_00001.toml"]
    texts = [path.read_text() for path in paths]
    assert texts[0].startswith("# Run 3 of study mine; it failed: it diverged\n")
    assert texts[1].startswith("# Run 1 of study mine.\n")
    start = (tmp_path / "out" / "worst" / tomllib.loads(texts[1])["folder"]).resolve()
    assert start == tmp_path / "study" / inner.get("folder", "")
    assert [tomllib.loads(text)["duration_s"] for text in texts] == [3.0, 1.0]
    study.table = lambda _: {"plant": [{"x": {OBJECT: 1}}]}
    with pytest.raises(SettingsError, match="parts that are not files"):
        write_worst(study, runs, tmp_path)
    assert not _store.has_objects({"plant": [{"x": {"file": OBJECT}}], "y": OBJECT})


def test_a_scheduler_is_asked_for_ten_seconds_and_is_nobody_elses_default(monkeypatch: pytest.MonkeyPatch) -> None:
    there = SimpleNamespace(Client=Mock(return_value="client"))
    monkeypatch.setattr(_run_study, "require_package", lambda _: None)
    monkeypatch.setitem(sys.modules, "distributed", there)
    assert _run_study._client("tcp://there") == "client"
    there.Client.assert_called_once_with("tcp://there", timeout=10, set_as_default=False)
    for error in (OSError, TimeoutError, ValueError, TypeError):
        there.Client.side_effect = error("no")
        with pytest.raises(SettingsError, match=f"no Dask scheduler answers at tcp://there .{error.__name__}"):
            _run_study._client("tcp://there")


@pytest.mark.parametrize("kind", [Loop, LoopSetup])
def test_a_loop_itself_is_studied_as_its_table_from_where_the_study_is_made(
    kind: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Mock(spec=kind)
    monkeypatch.setattr(_study, "loop_table", lambda given: {"of": given})
    assert _study._open_loop(loop) == ({"of": loop}, Path.cwd())


@pytest.mark.parametrize("loop", [5, None, ["loop.toml"], object()])
def test_a_loop_that_is_none_and_a_file_that_is_not_there_are_refused(loop: Any, tmp_path: Path) -> None:
    vary = {"duration_s": [1.0, 2.0]}
    with pytest.raises(SettingsError, match="`loop` must be a loop file or a table"):
        make_study(loop, vary=vary)
    with pytest.raises(FileFormatError, match=r"there is no loop file .*none\.toml"):
        make_study(tmp_path / "none.toml", vary=vary)
    with pytest.raises(SettingsError, match="`loop` is missing"):
        _study._from_table(tmp_path / "study.toml", {"runs": 2})
    with pytest.raises(SettingsError, match="`vary` must be a table"):
        _study._from_table(tmp_path / "study.toml", {"loop": "a", "vary": 3})


def test_a_library_that_the_system_holds_fails_no_study_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows deletes no file of a loaded FMU."""
    made: list[dict[str, Any]] = []

    class Folder(_run_study.tempfile.TemporaryDirectory):
        def __init__(self, **how: Any) -> None:
            made.append(how)
            super().__init__(**how)

    ended: list[bool] = []
    pool = SimpleNamespace(shutdown=lambda *, wait, kill_workers: ended.append(wait and not kill_workers))
    monkeypatch.setattr(_run_study.tempfile, "TemporaryDirectory", Folder)
    monkeypatch.setattr(_run_study, "_processes", lambda *_: pool)
    with _run_study.open_workers(2, None) as workers:
        assert (workers.size, workers.pool) == (2, pool)
    assert (ended, [how["ignore_cleanup_errors"] for how in made]) == ([True], [True])
