"""The quality report as one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import SettingsError, Vector, to_si
from softneck.signals import Quality, Recording, redefine
from softneck.signals.quality._region import Region, reachable_hexagon
from softneck.signals.recording._channels import file_unit, si_unit

from ._chart import Chart, Curve, Panel
from ._figures import chart_figure
from ._page import Section, Table, page
from ._style import ALL_MOTOR_COLOURS, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, label, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INPUT_NAMES = {"theta_i": r"$\theta_i$", "phi_i": r"$\phi_i$", "delta_i": r"$\delta_i$"}
# More points than this hide each other.
_POINTS = 20_000
_FAULTS = (("missed", RED), ("frozen", PURPLE), ("clipped", ORANGE), ("outliers", GREEN))
_SHOWN = {"outliers": "spikes"}
# Of one sort in one channel.
_MOST_MARKED = 200


def spectrum_figure(quality: Quality, title: str) -> Figure:
    """Draw the spectral density of the inputs against the robot's bandwidth, of a neck 4 rad/s."""
    figure, (ax,) = new_figure(1, row_height=3.6)
    spectrum, whose = quality.spectrum, "neck" if quality.robot.is_neck else "robot"
    omega, density, bandwidth = spectrum.omega[1:], spectrum.density[1:], spectrum.bandwidth
    top = density.max(initial=1e-12)
    for i, name in enumerate(spectrum.inputs):
        if density[:, i].max(initial=0.0) > 1e-15:
            below = f" below {bandwidth:.3g} rad/s" if quality.robot.is_neck else ""  # no room for more than three
            share = "" if np.isnan(bandwidth) else f" ({100 * spectrum.below_bandwidth[i]:.0f} %{below})"
            said = _INPUT_NAMES.get(name, f"motor {i + 1}") + share
            ax.loglog(omega, np.maximum(density[:, i], 1e-12 * top), color=ALL_MOTOR_COLOURS[i], lw=1.2, label=said)
    if not np.isnan(bandwidth):
        ax.axvline(bandwidth, color="black", ls="--", lw=1.0)
        ax.annotate(f"bandwidth of the {whose}", (bandwidth, 0.93), xycoords=("data", "axes fraction"), xytext=(5, 0),
                    textcoords="offset points", fontsize="small")  # fmt: skip
    ax.set_ylim(1e-7 * top, 3.0 * top)
    ax.set_xlabel("frequency [rad/s]")
    unit = si_unit(quality.robot.set_points[0], quality.robot)
    label(ax, rf"density [{unit}$^2$ s/rad]", legend=len(ax.lines) > 1)
    figure.suptitle(title)
    return figure


