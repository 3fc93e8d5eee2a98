"""The page, the picture, the icon and the licences inside an FMU."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from softneck.core import SettingsError
from softneck.fmu import FmuInfo, build_fmu, fmu_info
from softneck.fmu.describe._figures import line_chart
from softneck.fmu.python import _build
from softneck.identification import Rls, validate

from ..data import slow_but
from .every_kind import FAMILIES, KINDS, SHORT, block_of, recording


def _page(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        return archive.read("documentation/index.html").decode()


@pytest.mark.parametrize("kind", slow_but(KINDS, SHORT, set(KINDS) - {*FAMILIES}))
def test_every_fmu_carries_page_picture_icon_and_licences(kind: str, tmp_path: Path) -> None:
    path = build_fmu(block_of(kind), tmp_path / f"{kind}.fmu", info=FmuInfo(license="CC-BY-4.0"))
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        own = archive.read("documentation/licenses/license.txt").decode()
        archive.extract("model.png", tmp_path)
    assert "documentation/licenses/pythonfmu.txt" in names
    assert own.startswith("CC-BY-4.0\n")
    assert "BSD 3-Clause" in own
    page = _page(path)
    assert "Answer to a step" in page
    assert not re.search(r"""(?:src|href)=["'](?!licenses/)""", page)  # nothing from outside
    with Image.open(tmp_path / "model.png") as icon:
        icon.load()
        assert (icon.format, icon.size) == ("PNG", (96, 96))
        colours = icon.getcolors(10_000) or []
    assert len(colours) > 2  # a drawing with soft edges, not one flat colour


def test_icons_tell_kinds_apart() -> None:
    icons = {(block_of(kind).kind, block_of(kind).role) for kind in KINDS}
    assert len({_build.icon_png(*both) for both in icons}) == len(icons)


def test_the_step_response_is_the_block_s(tmp_path: Path) -> None:
    block = block_of("rls")
    u = np.full((200, len(block.inputs)), np.nan)
    u[:, :3] = 0.0
    u[25:, 0] = 2.0  # what the picture says: 2 rad at 0.5 s
    start = block.initial_state()
    y = np.vstack([start.outputs, block.run(start, u)[1][:-1]])
    time = 0.02 * np.arange(200)
    curves = {"pitch": np.degrees(y[:, 0]), "roll": np.degrees(y[:, 1])}
    picture = line_chart(time, curves, title="Answer to a step of 2 rad in motor_setpoint_1", unit="deg")
    assert picture in _page(build_fmu(block, tmp_path / "Rls.fmu"))


def test_scores_and_free_run_of_a_validation_are_shown(tmp_path: Path) -> None:
    data = recording()
    model = Rls().fit(data.rows(0, 500))
    judged = validate(model, data, names=("rls", "my <data>"))
    page = _page(build_fmu(model.block(), tmp_path / "Rls.fmu", info=fmu_info(model, validation=judged)))
    fit = judged.fits["inf"]["pitch"]
    assert fit is not None
    assert f"<td>this model</td><td>free run</td><td>{fit:.2f}</td>" in page
    assert f"on {judged.rows_scored} rows of my &lt;data&gt;; {judged.rows_left_out} rows" in page
    for text in ("How it was identified", "What it is not good for", "trained on 500 rows", "<td>forgetting</td>"):
        assert text in page


def test_a_model_without_scores_says_so() -> None:
    text = fmu_info(Rls().fit(recording())).documentation
    assert "None were given when this FMU was built" in text


@pytest.mark.parametrize(
    "values", [np.zeros(50), np.full(50, np.nan), np.array([1e-9, 2e-9] * 25), np.linspace(-1e6, 1e6, 50)],
    ids=["flat", "nothing", "tiny", "huge"],
)  # fmt: skip
def test_any_curve_makes_a_picture_that_is_xml_and_within_its_frame(values: np.ndarray) -> None:
    text = line_chart(np.arange(50) * 0.1, {"a & b": values}, title="<t>", unit="rad")
    root = ElementTree.fromstring(text)
    curve = root.findall("{http://www.w3.org/2000/svg}path")[-1].get("d") or ""
    points = np.array(re.findall(r"[ML](\S+) ([-\d.]+)", curve), dtype=float).reshape(-1, 2)
    assert len(points) == np.isfinite(values).sum()
    assert ((points >= 0) & (points <= [640, 240])).all()
    # SVG draws nothing of a path that does not begin by moving; each stretch without gaps moves once.
    finite = np.isfinite(values)
    assert curve.count("M") == np.count_nonzero(np.diff(finite.astype(int), prepend=0) == 1)


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
