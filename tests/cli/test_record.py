"""softneck record: experiments of a frequency response, co-contraction, payload."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softneck import frequency_response
from softneck.signals import read_recording
from softneck.signals.recording._recording import conditions

from .conftest import Call


def test_what_it_needs_is_recorded_and_refused_in_a_line(call: Call, tmp_path: Path) -> None:
    said = call("record", "multisine", "--amplitude", "0.3", "--band", "2,6", "-o", "m.csv")
    assert said.code == 0, said.err
    assert frequency_response("m.csv").method == "robust"
    for options, line in (
        (
            ("eq22", "--band", "1,2"),
            "`--band` asks for experiments of a frequency response: the signal is `multisine` then",
        ),
        (("multisine", "--amplitude", "1", "--duration", "9"), "takes no `--duration`"),
        (("multisine", "--band", "1,2,3"), "`--band` is two frequencies in rad/s, such as 0.5,25; got `1,2,3`"),
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
