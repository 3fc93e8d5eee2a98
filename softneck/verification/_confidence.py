"""What the data's confidence intervals mean for the margins: first-order spread, the numbers taken as independent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Vector

from ._linear import LinearLaw, margins
from ._plants import QUANTITIES, Plants, UncertainNeck, make_plants

# Two-sided 95 %.
_REACH = 1.96
_METRICS = ("disk_margin", "sensitivity", "gain_margin", "phase_margin_deg", "delay_margin_ms")


@dataclass(frozen=True, slots=True)
class MarginInterval:
    """A margin with what the data leave open about it.

    Attributes:
        plant: which one.
        metric: such as `pitch.disk_margin`.
        value: at the identified numbers.
        half_width: of its 95 % interval.
        most: the number whose uncertainty counts most: static gain, pole or dead time.
    """

    plant: str
    metric: str
    value: float
    half_width: float
    most: str


def intervals(neck: UncertainNeck, law: LinearLaw, w: Vector, *, extra: int) -> list[MarginInterval]:
    """Return intervals at the nominal plant (at the samples' median uncertainty) and at the worst sample of each axis.

    Empty where nobody knows the uncertainty of the samples.
    """
    if any(box.std is None or not np.isfinite(box.std).any() for box in neck.axes):
        return []
    found = _around(neck, law, w, extra, np.stack([box.nominal for box in neck.axes]), _median(neck), "nominal")
    for i, axis in enumerate(neck.names):
        box = neck.axes[i]
        numbers = np.tile(np.stack([other.nominal for other in neck.axes]), (box.samples.shape[0], 1, 1))
        numbers[:, i] = box.samples
        values = margins(_plants(neck, numbers, extra), law, w)[f"{axis}.disk_margin"]
        worst = int(np.argmin(values))
        std = np.zeros((len(neck.axes), 3))
        std[i] = np.nan_to_num(box.std[worst])  # pyright: ignore[reportOptionalSubscript]
        rows = _around(neck, law, w, extra, numbers[worst], std, f"worst sample of {axis} ({worst})")
        found += [row for row in rows if row.metric.startswith(f"{axis}.")]
    return found


def _median(neck: UncertainNeck) -> np.ndarray:
    return np.stack([np.nan_to_num(np.nanmedian(box.std, axis=0)) for box in neck.axes])  # pyright: ignore


def _around(
    neck: UncertainNeck, law: LinearLaw, w: Vector, extra: int, numbers: np.ndarray, std: np.ndarray, name: str
) -> list[MarginInterval]:
    tried = [numbers]
    for i in range(len(neck.axes)):
        for k in range(3):
            for sign in (-1.0, 1.0):
                moved = numbers.copy()
                # Gains and poles keep their sign, dead times stay above zero.
                least = 0.0 if k == 2 else 0.1 * abs(numbers[i, k])
                moved[i, k] = max(abs(numbers[i, k]) + sign * std[i, k], least) * (np.sign(numbers[i, k]) or 1.0)
                tried.append(moved)
    table = margins(_plants(neck, np.array(tried), extra), law, w)
    rows = []
    for i, axis in enumerate(neck.names):
        for metric in _METRICS:
            values = table[f"{axis}.{metric}"]
            pairs = values[1 + 6 * i : 7 + 6 * i].reshape(3, 2)
            parts = 0.5 * np.abs(pairs[:, 1] - pairs[:, 0])
            if np.isfinite(parts).all() and np.isfinite(values[0]):
                rows.append(
                    MarginInterval(
                        f"{neck.name}: {name}", f"{axis}.{metric}", float(values[0]),
                        _REACH * float(np.sqrt((parts**2).sum())), QUANTITIES[int(np.argmax(parts))],
                    )
                )  # fmt: skip
    return rows


def _plants(neck: UncertainNeck, numbers: np.ndarray, extra: int) -> Plants:
    return make_plants(neck, numbers, [""] * len(numbers)).later(extra)
