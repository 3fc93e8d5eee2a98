"""Make pictures of the pages on recordings' quality and on the Kalman filter: `python docs/pictures.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plots import chart_figure
from softneck.plots._recording_pages import faults_chart
from softneck.signals import Excitation, Recording, SetPointLimits, assess_quality, prepare, signal

STATIC = Path(__file__).parent / "_static"


def main() -> None:
    """Write every picture."""
    neck = VirtualNeck(NeckParameters.preset("paper"))
    eq22 = record(signal("eq22"), neck, seed=1)
    bad = _faulty(eq22.rows(0, 3000))
    _save(chart_figure(faults_chart(bad, assess_quality(bad), "Eq. 22 with planted faults")), "quality_faults.png")
    _save(_limits_figure(), "excitation_limits.png")


def _faulty(recording: Recording) -> Recording:
    """Return the recording with a dropout, a flat top, a frozen stretch and a spike."""
    pitch, roll = (recording.channels[axis].copy() for axis in ("pitch", "roll"))
    pitch = np.minimum(pitch, np.radians(20.0))
    pitch[2000:2040] = np.nan
    roll[800:880] = roll[800]
    roll[2400] += np.radians(15.0)
    return recording.with_channels(pitch=pitch, roll=roll)


def _limits_figure() -> Figure:
    """Return Eq. 22 and `steps` before and after limits and ramps."""
    limits = SetPointLimits(position=3.5, speed=5.0, slack=1.5)
    pairs: list[tuple[Excitation, Excitation]] = []
    for name in ("eq22", "steps"):
        before = signal(name, duration=12.0)
        pairs.append((before, prepare(before, limits, ramp_s=2.0)[0]))
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, (before, after) in zip(figure.subplots(1, 2), pairs, strict=True):
        ax.plot(before.time, before.set_points[:, 0], color="#E69F00", lw=1.0, label="as defined")
        ax.plot(after.time, after.set_points[:, 0], color="#0072B2", lw=1.4, label="prepared")
        for bound in (limits.position, limits.lowest, 0.0):
            ax.axhline(bound, color="#666666", ls=":", lw=0.8)
        ax.set_title(f"{before.name}, motor 1")
        ax.set_xlabel("time [s]")
        ax.spines[["top", "right"]].set_visible(False)
        ax.legend(fontsize="small", frameon=False)
    figure.axes[0].set_ylabel("set-point [rad]")
    return figure


def _save(figure: Figure, name: str) -> None:
    # No date and no version inside, so that the same numbers give the same file.
    figure.savefig(STATIC / name, dpi=75, metadata={"Software": None})


if __name__ == "__main__":
    main()
