"""The page and the licences inside an FMU."""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import softneck
from softneck.core import SettingsError
from softneck.fmu import FmuInfo, build_fmu, fmu_info
from softneck.fmu.python import _build
from softneck.identification import OutputError, Rls, validate
from tests.design.test_robots import BELLOWS, DELAY, TS, plant

from ..data import slow_but
from .every_kind import FAMILIES, KINDS, SHORT, block_of, recording


def _page(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        return archive.read("documentation/index.html").decode()


@pytest.mark.parametrize("kind", slow_but(KINDS, SHORT, set(KINDS) - {*FAMILIES}))
def test_every_fmu_carries_page_and_licences(kind: str, tmp_path: Path) -> None:
    path = build_fmu(block_of(kind), tmp_path / f"{kind}.fmu", info=FmuInfo(license="CC-BY-4.0"))
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        own = archive.read("documentation/licenses/license.txt").decode()
    assert "documentation/licenses/pythonfmu.txt" in names
    assert own.startswith("CC-BY-4.0\n")
    assert "BSD 3-Clause" in own
    page = _page(path)
    assert "<h2>Variables</h2>" in page
    assert not re.search(r"""(?:src|href)=["'](?!licenses/)""", page)  # nothing from outside


def test_scores_of_a_validation_are_shown(tmp_path: Path) -> None:
    data = recording()
    model = Rls().fit(data.rows(0, 500))
    judged = validate(model, data, names=("rls", "my <data>"))
    page = _page(build_fmu(model.block(), tmp_path / "Rls.fmu", info=fmu_info(model, validation=judged)))
    fit = judged.fits["inf"]["pitch"]
    assert fit is not None
    assert f"<td>this model</td><td>simulation (free run)</td><td>{fit:.2f}</td>" in page
    assert f"on {judged.rows_scored} rows of my &lt;data&gt;; {judged.rows_left_out} rows" in page
    for text in ("How it was identified", "Limits of use", "trained on 500 rows", "<td>forgetting</td>"):
        assert text in page


@pytest.mark.parametrize("settings", [Rls(delay=0.06), OutputError(delay=0.06)])
def test_the_dead_time_that_was_given_is_the_one_that_is_said(settings: Any) -> None:
    assert "; dead time 0.06 s" in fmu_info(settings.fit(recording())).description


@pytest.mark.parametrize("kind", ["rls", "oe"])
def test_the_dead_time_of_another_robot_is_no_flag_beside_it(kind: str) -> None:
    """Models with learned directions are in state space, whose array `delay` holds a flag too."""
    said = fmu_info(replace(plant(BELLOWS), kind=kind)).description
    assert said.startswith("plant: 4 motor set-points [bar] -> x, y, z [mm]; ")
    assert f"; dead time {DELAY * TS:.3g} s" in said


def test_a_plant_says_what_it_is_with_its_held_out_fit() -> None:
    model = softneck.identify("rls", recording())
    found = model.findings["hold_out"]["fit"]
    info = fmu_info(model)
    fits = "/".join(f"{found[axis]:.1f}" for axis in ("pitch", "roll"))
    dead = "/".join(f"{d * 0.02:.3g}" for d in sorted(set(model.arrays["delay"].tolist())))
    assert info.description == (
        "plant: 3 motor set-points [rad] -> pitch, roll [deg]; recursive least squares over the redefined inputs, with "
        f"dead time; 20 ms; dead time {dead} s; simulation fit {fits} % on rows held out"
    )
    assert "None were given" not in info.documentation
    assert f"simulation  {fits}" in info.documentation
    assert info.stop_time == 10.0


def test_a_model_without_scores_says_so() -> None:
    info = fmu_info(Rls().fit(recording()))
    assert "None were given when this FMU was built" in info.documentation
    assert "fit" not in info.description
    assert "Eq." not in info.description


@pytest.mark.parametrize("lacking", ["linux64", "win64"])
def test_a_pythonfmu_without_a_binary_is_said_so(
    lacking: str, toys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _build.read_zip

    def without(path: Path) -> dict[str, bytes]:
        return {name: data for name, data in whole(path).items() if f"binaries/{lacking}/" not in name}

    monkeypatch.setattr(_build, "read_zip", without)
    with pytest.raises(SettingsError, match=f"the installed pythonfmu lacks binaries/{lacking}/; install pythonfmu"):
        build_fmu(toys.lag(), tmp_path / "Toy.fmu")
    assert list(tmp_path.iterdir()) == []