def region_figure(recording: Recording, quality: Quality, title: str) -> Figure:
    """Draw the (theta_i, phi_i) that a neck visited, coloured by delta_i, in the hexagon that the motors reach."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    region = _neck_region(quality)
    P = recording.motor_positions
    P = P[np.isfinite(P).all(axis=1)]
    theta, phi, delta = redefine(P[:: max(1, len(P) // _POINTS)]).T
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    limit = region.limit
    left.plot(*reachable_hexagon(limit).T, color=GREY, lw=1.0)
    span = max(float(np.abs(delta).max(initial=0.0)), 1e-3)
    points = left.scatter(theta, phi, c=delta, s=3, cmap="coolwarm", vmin=-span, vmax=span, rasterized=True)
    figure.colorbar(points, ax=left, label=r"$\delta_i$ [rad]")
    left.set_aspect("equal")
    left.set_xlabel(r"$\theta_i$ [rad]")
    left.set_ylabel(r"$\phi_i$ [rad]")
    covered = 100 * region.tilt_coverage
    left.set_title(f"{covered:.0f} % of what motors of $\\pm${limit:g} rad reach", fontsize="medium")
    _behaviours(right, region)
    figure.suptitle(title)
    return figure


def _neck_region(quality: Quality) -> Region:
    if quality.region is None:
        raise SettingsError(f"the region of theta_i and phi_i is a neck's, not that of robot {quality.robot.label()}.")
    return quality.region


def _behaviours(ax: Axes, region: Region) -> None:
    """Draw for how long each behaviour took place; one that never did is marked."""
    names = list(region.behaviours)
    seconds = np.array([region.behaviours[name] for name in names])
    never = np.array([name in region.never for name in names])
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
        ax.set_xlabel(f"[{channel.unit}]", fontsize="small")
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
    return chart_figure(faults_chart(recording, quality, title))


def faults_chart(recording: Recording, quality: Quality, title: str) -> Chart:
    """Describe the same: a band over the rows of a fault, a point on a spike."""
    # Times restart at each run; rows do not.
    t = np.arange(len(recording)) * recording.sample_time
    border = np.flatnonzero(np.diff(recording.run)) + 1
    panels = []
    for name in [name for name in _shown(recording) if name not in recording.robot.set_points]:
        y = _values(recording, name)
        y[border] = np.nan
        curves = [Curve(t, y, colour=GREY, width=0.7)]
        for sort, colour in _FAULTS:
            if stretches := getattr(quality.channels[name], sort)[:_MOST_MARKED]:
                rows = [np.arange(one.start, one.stop) for one in stretches]
                curves.append(_marked(t, _values(recording, name), rows, sort, colour))
        panels.append(Panel(curves, f"{name.replace('_', ' ')} [{quality.channels[name].unit}]"))
    return Chart(title, panels, "time from the first row [s]", row_height=2.0)


def _marked(t: Vector, y: Vector, rows: Sequence[np.ndarray], sort: str, colour: str) -> Curve:
    """Return what marks rows of a fault: they are few, or hold no value that could be drawn otherwise."""
    if sort == "outliers":
        at = np.concatenate(rows)
        return Curve(t[at], y[at], _SHOWN[sort], colour, "points", 1.3)
    low, high = (float(np.nan_to_num(edge)) for edge in (np.nanmin(y, initial=0.0), np.nanmax(y, initial=0.0)))
    step = t[1] - t[0] if t.size > 1 else 1.0
    x = np.concatenate([[t[one[0]], t[one[-1]] + step, t[one[-1]] + step] for one in rows])
    gaps = np.tile([0.0, 0.0, np.nan], len(rows))
    return Curve(x, low + gaps, sort, colour, "band", upper=high + gaps)


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
    motors = range(len(quality.correlation))
    for i in motors:
        for j in motors:
            r = quality.correlation[i, j]
            text = "never\nmoves" if np.isnan(r) else f"{r:.2f}"
            ax.text(j, i, text, ha="center", va="center", color="white" if abs(r) > 0.7 else "black")
    ticks = [f"motor {j + 1}" for j in motors]
    # Names of more motors than three would run into each other.
    ax.set_xticks(motors, ticks if len(motors) <= 3 else [str(j + 1) for j in motors])
    ax.set_yticks(motors, ticks)
    figure.suptitle(title)
    return figure


def _shown(recording: Recording) -> list[str]:
    robot = recording.robot
    names = (*robot.set_points, *robot.motor_positions, *robot.outputs.names)
    return [name for name in names if name in recording.channels]


def _values(recording: Recording, name: str) -> Vector:
    """Return a channel in the unit of files; a copy."""
    return recording.channels[name] / to_si(file_unit(name, recording.robot))[0]


def quality_page(recording: Recording, quality: Quality, title: str) -> str:
    """Return the HTML text of a recording's quality: findings, tables and figures."""
    neck, bandwidth = quality.robot.is_neck, quality.spectrum.bandwidth
    spectrum = [
        f"Power spectral density of the {'redefined inputs' if neck else 'set-points'} (Welch, never across runs)."
    ]
    if not np.isnan(bandwidth):
        spectrum[0] += f" What has no power up to the bandwidth of {bandwidth:.3g} rad/s cannot be identified."
    faults = faults_chart(recording, quality, "What was measured, with the rows of each fault marked")
    sections = [
        Section("Findings", charts=[faults], findings=_findings(quality)),
        Section("Channels", [], [_channels(quality)], [
            ("How often each value occurs, with faults at the edges.", channels_figure(recording, quality, "Values")),
        ]),
        Section("Excitation", spectrum, [_inputs(quality)], [
            ("Spectrum of the inputs.", spectrum_figure(quality, "Excitation")),
        ]),
        _region(recording, quality),
        Section("Independence", ["Correlation between the motors' set-points."], [_conditions(quality)], [
            ("Correlation of the motors.", correlation_figure(quality, "Motors")),
        ]),
    ]  # fmt: skip
    return page(
        title, sections, verdict=_verdict(recording, quality), holds=quality.severity != "warning",
        footer="Written by softneck info.",
    )  # fmt: skip


