"""What a recording of any robot holds, as one self-contained page; that of a neck is judged too (`_quality_page`)."""

from __future__ import annotations

import numpy as np

from softneck.core import to_si
from softneck.signals import Recording
from softneck.signals.recording._channels import file_unit

from ._charts import recording_chart
from ._page import Section, Table, page


def recording_page(recording: Recording, title: str) -> str:
    """Return a page with the set-points and outputs over time, and the range and gaps of each channel."""
    r = recording
    chart = recording_chart(r.time, r.set_points, r.outputs, "Set-points and outputs", run=r.run, robot=r.robot)
    head = ["channel", "unit", "least", "largest", "missing [%]"]
    rows = [_row(r, name) for name in r.channels]
    what = (
        f"Robot {r.robot.label()}: {len(r)} rows in {len(r.runs())} run(s) at {1e3 * r.sample_time:g} ms. Excitation "
        "and faults are judged of necks only so far."
    )
    return page(title, [Section("Recording", text=[what], tables=[Table("Channels", head, rows)], charts=[chart])])


def _row(recording: Recording, name: str) -> list[str]:
    unit = file_unit(name, recording.robot)
    values = recording.channels[name] / to_si(unit)[0]
    known = values[np.isfinite(values)]
    ends = (f"{known.min():.4g}", f"{known.max():.4g}") if known.size else ("-", "-")
    return [name, unit, *ends, f"{100 * (1 - known.size / values.size):.1f}"]
