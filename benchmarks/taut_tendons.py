"""What taut tendons are worth: 15 deg steps of the virtual neck with 0, 0.5 and 1 kg, three kinds of controller.

Run with `python benchmarks/taut_tendons.py`.
"""

from __future__ import annotations

import math
from typing import Any

from softneck.design import AdaptiveSettings, PiSettings
from softneck.estimation import KalmanSettings
from softneck.identification import FamilySettings
from softneck.plant import VirtualNeck, record
from softneck.signals import signal
from tests.oracles.neck_table import NECK_HEAD, NeckSteps, neck_table, table_cells


def main() -> None:
    """Identify a family over the payloads, design on it, and print the table without and with the rule."""
    steps = NeckSteps(payloads=(0.0, 0.5, 1.0), orientations=(0.0, math.radians(45.0)))
    neck = VirtualNeck(steps.parameters())
    recordings = [
        record(signal("eq22"), neck, seed=i, payload=kg).rows(0, 4000) for i, kg in enumerate((0.0, 0.5, 1.0))
    ]
    family = FamilySettings().fit(recordings)
    observer = KalmanSettings(sensor="3dm-gx5-10").design(family)
    kinds: dict[str, Any] = {
        "pi": PiSettings(lead_limit=0.8, reference_time=0.12),
        "adaptive": AdaptiveSettings(lead_limit=1.0),
    }  # fmt: skip
    controllers = {name: settings.design(family) for name, settings in kinds.items()}
    for title, least in (("tendons as they are", -6.0), ("co-contraction at least 0.6 rad", 0.6)):
        print(title)
        rows = neck_table(controllers, observer, steps, parameters={"least_cocontraction": least})
        for cells in (NECK_HEAD, *table_cells(rows)):
            print("  " + " | ".join(f"{cell:16}" for cell in cells))


if __name__ == "__main__":
    main()
