"""The worst plant is the one that is judged: of every metric, in every list, and with the width the data leave open."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from softneck.core import Vector
from softneck.cosim import load_loop
from softneck.design import LinearController
from softneck.verification import make_requirements, verify
from softneck.verification._confidence import intervals
from softneck.verification._evidence import Values, worst_row
from softneck.verification._linear import LinearLaw, judged, margins
from softneck.verification._plants import all_plants, make_plants, neck_of_family, neck_of_model
from softneck.verification._worst import write_neck

from .necks import QUICK, TS, family, linear_neck, pi

W = judged(TS)


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
    found = verify(pi(), family(spread=0.3), make_requirements({**QUICK, "neck": {"necks": 0}}))
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
    table = margins(plants, law, W)
    for verdict in computed:
        axis, _, name = verdict.requirement.metric.partition(".")
        if axis == "axes" and f"pitch.{name}" in table:
            row = plants.names.index(verdict.worst["name"])
            own = table[f"{verdict.worst['axis']}.{name}"][row]
            assert own == pytest.approx(verdict.value, rel=1e-9)  # rounding of sums over other batches
    # A worse plant makes the value worse, never better: all margins shrink as the box grows.
    narrow = verify(pi(), family(spread=0.05), make_requirements({**QUICK, "neck": {"necks": 0}}))
    for wide, tight in zip(found.verdicts, narrow.verdicts, strict=True):
        if wide.value is None or not wide.requirement.metric.startswith(("axes.", "stability.", "robust.mu")):
            continue
        sign = 1.0 if wide.requirement.bound == "min" else -1.0
        assert tight.value is not None
        assert sign * wide.value < sign * tight.value, wide.requirement.metric


def _spread(half: float, values: Vector) -> float:
    """Return 95 % of a normal distribution whose standard deviation is `half` of the difference between two values."""
    return float(norm.ppf(0.975) * abs(values[1] - values[0]) * half)


@pytest.mark.parametrize("quantity", [0, 1, 2])
def test_the_interval_of_one_uncertain_number_is_95_percent_of_a_normal_distribution(quantity: int) -> None:
    """Only one number of pitch is uncertain: the interval is 1.96 times the margin's change over one deviation."""
    found, controller = family(std=0.02), pi()
    for item in found.axes.values():
        deviation = item.std[:, quantity].copy()
        item.std[:] = 0.0
        item.std[:, quantity] = deviation
    neck = neck_of_family(found, "f")
    law = LinearLaw.of(controller.ss())
    rows = {(row.plant, row.metric): row for row in intervals(neck, law, W, extra=0)}
    box = neck.axes[0]
    assert box.std is not None
    moved = np.tile(np.stack([other.nominal for other in neck.axes]), (2, 1, 1))
    moved[:, 0, quantity] += np.array([-1.0, 1.0]) * np.median(box.std[:, quantity])
    table = margins(make_plants(neck, moved, ["", ""]), law, W)
    for metric in ("disk_margin", "sensitivity", "gain_margin"):
        row = rows["f: nominal", f"pitch.{metric}"]
        assert row.half_width == pytest.approx(_spread(0.5, table[f"pitch.{metric}"]), rel=1e-4)  # digits of 1.96
        assert row.half_width > 0.0
        assert row.most == ("static gain", "pole", "dead time")[quantity]


def _law_of(controller: LinearController) -> LinearLaw:
    return LinearLaw.of(controller.ss())


def test_intervals_at_the_worst_sample_are_those_of_the_sample_with_the_least_margin() -> None:
    neck, law = neck_of_family(family(spread=0.3), "f"), _law_of(pi())
    rows = intervals(neck, law, W, extra=1)
    for i, axis in enumerate(("pitch", "roll")):
        numbers = np.tile(np.stack([box.nominal for box in neck.axes]), (neck.axes[i].samples.shape[0], 1, 1))
        numbers[:, i] = neck.axes[i].samples
        alone = margins(make_plants(neck, numbers, [""] * len(numbers)).later(1), law, W)[f"{axis}.disk_margin"]
        found = [row for row in rows if "worst" in row.plant and row.metric == f"{axis}.disk_margin"]
        assert [row.value for row in found] == pytest.approx([alone.min()], rel=1e-9)  # rounding


@pytest.mark.slow
def test_delays_are_listed_with_the_worst_of_the_plants_that_were_tried() -> None:
    found = verify(pi(), linear_neck(), make_requirements({**QUICK, "neck": {"necks": 0}}))
    rows, law = found.evidence.linear[0].delays, _law_of(pi())
    neck = neck_of_model(linear_neck(), "plant", {"gain": 0.0, "pole": 0.0, "delay": 0.0})
    first = all_plants([neck], 1, 0)
    # Each line is worse than the nominal plant with that delay, and than the line before.
    for k, (samples, radius, disk, peak) in enumerate(rows):
        assert samples == k
        alone = margins(first.take(0).later(k), law, W)
        assert disk <= min(alone["pitch.disk_margin"][0], alone["roll.disk_margin"][0])
        assert peak >= max(alone["pitch.sensitivity"][0], alone["roll.sensitivity"][0])
        assert radius >= alone["stability.radius"][0]
    assert np.all(np.diff(rows[:3, 2]) < 0.0)


def test_the_loop_of_a_worst_neck_runs_at_a_sample_time_estimated_from_a_log(tmp_path: Path) -> None:
    sample_time = 0.020895371  # a file that rounds it to six digits names another one
    replace(pi(), sample_time=sample_time).save(tmp_path / "pi.npz")
    worst = {
        "name": "paper, 1 kg", "parameters": {}, "payload_kg": 1.0, "seed": 7, "pitch_deg": 15.0, "roll_deg": 0.0,
        "at_s": 0.5, "duration_s": 2.5, "sample_time_s": sample_time, "order": "sequential",
    }  # fmt: skip
    file = write_neck(tmp_path, "neck", worst, controller=tmp_path / "pi.npz", observer=None, force=False)
    parts = load_loop(file).loop.parts
    assert {name: part.sample_time for name, part in parts.items()} == {
        "plant": sample_time, "controller": sample_time
    }  # fmt: skip
