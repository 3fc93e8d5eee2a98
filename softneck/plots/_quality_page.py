"""The quality report as one self-contained page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Vector, to_si
from softneck.signals import SET_POINTS, Quality, Recording, redefine
from softneck.signals.quality._excitation import BANDWIDTH
from softneck.signals.quality._region import reachable_hexagon
from softneck.signals.recording._channels import MOTOR_POSITIONS, OUTPUTS, file_unit

from ._page import Section, Table, page
from ._style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, label, new_figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INPUT_COLOURS = (BLUE, ORANGE, GREEN)
_INPUT_NAMES = (r"$\theta_i$", r"$\phi_i$", r"$\delta_i$")
# More points than this hide each other.
_POINTS = 20_000
_FAULTS = (("missed", RED), ("frozen", PURPLE), ("clipped", ORANGE), ("outliers", GREEN))
_SHOWN = {"outliers": "spikes"}


def spectrum_figure(quality: Quality, title: str) -> Figure:
    """Draw the spectral density of theta_i, phi_i and delta_i against the neck's bandwidth of 4 rad/s."""
    figure, (ax,) = new_figure(1, row_height=3.6)
    omega, density = quality.spectrum.omega[1:], quality.spectrum.density[1:]
    top = density.max(initial=1e-12)
    for i in range(3):
        if density[:, i].max() > 1e-15:
            share = 100 * quality.spectrum.below_bandwidth[i]
            name = f"{_INPUT_NAMES[i]} ({share:.0f} % below {BANDWIDTH:g} rad/s)"
            ax.loglog(omega, np.maximum(density[:, i], 1e-12 * top), color=_INPUT_COLOURS[i], lw=1.2, label=name)
    ax.axvline(BANDWIDTH, color="black", ls="--", lw=1.0)
    ax.annotate("bandwidth of the neck", (BANDWIDTH, 0.93), xycoords=("data", "axes fraction"), xytext=(5, 0),
                textcoords="offset points", fontsize="small")  # fmt: skip
    ax.set_ylim(1e-7 * top, 3.0 * top)
    ax.set_xlabel("frequency [rad/s]")
    label(ax, "density [rad$^2$ s/rad]", legend=len(ax.lines) > 1)
    figure.suptitle(title)
    return figure


