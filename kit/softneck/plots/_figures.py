"""The figures of recordings, validations and loops; every one is a function that returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from softneck.core import Matrix, Vector

from ._style import BLUE, GREEN, GREY, MOTOR_COLOURS, ORANGE, RED, label, new_figure

_AXES = ("pitch", "roll")


def recording_figure(time: Vector, set_points: Matrix, outputs: Matrix, title: str) -> Figure:
    """Draw an experiment: motor set-points (time, 3) [rad], pitch and roll (time, 2) [rad] in degrees."""
    figure, (top, bottom) = new_figure(2)
    for j in range(3):
        top.plot(time, set_points[:, j], color=MOTOR_COLOURS[j], lw=0.9, label=f"motor {j + 1}")
    label(top, "set-point [rad]")
    for axis, colour in enumerate((BLUE, ORANGE)):
        bottom.plot(time, np.degrees(outputs[:, axis]), color=colour, lw=0.9, label=_AXES[axis])
    label(bottom, "angle [deg]")
    bottom.set_xlabel("time [s]")
    figure.suptitle(title)
    return figure


def validation_figure(
    time: Vector, measured: Matrix, predictions: Mapping[str, Matrix], title: str, *, joined: bool = False
) -> Figure:
    """Draw measured and predicted pitch and roll, each with its error below.

    Args:
        time: (time,) [s].
        measured: (time, 2) [rad], NaN where a row is not scored.
        predictions: name -> (time, 2) [rad].
        title: of the figure.
        joined: whether a stretch of time may be missing between rows (draws no line across it).
    """
    t = np.where(np.diff(time, prepend=time[0]) > 1.0, np.nan, time) if joined else time
    figure, axes = new_figure(4, row_height=1.9)
    colours = (BLUE, ORANGE, GREEN, RED)
    for axis in range(2):
        curve, error = axes[2 * axis], axes[2 * axis + 1]
        curve.plot(t, np.degrees(measured[:, axis]), color="black", lw=1.2, label="measured")
        for (name, values), colour in zip(predictions.items(), colours, strict=False):
            curve.plot(t, np.degrees(values[:, axis]), color=colour, lw=0.9, label=name)
            error.plot(t, np.degrees(values[:, axis] - measured[:, axis]), color=colour, lw=0.8, label=name)
        error.axhline(0.0, color=GREY, lw=0.6)
        label(curve, f"{_AXES[axis]} [deg]")
        label(error, "error [deg]", legend=False)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title)
    return figure


def loop_figure(time: Vector, signals: Mapping[str, Vector], title: str) -> Figure:
    """Draw a closed loop: reference, true, measured and estimated angles, motors, and tensions where there are any."""
    tension = "tension_1" in signals
    figure, axes = new_figure(4 if tension else 3)
    for axis, ax in zip(_AXES, axes[:2], strict=True):
        styles = (("_measured", GREEN, 0.6), ("", BLUE, 1.4), ("_estimate", ORANGE, 0.9), ("_reference", "black", 1.0))
        for suffix, colour, width in styles:
            if f"{axis}{suffix}" in signals:
                name = suffix.strip("_") or "true"
                ax.plot(time, np.degrees(signals[f"{axis}{suffix}"]), color=colour, lw=width, label=name)
        label(ax, f"{axis} [deg]")
    for j in (1, 2, 3):
        colour = MOTOR_COLOURS[j - 1]
        axes[2].step(time, signals[f"motor_setpoint_{j}"], where="post", color=colour, lw=1.0, label=f"set-point {j}")
        if f"motor_position_{j}" in signals:
            axes[2].plot(time, signals[f"motor_position_{j}"], color=colour, lw=0.8, ls="--")
        if tension:
            axes[3].plot(time, signals[f"tension_{j}"], color=colour, lw=1.0, label=f"tendon {j}")
    label(axes[2], "motor [rad]\n(dashed: position)")
    if tension:
        label(axes[3], "tension [N]")
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title)
    return figure


def delay_figure(curves: Mapping[str, list[list[float]]], title: str) -> Figure:
    """Draw the cost curve of the dead time: rows of (delay [s], free-run fit [%], one-step rms [rad])."""
    figure, (fit, rms) = new_figure(2, row_height=1.9)
    for (name, rows), colour in zip(curves.items(), (BLUE, ORANGE), strict=False):
        table = np.array(rows)
        fit.plot(1e3 * table[:, 0], table[:, 1], "o-", ms=3, color=colour, label=name)
        rms.plot(1e3 * table[:, 0], np.degrees(table[:, 2]), "o-", ms=3, color=colour, label=name)
    best = max(row[1] for rows in curves.values() for row in rows)
    fit.set_ylim(best - 12.0, best + 1.0)  # what lies below is no candidate
    label(fit, "free-run fit [%]")
    label(rms, "one-step rms [deg]")
    rms.set_xlabel("dead time [ms]")
    figure.suptitle(title)
    return figure
