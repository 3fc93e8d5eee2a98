"""`softneck identify --search`: what it prints and keeps, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.core import load
from softneck.identification.models._fitting import row_hashes
from softneck.signals import read_recording, write_recording

from ..data import neck_recording
from .conftest import Call


@pytest.fixture(scope="module")
def hold_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of another excitation than `recording`."""
    path = tmp_path_factory.mktemp("recordings") / "other.csv"
    write_recording(path, neck_recording(400, seed=8))
    return path


def test_a_search_prints_its_table_and_the_model_keeps_it(call: Call, recording: Path, hold_out: Path) -> None:
    said = call("identify", "rls", recording, "-o", "m.npz", "--hold-out", hold_out, "--plot", "costs.png",
                "--search", "na=1,2", "--search", "delay=0,0.06")  # fmt: skip
    assert said.code == 0, said.err
    assert "4 settings on the hold-out" in said.out
    assert said.out.count("na=") == 4
    assert said.out.count("<- chosen") == 1
    model = load("m.npz")
    assert len(model.findings["search"]["trials"]) == 4
    assert model.settings["na"] == model.findings["search"]["best"]["na"]
    assert Path("costs.png").read_bytes().startswith(b"\x89PNG")
    # What trained is the first 70 % of the recording: neither the rest of it nor the hold-out.
    head, _ = read_recording(recording).split(0.7)
    assert sorted(model.training_rows) == sorted(row_hashes(head))


def test_lists_angles_and_words_are_values_too(call: Call, recording: Path, hold_out: Path) -> None:
    said = call("identify", "nlsm", recording, "-o", "m.npz", "--hold-out", hold_out, "--json", "--strategy",
                "coordinate", "--set", "form=lags", "--search", "motor_lags=[3],[1,3]", "--search", "epsilon_deg=0.5,1",
                "--search", "scale=none,std")  # fmt: skip
    assert said.code == 0, said.err
    found = json.loads(said.out)["search"]
    assert set(found["best"]) == {"motor_lags", "epsilon", "scale"}
    # 0.5 deg is 0.0087 rad.
    assert [row[0] for row in found["curves"]["epsilon"]] == pytest.approx([0.00872665, 0.0174533], rel=1e-5)
    assert [row[0] for row in found["curves"]["scale"]] == ["none", "std"]
    assert found["trials"][0]["settings"]["motor_lags"] == [3]


def test_an_interrupted_search_keeps_what_it_has_and_says_130(
    call: Call, recording: Path, hold_out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from softneck.identification.selection import _search

    real = _search.attempt
    done: list[int] = []

    def two_then_stop(*given: object) -> object:
        done.append(1)
        if len(done) > 2:
            raise KeyboardInterrupt
        return real(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(_search, "attempt", two_then_stop)
    said = call("identify", "rls", recording, "-o", "m.npz", "--hold-out", hold_out, "--search", "na=1,2,3,4,5,6")
    assert said.code == 130
    assert load("m.npz").findings["search"]["interrupted"] is True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--search", "na=1"), "--search needs --hold-out REC"),
        (("--hold-out", "REC2"), "--hold-out and --plot belong to --search"),
        (("--search", "na", "--hold-out", "REC2"), "--search takes KEY=V1,V2,...; got `na`"),
        (("--search", "magic=1", "--hold-out", "REC2"), "there is no setting `magic` to search; this kind has "),
        (("--search", "na=x", "--hold-out", "REC2"), "`na` must be a whole number"),
        (("--search", "na=1", "--search", "na=2", "--hold-out", "REC2"), "--search names `na` twice"),
        (("--search", "na=1", "--hold-out", "REC"), "rows of the hold-out are training rows"),
        (("--search", "na=1", "--hold-out", "none.csv"), "none.csv: no such file"),
    ],
)
def test_a_search_that_cannot_be_is_one_clear_line(
    call: Call, recording: Path, hold_out: Path, options: tuple[str, ...], message: str
) -> None:
    files = {"REC": recording, "REC2": hold_out}
    said = call("identify", "rls", recording, "-o", "m.npz", *(files.get(option, option) for option in options))
    assert said.code == 2
    assert message in said.error
    assert not Path("m.npz").exists()
