"""The worst plant is the one that is judged: of every metric, in every list, and with the width the data leave open."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.cosim import load_loop
from softneck.robot import Robot
from softneck.verification import make_requirements, verify
from softneck.verification._evidence import Values, worst_row
from softneck.verification._linear import LinearLaw, margins
from softneck.verification._worst import write_neck

from .necks import QUICK, family, pi


def _values(*numbers: float) -> dict[str, Values]:
    return {"m": Values(np.array(numbers), lambda row: {"row": row})}


@pytest.mark.parametrize(
    ("numbers", "least", "largest"),
    [
        ((3.0, 1.0, 2.0), 1, 0),
        ((-1.0, 5.0, -2.0), 2, 1),
        ((1.0, math.inf, 0.5), 2, 1),
        # A number that could not be computed is worse than any other, whatever is asked of it.
        ((3.0, math.nan, 1.0, math.nan, 9.0), 1, 1),
    ],
)
def test_the_worst_row_is_the_one_that_is_farthest_from_holding(
    numbers: tuple[float, ...], least: int, largest: int
) -> None:
    assert worst_row(_values(*numbers), "m", "min") == least
    assert worst_row(_values(*numbers), "m", "max") == largest


@pytest.mark.slow
def test_no_plant_of_a_verification_is_worse_than_the_one_that_it_names() -> None:
    found = verify(pi(), family(spread=0.3), make_requirements({**QUICK, "sim": {"necks": 0}}))
    computed = [verdict for verdict in found.verdicts if verdict.value is not None]
    assert len(computed) > 8
    for verdict in computed:
        asked, values = verdict.requirement, found.evidence.metrics[verdict.requirement.metric].values
        assert verdict.value == (values.min() if asked.bound == "min" else values.max())
        # What holds for the worst holds for all.
        assert verdict.holds == all(asked.holds(float(value)) for value in values)
    # The named plant is the one of that value: its own margins, computed alone.
    plants = found.evidence.linear[0].plants
    law = LinearLaw.of(pi().ss())
    table = margins(plants, law)
    for verdict in computed:
        axis, _, name = verdict.requirement.metric.partition(".")
        if axis == "axes" and f"pitch.{name}" in table:
            row = plants.names.index(verdict.worst["name"])
            own = table[f"{verdict.worst['axis']}.{name}"][row]
            assert own == pytest.approx(verdict.value, rel=1e-9)  # rounding of sums over other batches
    # A worse plant makes the value worse, never better: all margins shrink as the box grows.
    narrow = verify(pi(), family(spread=0.05), make_requirements({**QUICK, "sim": {"necks": 0}}))
    for wide, tight in zip(found.verdicts, narrow.verdicts, strict=True):
        if wide.value is None or not wide.requirement.metric.startswith(("axes.", "stability.", "robust.mu")):
            continue
        sign = 1.0 if wide.requirement.bound == "min" else -1.0
        assert tight.value is not None
        assert sign * wide.value < sign * tight.value, wide.requirement.metric


def test_the_loop_of_a_worst_neck_runs_at_a_sample_time_estimated_from_a_log(tmp_path: Path) -> None:
    sample_time = 0.020895371  # a file that rounds it to six digits names another one
    replace(pi(), sample_time=sample_time).save(tmp_path / "pi.npz")
    worst = {
        "name": "paper, 1 kg", "parameters": {}, "payload_kg": 1.0, "seed": 7, "pitch_deg": 15.0, "roll_deg": 0.0,
        "at_s": 0.5, "duration_s": 2.5, "sample_time_s": sample_time, "order": "sequential",
    }  # fmt: skip
    file = write_neck(
        tmp_path, "neck", worst, controller=tmp_path / "pi.npz", observer=None, force=False, robot=Robot.preset()
    )
    parts = load_loop(file).loop.parts
    assert {name: part.sample_time for name, part in parts.items()} == {
        "plant": sample_time, "controller": sample_time
    }  # fmt: skip
