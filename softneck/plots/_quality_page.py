"""The quality report as one self-contained page."""

from __future__ import annotations

import numpy as np

from softneck.signals import Quality, Recording
from softneck.signals.quality._excitation import BANDWIDTH
from softneck.signals.recording._channels import file_unit

from ._page import Section, Table, page
from ._quality_figures import channels_figure, correlation_figure, faults_figure, region_figure, spectrum_figure

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
