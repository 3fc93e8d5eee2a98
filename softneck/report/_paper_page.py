"""The page of `softneck reproduce-paper`: tables first, then the figures by their numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from softneck.identification import INFINITE
from softneck.identification.models._linear_systems import continuous_parameters
from softneck.plots import Section, Table, page

from ._paper import LINEAR
from ._paper_figures import paper_chart
from ._paper_tables import AXES, PAPER_HEAD, PAPER_NOTE, Entry, paper_entries
from ._reproduce import Reproduction

_PLANT = (
    "The plant is a virtual neck (preset `paper`), not the paper's hardware. What could be the plant's shows in the "
    "column other necks: the same estimators on the presets rough and lab and on necks drawn around paper."
)
# Measured with the free runs of all models: the paper's section 7.4.
_FIRST = 21
# Title of a section -> the numbers of its figures.
PARTS = {
    "The experiment (sections 3.1 and 4)": range(4, 8),
    "Validation (section 6)": range(8, 11),
    "Test 1: steps (section 7.1)": range(11, 14),
    "Test 2: sine of rising frequency (section 7.2)": range(14, 17),
    "Test 3: rotation (section 7.3)": range(17, 20),
    "Free run with measured motors (section 7.4)": range(20, 24),
}
LINEAR_HEAD = ["axis", "paper (Eq. 31)", "ours", "static gain: paper", "static gain: ours"]


def paper_page(found: Reproduction) -> str:
    """Return the HTML of a reproduction, self-contained."""
    rows = paper_entries(found)
    tables = [Table(title, PAPER_HEAD, [row.row() for row in part], text=3) for title, part in grouped(rows).items()]
    tables.append(Table("Eq. 31: the linear model, in deg", LINEAR_HEAD, linear_rows(found)))
    first = Section(
        "Tables 3 and 4, section 7.4", charts=[paper_chart(_FIRST, found)], tables=tables, method=[_PLANT, PAPER_NOTE]
    )
    sections = [first]
    for title, numbers in PARTS.items():
        sections.append(Section(title, charts=[paper_chart(number, found) for number in numbers if number != _FIRST]))
    return page(
        "The paper, reproduced on a virtual neck", sections, verdict=_verdict(found),
        footer="Written by softneck reproduce-paper.",
    )  # fmt: skip


def _verdict(found: Reproduction) -> str:
    """Return in a sentence which model is best where the paper's section 7.4 judges: free run on the tests."""
    least = {
        model: min(
            -np.inf if fit is None else fit
            for (name, _), pair in found.judged.items() if name == model
            for fit in pair.free.fits[INFINITE].values()
        )
        for model in found.models
    }  # fmt: skip
    best = max(least, key=lambda name: least[name])
    worst = ", ".join(
        f"{name} {'diverges' if np.isneginf(fit) else f'{fit:.1f} %'}" for name, fit in least.items() if name != best
    )
    return (
        f"Run free from set-points alone, {best} is the safest of the paper's models on the virtual neck: its worst "
        f"fit on any test is {least[best]:.1f} % (the others' worst: {worst})."
    )


def grouped(rows: list[Entry]) -> dict[str, list[Entry]]:
    """Return the entries of Table 3, Table 4 and section 7.4, each under its title."""
    titles = {
        "Table 3. Fitness of models on the validation data": "Table 3",
        "Table 4. Fitness on the three tests": "Table 4",
        "Section 7.4. Prediction and simulation": "section 7.4",
    }
    return {title: [row for row in rows if row.where.startswith(word)] for title, word in titles.items()}


def linear_facts(found: Reproduction) -> list[dict[str, Any]]:
    """Return gain K [deg/(rad s)], pole [1/s] and dead time [s] of each axis, the paper's (Eq. 31) and ours."""
    model = found.models["rls"]
    facts = []
    for axis, name in enumerate(AXES):
        ours = continuous_parameters(model.sample_time, model.arrays, axis)
        mine = None if ours is None else {"K": float(np.degrees(ours[0])), "p": ours[1], "L": ours[2]}
        facts.append({"axis": name, "paper": dict(zip("KpL", LINEAR[name], strict=True)), "ours": mine})
    return facts


def linear_rows(found: Reproduction) -> list[list[str]]:
    """Return the same as cells under `LINEAR_HEAD`."""
    rows = []
    for fact in linear_facts(found):
        pair = [fact["paper"], fact["ours"]]
        texts = ["-" if g is None else f"exp(-{g['L']:.2f} s) {g['K']:.2f}/(s + {g['p']:.3f})" for g in pair]
        gains = ["-" if g is None else f"{g['K'] / g['p']:.2f}" for g in pair]
        rows.append([fact["axis"], *texts, *gains])
    return rows
