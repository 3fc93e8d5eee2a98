"""What arms the drives: a verification, a loop certificate that covers the run, and the same loop again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.core import CheckFailedError, SettingsError, file_hash, read_certificate, write_certificate
from softneck.core._certificate import certificate_contents
from softneck.cosim import load_loop, simulate
from softneck.drives import prepare
from softneck.drives.running._certified import require_certified, require_same_again
from softneck.verification import read_requirements
from softneck.verification._drawn import certified_content

from .certified import ARMING, drawn_rows, verified_rows, write_verified
from .conftest import STEP, Project

DRIVES = 'profile = "ipos2015"\n' + "".join(f"[[drive]]\nnode = {n}\npeak_current_A = 10.0\n" for n in (1, 2, 3))


def edited(source: Path, path: Path, **changes: object) -> Path:
    """Write a certificate with other contents and a seal that fits: the seal is a checksum, anybody can make it."""
    contents = json.loads(source.read_text(encoding="utf-8")) | changes
    more = {
        key: contents[key] for key in contents
        if key not in ("certificate", "certificate_version", "softneck", "holds", "files", "seal")
    }  # fmt: skip
    files = {role: (entry["path"], entry["sha256"]) for role, entry in contents["files"].items()}
    write_certificate(path, certificate_contents("simulate", holds=contents["holds"], files=files, more=more))
    return path


def test_both_certificates_let_a_run_begin(project: Project) -> None:
    found = require_certified(load_loop(project.loop), project.controller, [project.certificate])
    assert found is not None
    assert [item.kind for item in found] == ["verify", "simulate"]
    # Both lie beside controller and loop file.
    assert require_certified(load_loop(project.loop), project.controller) is not None
    assert require_certified(load_loop(project.loop), project.controller, [], ["certificate"]) is None


def test_an_empty_certificate_arms_nothing(project: Project, tmp_path: Path) -> None:
    empty = edited(project.certificate, tmp_path / "empty.json", limits=[])
    assert not read_certificate(empty).holds
    with pytest.raises(CheckFailedError, match=r"empty\.json: has no requirements, so it certifies nothing"):
        require_certified(load_loop(project.loop), project.controller, [empty])


def test_a_loop_without_limits_holds_nothing_and_gets_no_certificate(project: Project) -> None:
    path = project.write_loop("free.toml", STEP, 0.04)
    path.write_text(path.read_text(encoding="utf-8").partition("[limits]")[0], encoding="utf-8")
    result = simulate(load_loop(path))
    assert not result.holds
    with pytest.raises(SettingsError, match=r"no \[limits\]"):
        result.certificate()


def test_a_verification_is_needed_as_well(project: Project, tmp_path: Path) -> None:
    alone = tmp_path / "pi.npz"
    alone.write_bytes(project.controller.read_bytes())
    with pytest.raises(CheckFailedError, match=r"pi\.npz: has no certificate of `softneck verify`"):
        require_certified(load_loop(project.loop), alone, [project.certificate])
    with pytest.raises(CheckFailedError, match=r"other\.toml: has no certificate of `softneck simulate`"):
        require_certified(load_loop(project.write_loop("other.toml", STEP, 3.0)), project.controller)


@pytest.mark.parametrize("metric", ARMING)
def test_each_metric_of_the_minimum_is_needed_as_strictly_as_by_default(
    project: Project, tmp_path: Path, metric: str
) -> None:
    setup, default = load_loop(project.loop), {item.metric: item for item in read_requirements().bounds}[metric]
    looser = default.limit * (0.5 if default.bound == "min" else 2.0)
    stricter = default.limit * (2.0 if default.bound == "min" else 0.5)
    for change, refused in (
        (None, "was not asked for"),
        ({"holds": None, "note": "not computed: no linear form"}, "not computed: no linear form"),
        ({"limit": looser}, f"it asks for {looser:g}, the default is {default.limit:g}"),
        ({"bound": "max" if default.bound == "min" else "min"}, "the default is"),
        ({"limit": stricter}, ""),
    ):
        rows = verified_rows()
        if change is None:
            del rows[metric]
        else:
            rows[metric] |= change
        path = write_verified(project.controller, rows, tmp_path / "verified.json")
        if not refused:
            assert require_certified(setup, project.controller, [path]) is not None
            continue
        with pytest.raises(CheckFailedError, match=rf"does not show `{metric}` .*{refused}"):
            require_certified(setup, project.controller, [path])


DRAWS = {"family": "f.npz", "count": 59, "failed": [], "attempt": 4, "content": certified_content(59, 4)}


def test_a_certificate_of_draws_arms_by_what_their_loops_show(project: Project, tmp_path: Path) -> None:
    setup, path = load_loop(project.loop), tmp_path / "verified.json"
    write_verified(project.controller, drawn_rows(), path, draws=[DRAWS])
    assert require_certified(setup, project.controller, [path]) is not None
    # Without draws the linear rows, which decide nothing here, are what is asked for.
    write_verified(project.controller, drawn_rows(), path)
    with pytest.raises(CheckFailedError, match=r"does not show `stability\.radius` .*: shown only\. Verify again"):
        require_certified(setup, project.controller, [path])


@pytest.mark.parametrize(
    ("name", "change", "refused"),
    [
        ("axes.gain_margin", {"limit": 1.5}, "it asks for 1.5, the default is 2"),
        ("axes.delay_margin_ms", {"holds": False}, "it does not hold"),
        ("sim.overshoot_pct", {"limit": 16.0}, "it asks for 16, the default is 15"),
        ("sim.load_rms_deg", None, "it was not asked for"),
        ("sim.slack_s", {"holds": None, "note": "not computed: verify over FAMILY and a NECK"}, "verify over FAMILY"),
    ],
)
def test_a_certificate_of_draws_that_shows_too_little_is_refused(
    project: Project, tmp_path: Path, name: str, change: dict | None, refused: str
) -> None:
    rows = drawn_rows()
    if change is None:
        del rows[name]
    else:
        rows[name] |= change
    holds = all(row["holds"] is not False for row in rows.values())
    path = write_verified(project.controller, rows, tmp_path / "verified.json", draws=[DRAWS])
    message = rf"does not show `{name}` .*{refused}" if holds else rf"{name} did not hold"
    with pytest.raises(CheckFailedError, match=message):
        require_certified(load_loop(project.loop), project.controller, [path])


@pytest.mark.parametrize(
    "draws",
    # JSON has no NaN, a text that is read as one has it.
    [
        [DRAWS | {"failed": [3]}],
        [DRAWS, DRAWS | {"content": 0.89}],
        [{}],
        [DRAWS, DRAWS | {"content": "nan"}],
        "59",
        59,
    ],
)
def test_draws_that_fail_or_are_too_few_arm_nothing(project: Project, tmp_path: Path, draws: object) -> None:
    path = write_verified(project.controller, drawn_rows(), tmp_path / "verified.json", draws=draws)
    with pytest.raises(CheckFailedError, match=r"its draws stand for .* make the family with --draws 59"):
        require_certified(load_loop(project.loop), project.controller, [path])


def test_a_loop_certificate_covers_each_file_for_the_whole_run(project: Project, tmp_path: Path) -> None:
    setup = load_loop(project.loop)
    changed = load_loop(project.write_loop("other.toml", STEP, 3.0))
    with pytest.raises(CheckFailedError, match=r"other\.toml: is not what was certified"):
        require_certified(changed, project.controller, [project.certificate])
    other = tmp_path / "pi.npz"
    other.write_bytes(project.controller.read_bytes() + b"\0")
    write_verified(other)
    with pytest.raises(CheckFailedError, match=r"pi\.npz: was changed after it was certified"):
        require_certified(setup, other, [project.certificate])
    short = edited(project.certificate, tmp_path / "short.json", duration_s=3.9)
    with pytest.raises(CheckFailedError, match=r"short\.json: is for 3\.9 s, the run takes 4 s"):
        require_certified(setup, project.controller, [short])


def test_a_certificate_without_a_duration_covers_no_run_however_short(project: Project, tmp_path: Path) -> None:
    path = project.write_loop("brief.toml", STEP, 0.5)
    setup, certificate = load_loop(path), tmp_path / "brief.json"
    write_certificate(certificate, simulate(setup).certificate())
    require_certified(setup, project.controller, [certificate])
    for number, duration in enumerate((None, 0.0, "nan")):
        short = edited(certificate, tmp_path / f"{number}.json", duration_s=duration)
        with pytest.raises(CheckFailedError, match=r"is for (0|nan) s, the run takes 0\.5 s"):
            require_certified(setup, project.controller, [short])


def test_a_loop_certificate_covers_the_drives_file(project: Project) -> None:
    drives = project.folder / "my_drives.toml"
    drives.write_text(DRIVES, encoding="utf-8")
    with pytest.raises(CheckFailedError, match=r"loop\.toml: names no drives file; write `drives = "):
        require_certified(load_loop(project.loop), project.controller, [project.certificate], drives=drives)
    path = project.write_loop("with_drives.toml", STEP, 0.5)
    path.write_text('drives = "my_drives.toml"\n' + path.read_text(encoding="utf-8"), encoding="utf-8")
    setup = load_loop(path)
    certificate = path.with_name("with_drives.certificate.json")
    write_certificate(certificate, simulate(setup).certificate())
    assert read_certificate(certificate).files["drives"] == (str(drives), file_hash(drives))
    require_certified(setup, project.controller, drives=drives)
    drives.write_text(DRIVES.replace("10.0", "20.0"), encoding="utf-8")
    with pytest.raises(CheckFailedError, match=r"my_drives\.toml: was changed after it was certified"):
        require_certified(setup, project.controller, drives=drives)


def test_the_loop_has_to_do_again_what_was_certified(project: Project, tmp_path: Path) -> None:
    deployed = prepare(load_loop(project.loop), project.controller)
    certificate = read_certificate(project.certificate)
    assert require_same_again(deployed.loop, certificate) == pytest.approx(4.0, abs=1e-9)
    trace = dict(certificate.contents["trace"])
    assert (trace["row"][0], trace["row"][-1], len(trace["row"])) == (0, 199, 50)
    shifted = np.array(trace["motor_setpoint_2"])
    shifted[30] += 1.5e-4
    other = edited(project.certificate, tmp_path / "c.json", trace=trace | {"motor_setpoint_2": shifted.tolist()})
    with pytest.raises(CheckFailedError, match=r"does not do again what was certified: `motor_setpoint_2` is"):
        require_same_again(deployed.loop, read_certificate(other))
    shifted[30] -= 1e-4
    other = edited(project.certificate, tmp_path / "d.json", trace=trace | {"motor_setpoint_2": shifted.tolist()})
    require_same_again(deployed.loop, read_certificate(other))
    old = edited(project.certificate, tmp_path / "old.json", trace=None)
    with pytest.raises(CheckFailedError, match=r"old\.json: is of an earlier softneck"):
        require_same_again(deployed.loop, read_certificate(old))


def test_a_slow_loop_is_compared_for_as_far_as_two_seconds_get(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("softneck.drives.running._certified._REPLAY_TIME", 0.0)
    deployed = prepare(load_loop(project.loop), project.controller)
    assert require_same_again(deployed.loop, read_certificate(project.certificate)) < 4.0