def _verdict(recording: Recording, quality: Quality) -> str:
    """Return in a sentence how good the recording is, and how long."""
    count = {severity: sum(one.severity == severity for one in quality.findings) for severity in ("warning", "note")}
    runs = len(recording.runs())
    words = {
        "warning": f"To be mended before a model is identified from it ({count['warning']} warnings below)",
        "note": f"Fit to identify a model, with {count['note']} thing(s) to know",
        "ok": "Fit to identify a model; nothing is wrong with it",
    }
    return (
        f"{words[quality.severity]}. It has {quality.rows} rows in {runs} run{'s' if runs > 1 else ''} at "
        f"{1e3 * quality.sample_time:g} ms, {quality.rows * quality.sample_time:.1f} s."
    )


def _findings(quality: Quality) -> list[tuple[str, str]]:
    """Return each finding with where it is first seen."""
    return [
        (
            one.severity,
            str(one).removeprefix(f"{one.severity}: ")
            + (f" First at {one.time:.2f} s of its run." if one.time is not None and "at " not in one.message else ""),
        )
        for one in quality.findings
    ]


def _region(recording: Recording, quality: Quality) -> Section:
    if not quality.robot.is_neck:
        text = (
            f"Robot {quality.robot.label()}: what its motors went through is in the tables. A map of tilt and the "
            "behaviours that the paper names (one tendon alone, co-contraction) are shown of three-tendon necks only."
        )
        return Section("Region", [text])
    text = (
        "Each point is a row; the hexagon is what the motors reach. A model knows nothing outside the points, and "
        "the paper's models failed at the behaviours beside it (section 7.4.2)."
    )
    return Section("Region", [text], [], [("Visited region.", region_figure(recording, quality, "Visited region"))])


def _channels(quality: Quality) -> Table:
    head = ["channel", "lowest", "highest", "unit", "step", "noise", "missed", "frozen", "clipped", "spikes"]
    rows = []
    for name, channel in quality.channels.items():
        shown = channel.as_dict()
        counts = [str(shown[f"{sort}_rows"]) for sort in ("missed", "frozen", "clipped", "outliers")]
        numbers = [_number(shown[key]) for key in ("lowest", "highest")]
        tail = [_number(shown["quantum"]), "-" if channel.command else _number(shown["noise_std"])]
        rows.append([name, *numbers, channel.unit, *tail, *counts])
    return Table("Channels: steps and noise in the channel's unit, faults in rows", head, rows)


def _inputs(quality: Quality) -> Table:
    spectrum = quality.spectrum
    rows = [
        [
            name,
            f"{low:+.3g}",
            f"{high:+.3g}",
            unit,
            _number(100 * spectrum.below_bandwidth[i]),
            _number(spectrum.highest[i]),
            _number(spectrum.crest[i]),
        ]
        for i, (name, (low, high, unit)) in enumerate(quality.inputs.items())
    ]
    below = f"power below {spectrum.bandwidth:.3g} rad/s [%]"
    head = ["input", "lowest", "highest", "unit", below, "real power up to [rad/s]", "crest"]
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
