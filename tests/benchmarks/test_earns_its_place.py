"""The command by which kinds stay: a restart computes nothing anew, a lead within the spread of seeds wins nothing."""

from pathlib import Path

import pytest

from benchmarks.earns_its_place import Cell, compute, table
from softneck.core import DataError


def cells(kinds: dict[str, list[float]]) -> dict[Cell, float]:
    """Return a score of each kind and seed on two robots."""
    return {
        Cell(robot, kind, seed, "eq22"): score
        for robot in ("chain", "foam")
        for kind, scores in kinds.items()
        for seed, score in enumerate(scores)
    }


def printed(kinds: dict[str, list[float]], kept: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the table of these scores."""
    scores = cells(kinds)
    compute(list(scores), kept, lambda cell: {"score": scores[cell]})
    capsys.readouterr()
    table(kept)
    return capsys.readouterr().out


def test_a_restart_skips_what_is_finished(tmp_path: Path) -> None:
    kept, calls = tmp_path / "models.jsonl", []

    def found(cell: Cell) -> dict[str, float]:
        calls.append(cell)
        if cell.seed == 1:
            raise DataError("too few rows.")
        return {"score": 1.0}

    wanted = list(cells({"oe": [1.0, 2.0, 3.0]}))
    compute(wanted[:4], kept, found)
    compute(wanted, kept, found)
    assert calls == wanted  # what failed is a result too


def test_the_best_wins_where_it_leads_on_every_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Seeds move both kinds alike: the lead is 5 whatever the seed, its spread 0.
    out = printed({"oe": [50.0, 60.0, 70.0], "play": [55.0, 65.0, 75.0]}, tmp_path / "a.jsonl", capsys)
    assert "play: best by more than the spread on chain, foam" in out
    assert "| `oe` | 60.0 (10.0) | 60.0 (10.0) |" in out


def test_a_lead_within_the_spread_of_seeds_wins_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Leads of 20, -10 and -7: 1 on average, 16.5 of standard deviation.
    out = printed({"oe": [50.0, 60.0, 60.0], "play": [70.0, 50.0, 53.0]}, tmp_path / "b.jsonl", capsys)
    assert "best by more" not in out


def test_forms_of_one_kind_are_no_rivals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # `guarded/nn` and `guarded/play` are equal; both lead over `nn`.
    scores = {"nn": [50.0, 51.0, 52.0], "guarded/nn": [60.0, 61.0, 62.0], "guarded/play": [60.0, 61.0, 62.0]}
    assert "guarded: best by more than the spread on chain, foam" in printed(scores, tmp_path / "c.jsonl", capsys)
