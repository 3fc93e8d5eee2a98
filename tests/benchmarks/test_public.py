"""Public benchmarks on stand-ins of known answer: formats as published, their splits, and what is not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.public import BENCHMARKS, identified, main, rmse, run
from softneck.core import Vector

from ..data import slow_but

NOISE = 1e-3
OF = {benchmark.name: benchmark for benchmark in BENCHMARKS}


def lag(rows: int, seed: int) -> tuple[Vector, Vector]:
    """Steps, and a lag of a tenth in each sample behind them, around 1, with noise."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 10 + 1), 10)[:rows]
    y = np.asarray(lfilter([0.0, 0.05], [1.0, -0.9], u))
    return u, 1.0 + y + NOISE * rng.standard_normal(rows)


def write(name: str, folder: Path, rows: int = 400) -> None:
    """Write a benchmark's files as they are published, row or column vectors as there."""
    from scipy.io import savemat

    (u, y), (v, z) = lag(rows, 1), lag(rows, 2)
    if name == "tanks":
        columns = {"uEst": u, "yEst": y, "uVal": v, "yVal": z}
        savemat(folder / "dataBenchmark.mat", {key: x[:, None] for key, x in columns.items()} | {"Ts": [[4.0]]})
    elif name == "silverbox":
        u, y = lag(127_500, 3)
        savemat(folder / "SNLS80mV.mat", {"V1": u[None], "V2": y[None]})
    elif name == "wiener-hammerstein":
        u, y = lag(184_000, 4)
        savemat(
            folder / "WienerHammerBenchMark.mat", {"uBenchMark": u[:, None], "yBenchMark": y[:, None], "fs": 51200.0}
        )
    elif name == "emps":
        t = 0.001 * np.arange(rows)
        for file, (f, q) in (("DATA_EMPS.mat", (u, y)), ("DATA_EMPS_PULSES.mat", (v, z))):
            savemat(folder / file, {"vir": f[:, None], "qm": q[:, None], "qg": q[:, None], "t": t[:, None]})
    else:
        lines = ["time [s],pressure_1,pressure_2,pressure_3,x,y,run"]
        for number in (0, 1):
            (a, x), (b, w), (c, _) = (lag(rows, 5 + 3 * number + i) for i in range(3))
            lines += [f"{0.083 * k},{a[k]},{b[k]},{c[k]},{x[k]},{w[k]},{number}" for k in range(rows)]
        (folder / "pneumatic_arm_two_trials.csv").write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.parametrize("name", OF)
def test_a_stand_in_is_read_and_split_as_published(name: str, tmp_path: Path) -> None:
    write(name, tmp_path)
    train, tests = OF[name].read(tmp_path)
    expected = {
        "tanks": (400, {"validation": 400}),
        "silverbox": (65062, {"multisine": 21688, "arrow": 40475, "arrow without its tip": 32000}),
        "wiener-hammerstein": (100_000, {"test": 78_800}),
        "emps": (400, {"pulses": 400}),
        "pneumatic-arm": (560, {"ends": 240}),
    }
    assert (len(train), {key: len(test) for key, test in tests.items()}) == expected[name]
    assert len(train.robot.motors.names) == (3 if name == "pneumatic-arm" else 1)