def region_figure(recording: Recording, quality: Quality, title: str) -> Figure:
    """Draw the (theta_i, phi_i) visited, coloured by delta_i, in the hexagon that the motors reach."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    P = recording.motor_positions
    P = P[np.isfinite(P).all(axis=1)]
    theta, phi, delta = redefine(P[:: max(1, len(P) // _POINTS)]).T
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    limit = quality.region.limit
    left.plot(*reachable_hexagon(limit).T, color=GREY, lw=1.0)
    span = max(float(np.abs(delta).max(initial=0.0)), 1e-3)
    points = left.scatter(theta, phi, c=delta, s=3, cmap="coolwarm", vmin=-span, vmax=span, rasterized=True)
    figure.colorbar(points, ax=left, label=r"$\delta_i$ [rad]")
    left.set_aspect("equal")
    left.set_xlabel(r"$\theta_i$ [rad]")
    left.set_ylabel(r"$\phi_i$ [rad]")
    covered = 100 * quality.region.tilt_coverage
    left.set_title(f"{covered:.0f} % of what motors of $\\pm${limit:g} rad reach", fontsize="medium")
    _behaviours(right, quality)
    figure.suptitle(title)
    return figure


def _behaviours(ax: Axes, quality: Quality) -> None:
    """Draw for how long each behaviour took place; one that never did is marked."""
    names = list(quality.region.behaviours)
    seconds = np.array([quality.region.behaviours[name] for name in names])
    never = np.array([name in quality.region.never for name in names])
    rows = np.arange(len(names))
    ax.barh(rows, seconds, color=np.where(never, RED, BLUE))
    for row in rows:
        text = " never" if seconds[row] == 0.0 else f" {seconds[row]:.1f} s" + (": too little" if never[row] else "")
        ax.annotate(text, (seconds[row], row), va="center", fontsize="small", color=RED if never[row] else "black")
    ax.set_yticks(rows, names)
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.25 * max(1.0, float(seconds.max())))
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel("time spent [s]")
    ax.set_title("behaviours that the paper names", fontsize="medium")


def channels_figure(recording: Recording, quality: Quality, title: str) -> Figure:
    """Draw how often each value occurs: a clipped channel piles up at its edge, a quantised one shows its levels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    names = _shown(recording)
    columns = 3
    figure = Figure(figsize=(10.0, 2.2 * -(-len(names) // columns) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(-(-len(names) // columns), columns, squeeze=False).ravel()
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    for ax, name in zip(axes, names, strict=False):
        channel = quality.channels[name]
        y = _values(recording, name)
        y = y[np.isfinite(y)]
        if y.size:
            ax.hist(y, bins=_bins(channel.levels), color=BLUE)
        if channel.clipped:
            for stretch in channel.clipped[:50]:
                ax.axvline(_values(recording, name)[stretch.start], color=ORANGE, lw=1.0)
        step = "no steps" if channel.quantum is None else f"steps of {channel.shown(channel.quantum):.2g}"
        ax.set_title(name if channel.command else f"{name}: {step}", fontsize="small")
        ax.set_xlabel(f"[{file_unit(name)}]", fontsize="small")
        ax.set_yscale("log")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title)
    return figure


def _bins(levels: float | None) -> int:
    """Return one bin for each level of a coarse channel, 60 otherwise."""
    return 60 if levels is None or not 2 <= levels <= 120 else round(levels) + 1


def faults_figure(recording: Recording, quality: Quality, title: str) -> Figure:
    """Draw the measured channels over time, with the rows marked that are missed, frozen, clipped or spikes."""
    names = [name for name in _shown(recording) if name not in SET_POINTS]
    figure, axes = new_figure(len(names), row_height=1.6)
    # Times restart at each run; rows do not.
    t = np.arange(len(recording)) * recording.sample_time
    border = np.flatnonzero(np.diff(recording.run)) + 1
    seen: dict[str, Artist] = {}
    for ax, name in zip(axes, names, strict=True):
        y = _values(recording, name)
        y[border] = np.nan
        ax.plot(t, y, color=GREY, lw=0.7)
        for sort, colour in _FAULTS:
            for stretch in getattr(quality.channels[name], sort)[:200]:
                rows = slice(stretch.start, stretch.stop)
                if sort == "outliers":
                    (mark,) = ax.plot(t[rows], _values(recording, name)[rows], "o", color=colour, ms=4)
                else:
                    mark = ax.axvspan(t[rows][0], t[rows][-1] + recording.sample_time, color=colour, alpha=0.5, lw=1.0)
                seen.setdefault(sort, mark)
        label(ax, f"{name.replace('_', ' ')}\n[{file_unit(name)}]", legend=False)
    if seen:
        figure.legend(
            list(seen.values()),
            [_SHOWN.get(sort, sort) for sort in seen],
            loc="outside lower center",
            ncols=4,
            frameon=False,
        )
    axes[-1].set_xlabel("time from the first row [s]")
    figure.suptitle(title)
    return figure


def correlation_figure(quality: Quality, title: str) -> Figure:
    """Draw the correlation between the motors' set-points; grey where a motor never moves."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    ax.set_facecolor("#dddddd")
    image = ax.imshow(quality.correlation, cmap="coolwarm", vmin=-1.0, vmax=1.0)
    figure.colorbar(image, ax=ax, label="correlation")
    for i in range(3):
        for j in range(3):
            r = quality.correlation[i, j]
            text = "never\nmoves" if np.isnan(r) else f"{r:.2f}"
            ax.text(j, i, text, ha="center", va="center", color="white" if abs(r) > 0.7 else "black")
    ticks = [f"motor {j}" for j in (1, 2, 3)]
    ax.set_xticks(range(3), ticks)
    ax.set_yticks(range(3), ticks)
    figure.suptitle(title)
    return figure


def _shown(recording: Recording) -> list[str]:
    return [name for name in (*SET_POINTS, *MOTOR_POSITIONS, *OUTPUTS) if name in recording.channels]


def _values(recording: Recording, name: str) -> Vector:
    """Return a channel in the unit of files; a copy."""
    return recording.channels[name] / to_si(file_unit(name))[0]


_INPUTS = ("theta_i", "phi_i", "delta_i")


def quality_page(recording: Recording, quality: Quality, title: str) -> str:
    """Return the HTML text of a recording's quality: findings, tables and figures."""
    runs = len(recording.runs())
    summary = (
        f"{quality.rows} rows in {runs} run{'s' if runs > 1 else ''} at {1e3 * quality.sample_time:g} ms, "
        f"{quality.rows * quality.sample_time:.1f} s. The worst finding is: {quality.severity}."
    )
    spectrum = [
        "Power spectral density of the redefined inputs (Welch, never across runs). What has no power up to the "
        f"bandwidth of {BANDWIDTH:g} rad/s cannot be identified."
    ]
    region = [
        "Each point is a row; the hexagon is what the motors reach. A model knows nothing outside the points, and "
        "the paper's models failed at the behaviours beside it (section 7.4.2)."
    ]
    sections = [
        Section("Findings", [summary, *(str(finding) for finding in quality.findings)]),
        Section("Channels", [], [_channels(quality)], [
            ("Measured channels; faults are marked.", faults_figure(recording, quality, "Faults")),
            ("How often each value occurs, with faults at the edges.", channels_figure(recording, quality, "Values")),
        ]),
        Section("Excitation", spectrum, [_inputs(quality)], [
            ("Spectrum of the inputs.", spectrum_figure(quality, "Excitation")),
        ]),
        Section("Region", region, [], [("Visited region.", region_figure(recording, quality, "Visited region"))]),
        Section("Independence", ["Correlation between the motors' set-points."], [_conditions(quality)], [
            ("Correlation of the motors.", correlation_figure(quality, "Motors")),
        ]),
    ]  # fmt: skip
    return page(title, sections, footer=f"softneck info: {quality.rows} rows checked.")


def _channels(quality: Quality) -> Table:
    head = ["channel", "lowest", "highest", "unit", "step", "noise", "missed", "frozen", "clipped", "spikes"]
    rows = []
    for name, channel in quality.channels.items():
        shown = channel.as_dict()
        counts = [str(shown[f"{sort}_rows"]) for sort in ("missed", "frozen", "clipped", "outliers")]
        numbers = [_number(shown[key]) for key in ("lowest", "highest")]
        tail = [_number(shown["quantum"]), "-" if channel.command else _number(shown["noise_std"])]
        rows.append([name, *numbers, file_unit(name), *tail, *counts])
    return Table("Channels: steps and noise in the channel's unit, faults in rows", head, rows)


def _inputs(quality: Quality) -> Table:
    spectrum = quality.spectrum
    rows = [
        [
            name,
            *(f"{value:+.2f}" for value in quality.region.ranges[i]),
            _number(100 * spectrum.below_bandwidth[i]),
            f"{spectrum.highest[i]:.1f}",
            _number(spectrum.crest[i]),
        ]
        for i, name in enumerate(_INPUTS)
    ]
    head = ["input", "lowest [rad]", "highest [rad]", "power below 4 rad/s [%]", "real power up to [rad/s]", "crest"]
    return Table("Inputs", head, rows)


def _conditions(quality: Quality) -> Table:
    rows = [
        [axis, str(c.rows), "infinite" if np.isinf(c.number) else f"{c.number:.3g}", ", ".join(c.weakest)]
        for axis, c in quality.conditioning.items()
    ]
    head = ["axis", "rows", "condition", "least told apart"]
    return Table("Regressor of Eq. 21, every column at mean 0 and standard deviation 1", head, rows)


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"
