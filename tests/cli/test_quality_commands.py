"""`softneck info` tells a recording's quality, and `softneck record` keeps to limits."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.signals import read_recording, signal, write_recording

from ..data import neck_recording
from .conftest import Call


@pytest.mark.slow
def test_info_tells_the_quality_as_text_json_and_page(call: Call, tmp_path: Path) -> None:
    recording = neck_recording(600)
    pitch = recording.channels["pitch"].copy()
    pitch[100:120] = np.nan
    write_recording("r.csv", recording.with_channels(pitch=pitch))
    text = call("info", "r.csv")
    assert (text.code, text.err) == (0, "")
    assert "rows: 600" in text.out
    assert "  warning: pitch: misses 20 of 600 samples (3.3 %) in 1 gap(s); the longest is 0.40 s at" in text.out
    page = call("info", "r.csv", "--html", "q.html", "--json")
    told = json.loads(page.out)
    assert told["html"] == "q.html"
    assert told["quality"]["severity"] == "warning"
    assert told["quality"]["channels"]["pitch"]["missed"] == [{"start_row": 100, "rows": 20, "time_s": 2.0, "run": 0}]
    assert "misses 20 of 600" in (tmp_path / "q.html").read_text()
    assert "exists already" in call("info", "r.csv", "--html", "q.html").error
    assert call("info", "r.csv", "--html", "q.html", "--force").code == 0


def test_a_page_of_anything_but_a_recording_is_refused(call: Call, rls_file: Path, tmp_path: Path) -> None:
    said = call("info", rls_file, "--html", "q.html")
    assert said.code == 2
    assert "`--html` shows the quality of a recording" in said.error
    assert not (tmp_path / "q.html").exists()


def test_info_says_which_columns_of_another_robots_log_are_what(call: Call, tmp_path: Path) -> None:
    """As `import --guess` would: a titled clock made such a log a recording of the neck with a wrong channel."""
    u = np.repeat(np.random.default_rng(0).uniform(0.0, 5.0, 20), 20)
    rows = "\n".join(f"{0.02 * k:.2f};{u[k]:.4f};{u[k - 3]:.4f}".replace(".", ",") for k in range(3, 400))
    (tmp_path / "log.csv").write_bytes(f"time [s];Düse [V];Krümmung [°]\n{rows}\n".encode("cp1252"))
    said = call("info", "log.csv")
    assert (said.code, said.err) == (0, "")
    assert "type: log" in said.out
    assert "motors: Düse [V]" in said.out
    assert "outputs: Krümmung [°]" in said.out
    assert "missing: nothing that a recording needs" in said.out


def test_record_keeps_to_limits_and_says_what_it_changed(call: Call) -> None:
    said = call("record", "eq22", "-o", "r.csv", "--duration", 6, "--max-position", 2, "--json")
    changes = json.loads(said.out)["changes"]
    P = read_recording("r.csv").set_points
    # Files hold 17 digits.
    assert (P.max(), P.min()) == (2.0, -2.0)
    assert changes["position_clipped_pct"] > 0
    assert "% clipped in position" in call("record", "eq22", "-o", "s.csv", "--duration", 6, "--max-position", 2).out


def test_record_plays_the_frozen_signal_by_default(call: Call) -> None:
    said = call("record", "eq22", "-o", "r.csv", "--duration", 2)
    assert said.out == "r.csv: 100 rows of eq22 at 20 ms\n"
    np.testing.assert_array_equal(read_recording("r.csv").set_points, signal("eq22", duration=2.0).set_points)


def test_a_wrong_limit_is_one_line(call: Call, tmp_path: Path) -> None:
    said = call("record", "eq22", "-o", "r.csv", "--max-position", 0)
    assert (said.code, said.error) == (2, "softneck: `position` must be positive [rad]; got 0.")
    assert not list(tmp_path.iterdir())


def test_info_of_another_loggers_table_tells_what_it_lacks_as_a_log(call: Call, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time [s],valve [V],angle [deg]\n" + "".join(f"{k},2.5,{k % 7}\n" for k in range(50)))
    said = call("info", str(log))
    assert said.code == 2
    assert "no column was recognised as motor (valve [V] is constant at 2.5" in said.error
    # Whoever asks for a recording learns how a logger's table becomes one.
    said = call("identify", "oe", str(log))
    assert said.code == 2
    assert "column `valve` is not a channel of a recording of robot `neck`" in said.error
    assert "use `softneck import` with --guess" in said.error
    assert len(said.error.splitlines()) == 1


def test_info_of_a_file_that_takes_long_says_that_it_works(call: Call) -> None:
    for rows, seconds in ((200, 4), (16_000, 320)):
        assert call("record", "eq22", "-o", f"{rows}.csv", "--duration", seconds).code == 0
    assert call("info", "200.csv").err == ""
    # 1.6 MB: 3 s of processor time where 1 MB took 2 s.
    said = call("info", "16000.csv")
    assert (said.code, said.err.splitlines()[:1]) == (0, ["info ..."])
