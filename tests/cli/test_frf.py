"""softneck frf: from recordings to a response with a page and models beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from softneck import load
from softneck.identification import OutputError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import concatenate, multisine_experiments, read_recording, write_recording
from softneck.signals.recording._conditions import conditions

from .conftest import Call


def test_a_response_is_written_drawn_and_described(call: Call, tmp_path: Path) -> None:
    neck = VirtualNeck(NeckParameters.paper())
    parts = [
        record(item, neck, seed=i)
        for i, item in enumerate(multisine_experiments(amplitude=0.4, band=(1.0, 12.0), realisations=2))
    ]
    write_recording(tmp_path / "m.csv", concatenate(parts))
    OutputError().fit(concatenate(parts)).save(tmp_path / "oe.npz")
    said = call("frf", "m.csv", "-o", "f.npz", "--model", "oe.npz", "--html", "f.html", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["method"], facts["own_inputs"]) == ("robust", {"pitch": "theta_i", "roll": "phi_i"})
    low, high = facts["band_rad_s"]["pitch"]
    assert 1.0 <= low < high <= 12.1
    assert "theta_i to pitch" in (tmp_path / "f.html").read_text(encoding="utf-8")
    assert "supported from" in load(tmp_path / "f.npz").summary()
    info = json.loads(call("info", "f.npz", "--json").out)
    assert (info["type"], info["kind"]) == ("frequency response", "frf")
    again = call("frf", "m.csv", "-o", "f.npz")
    assert (again.code, "exists" in again.error) == (2, True)
    mixed = call("frf", "m.csv", "-o", "g.npz", "--model", "f.npz")
    assert (mixed.code, "f.npz: only a linear model or a family has a response to draw" in mixed.error) == (2, True)
    assert not (tmp_path / "g.npz").exists()


def test_what_it_needs_is_recorded_and_refused_in_a_line(call: Call, tmp_path: Path) -> None:
    said = call("record", "multisine", "--amplitude", "0.3", "--band", "2,6", "--realisations", "2", "-o", "m.csv")
    assert said.code == 0, said.err
    assert json.loads(call("frf", "m.csv", "--json").out)["method"] == "robust"
    said = call("frf", "m.csv", "-o", "f.csv")
    assert (said.code, "f.csv: must end in `.npz`" in said.error) == (2, True)
    for options, line in (
        (
            ("eq22", "--band", "1,2"),
            "`--band` asks for the experiments of `softneck frf`: the signal is `multisine` then",
        ),
        (("multisine", "--amplitude", "1", "--duration", "9"), "takes no `--duration`"),
        (("multisine", "--band", "1,2,3"), "`--band` is two frequencies in rad/s, such as 0.5,25, or one; got `1,2,3`"),
        (("multisine", "--band", "9,2"), "`band` must rise within"),
        (("multisine", "--amplitude", "20"), "beyond the motors' limits; lower `--amplitude`"),
    ):
        refused = call("record", *options, "-o", "u.csv")
        assert (refused.code, line in refused.error) == (2, True), refused.error
        assert not (tmp_path / "u.csv").exists()


def test_record_plays_around_a_cocontraction_and_says_its_payload(call: Call, tmp_path: Path) -> None:
    for name, more in (("plain", ()), ("taut", ("--cocontraction", "0.5", "--payload", "0.3"))):
        assert call("record", "eq22", "-o", f"{name}.csv", "--duration", "2", *more).code == 0
    plain, taut = (read_recording(tmp_path / f"{name}.csv") for name in ("plain", "taut"))
    # Files keep all digits of a double.
    np.testing.assert_allclose(taut.set_points, plain.set_points + 0.5, atol=1e-12)
    assert "payload" not in plain.channels
    assert conditions(taut)["payload_kg"] == [0.3, 0.3]
    above = call("record", "multisine", "-o", "x.csv", "--amplitude", "2.5", "--cocontraction", "5")
    assert (above.code, "the experiments go beyond the motors' limits" in above.error) == (2, True)
    assert call("record", "eq22", "-o", "x.csv", "--cocontraction", "nan").code == 2
    ended = call("record", "steps", "-o", "ended.csv", "--cocontraction", "5")
    assert "set-points: " in ended.out