@pytest.mark.parametrize("name", slow_but(["tanks", "emps", "pneumatic-arm"], ["emps"]))
def test_the_error_of_a_stand_in_is_its_noise(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(name, tmp_path)
    # Of the two kinds one is told a dead time that is wrong: the hold-out tells.
    candidates = [("oe", {"delay": 1.0}), ("oe", {"delay": 0.0})]
    for error in run(OF[name], tmp_path, candidates).values():
        # The truth is a lag without dead time: noise is left, and what some hundred rows do not tell.
        assert np.all((error > 0.8 * NOISE) & (error < 2.0 * NOISE))
    said = capsys.readouterr().out
    assert "published: " in said
    assert said.count("% of the spread") == 2 or "dead time" in said


def said(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[int, list[str]]:
    """Return exit code and last line on each of stdout and stderr."""
    monkeypatch.setattr("sys.argv", ["public.py", *arguments])
    try:
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, (captured.out + captured.err).splitlines()


def test_a_file_that_is_not_there_is_said_with_where_it_is_described(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, lines = said([str(tmp_path)], capsys, monkeypatch)
    assert code == 0
    assert len(lines) == len(BENCHMARKS)
    assert all(" described at " in line for line in lines)
    # One that was asked for is an error.
    write("emps", tmp_path)
    (tmp_path / "DATA_EMPS_PULSES.mat").unlink()
    code, lines = said([str(tmp_path), "--only", "emps"], capsys, monkeypatch)
    assert code == 2
    assert lines == [f"emps: no DATA_EMPS_PULSES.mat in {tmp_path}; described at {OF['emps'].described}."]
    code, lines = said([str(tmp_path / "nowhere")], capsys, monkeypatch)
    assert code == 2
    assert "nowhere is not a folder; give the one" in lines[-1]


@pytest.mark.parametrize(
    ("name", "file", "content", "words"),
    [
        ("tanks", "dataBenchmark.mat", b"", "cannot be read as a MAT file"),
        ("tanks", "dataBenchmark.mat", b"<html>Not found</html>" * 20, "cannot be read as a MAT file"),
        ("tanks", "dataBenchmark.mat", {"uEst": np.ones(9)}, "has no `yEst`, `uVal`, `yVal`, `Ts`"),
        ("tanks", "dataBenchmark.mat", {"yEst": np.ones(9)}, "200 inputs and 9 outputs"),
        ("tanks", "dataBenchmark.mat", {"yEst": np.full(200, np.nan)}, "not a number"),
        ("tanks", "dataBenchmark.mat", {"yEst": "text"}, "has no numbers in `yEst`"),
        ("tanks", "dataBenchmark.mat", {"Ts": np.zeros((0, 0))}, "has no numbers in `Ts`"),
        ("silverbox", "SNLS80mV.mat", {"V1": np.ones(99), "V2": np.ones(99)}, "99 of 127400 samples"),
        ("emps", "DATA_EMPS.mat", {"t": np.ones(1)}, "`t` must have"),
        ("pneumatic-arm", "pneumatic_arm_two_trials.csv", b"x,y\n1,2\n", "time [s]"),
        ("pneumatic-arm", "pneumatic_arm_two_trials.csv", b"\xff\xfe\x00", "must have numbers in the columns"),
    ],
)  # fmt: skip
def test_a_broken_file_is_one_line(
    name: str,
    file: str,
    content: bytes | dict[str, object],
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from scipy.io import loadmat, savemat

    write(name, tmp_path, rows=200) if name != "silverbox" else None
    if isinstance(content, bytes):
        (tmp_path / file).write_bytes(content)
    elif "uEst" in content or name == "silverbox":
        savemat(tmp_path / file, content)
    else:
        whole = {key: value for key, value in loadmat(tmp_path / file).items() if not key.startswith("__")}
        savemat(tmp_path / file, whole | content)
    code, lines = said([str(tmp_path), "--only", name], capsys, monkeypatch)
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith(f"{name}: ")
    assert words in lines[0]
    assert lines[0].endswith(f" Described at {OF[name].described}.")


@pytest.mark.slow
@pytest.mark.nightly
def test_of_several_seeds_the_median_runs(tmp_path: Path) -> None:
    write("tanks", tmp_path)
    train, tests = OF["tanks"].read(tmp_path)
    tiny = {"hidden": (1, 1), "starts": 1, "iterations": 1, "refine": 0}
    both = identified("nn", train, {**tiny, "seeds": 2})
    (test,) = tests.values()
    free = np.mean([model.simulate(test, warm_up=5)[:, 0] for model in both], axis=0)
    # Of two the median is the mean.
    np.testing.assert_allclose(rmse(both, test, 5), np.sqrt(np.mean((test.outputs[:, 0] - free)[5:] ** 2)), rtol=1e-12)
