"""Margins of a tested family: of every response within the weight that its recordings support, in their band.

At each frequency the loop is any point of a disk, `L = L0 (1 + W D)`, `|D| <= 1`; margins are those of the worst point,
in closed form. Above the band nothing is known: a gain that moves the crossover of the worst loop there is not
certified, and a loop that crosses there has no margin that the data support. Where the user states how the plant falls
above, its size is known there and its phase is not: a loop that may reach 1 there has no margin either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Vector
from softneck.identification import AxisMeasured, response_of

from ._linear import LinearLaw

_POINTS, _ABOVE = 2000, 400
# What is certified on the data; the others of an axis are of the box and its samples alone.
TESTED = ("sensitivity", "complementary", "disk_margin", "gain_margin", "phase_margin_deg", "delay_margin_ms")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TestedAxis:
    """What the data support about one axis of one family.

    Attributes:
        source: name of the family.
        axis: of the controller's channels.
        band: [rad/s].
        crossover: the highest at which the loop of some response crosses 1 [rad/s]; inf where it is above the band.
        margins: name -> value; empty where the crossover is above the band.
        mu: the largest `|W T|`; below 1 all responses within the weight are stable.
        at: name -> frequency at which that is found [rad/s].
        unheard: recordings of the family that move the axis and show no response of it.
    """

    source: str
    axis: str
    band: tuple[float, float]
    crossover: float
    margins: Mapping[str, float]
    mu: float
    at: Mapping[str, float]
    unheard: tuple[str, ...] = ()

    def why(self) -> str:
        """Return why nothing is certified, with what to do; "" where something is."""
        if self.unheard:
            return (
                f"not supported by the data: {self.unheard[0]} moves {self.axis} and shows no response of it, so "
                f"{self.source} knows nothing of what it holds (slack tendons, friction?); record that where it "
                "answers, or leave it out of the family"
            )
        if math.isfinite(self.crossover):
            return ""
        low, high = self.band
        return (
            f"not supported by the data: {self.source} excites {self.axis} from {low:.2g} to {high:.2g} rad/s, and the "
            f"loop may cross above; record `multisine --band {max(0.5, 0.3 * high):.2g},25` and add it to the family"
        )


def axis_on_data(
    measured: AxisMeasured, law: LinearLaw, axis: int, *, source: str, name: str, extra: int, rolloff: float = -1.0
) -> TestedAxis:
    """Return the margins of one axis that hold for every response within the weight.

    Args:
        measured: what the recordings of a family show.
        law: the controller's linear form.
        axis: number of it.
        source: name of the family.
        name: of the axis.
        extra: samples of delay that the loop's order adds.
        rolloff: by which the loudest response at the band's end falls above it [dB/decade]; below 0 nobody knows.
    """
    Ts = law.sample_time
    w = np.geomspace(*measured.band, _POINTS)
    G0 = response_of(measured.model, w, Ts) * np.exp(-1j * w * Ts * extra)
    L = -law.feedback(w)[:, axis, axis] * G0
    # Half the way to the next frequency on top: no point of the curve lies between two disks.
    way = 0.5 * np.abs(np.diff(L)) / np.minimum(np.abs(L[1:]), np.abs(L[:-1]))
    W = measured.weight_at(w) + np.maximum(np.append(way, 0.0), np.append(0.0, way))
    loud = (1.0 + W) * np.abs(L)
    above = np.flatnonzero(loud >= 1.0)
    crossover = float(w[above[-1]]) if above.size else float(w[0])
    above_band = _above(measured.band[1], (1.0 + W[-1]) * np.abs(G0[-1]), law, axis, rolloff)
    if max(loud[-1], above_band) >= 1.0:
        crossover = math.inf
    mu = W * np.abs(L / (1.0 + L))
    values = _disk_margins(L, W, w)
    # The gain at which the loudest loop would cross where nothing is known.
    values["gain_margin"] = np.minimum(values["gain_margin"], 1.0 / max(loud[-1], above_band, 1e-12))
    peaks = ("sensitivity", "complementary")
    places = {key: int(np.argmax(item) if key in peaks else np.argmin(item)) for key, item in values.items()}
    margins = {key: float(values[key][k]) for key, k in places.items()}
    if above_band < 1.0:
        # Of any phase: |S| is at most 1/(1 - l), |T| l/(1 - l), |S - T| (1 + l)/(1 - l).
        margins["sensitivity"] = max(margins["sensitivity"], 1.0 / (1.0 - above_band))
        margins["complementary"] = max(margins["complementary"], above_band / (1.0 - above_band))
        margins["disk_margin"] = min(margins["disk_margin"], 2.0 * (1.0 - above_band) / (1.0 + above_band))
    if mu.max() >= 1.0:
        # The disk may hold the point -1: none of its margins is above none at all.
        margins |= dict.fromkeys(peaks, math.inf)
        margins |= {"disk_margin": 0.0, "gain_margin": 1.0, "phase_margin_deg": 0.0, "delay_margin_ms": 0.0}
    return TestedAxis(
        source=source, axis=name, band=measured.band, crossover=crossover,
        margins=margins if math.isfinite(crossover) else {}, mu=float(mu.max()),
        at={**{key: float(w[k]) for key, k in places.items()}, "mu": float(w[int(np.argmax(mu))])},
    )  # fmt: skip


def _above(end: float, loudest: float, law: LinearLaw, axis: int, rolloff: float) -> float:
    """Return the largest loop gain between the band's end [rad/s] and Nyquist that the stated roll-off leaves, or 0."""
    if rolloff < 0.0 or end >= math.pi / law.sample_time:
        return 0.0
    w = np.geomspace(end, math.pi / law.sample_time, _ABOVE)
    return float((np.abs(law.feedback(w)[:, axis, axis]) * loudest * (end / w) ** (rolloff / 20.0)).max())


def _disk_margins(L: np.ndarray, W: Vector, w: Vector) -> dict[str, Vector]:
    """Return name -> (m,) of the worst point of the disk of centre L and radius W |L| at each frequency."""
    r = W * np.abs(L)
    away = np.abs(1.0 + L) - r
    with np.errstate(divide="ignore", invalid="ignore"):
        S = np.where(away > 0.0, 1.0 / away, math.inf)
        T = np.where(away > 0.0, _largest_ratio(L, r, 0.0, 1.0), math.inf)
        difference = np.where(away > 0.0, _largest_ratio(L, r, 1.0, -1.0), math.inf)
        disk = 2.0 / difference
        gain = _gain_ratio(L, W)
        # `|1 + L exp(-j a)| = r` for the least a: on the circle of radius |L| that is a chord of the disk.
        size = np.abs(L)
        chord = (1.0 + size**2 - r**2) / (2.0 * size)
        half = np.arccos(np.clip(chord, -1.0, 1.0))
        angle = (np.angle(L) + math.pi) % (2.0 * math.pi)
        meets = np.abs(chord) <= 1.0
        late = np.where(meets, np.maximum(angle - half, 0.0), math.inf)
        phase = np.where(meets, np.minimum(late, np.maximum(2.0 * math.pi - angle - half, 0.0)), math.inf)
    return {
        "sensitivity": S, "complementary": T, "disk_margin": disk, "gain_margin": gain,
        "phase_margin_deg": np.degrees(phase), "delay_margin_ms": 1e3 * late / w,
    }  # fmt: skip


def _largest_ratio(L: np.ndarray, r: Vector, a: float, b: float) -> Vector:
    """Return the largest `|(a + b l)/(1 + l)|` over the disk `|l - L| <= r` that does not hold -1: b + (a - b)/(1 + l)
    is a disk again."""
    c, square = 1.0 + L, np.abs(1.0 + L) ** 2 - r**2
    centre, radius = np.conj(c) / square, r / square
    return np.abs(b + (a - b) * centre) + abs(a - b) * radius


def _gain_ratio(L: np.ndarray, W: Vector) -> Vector:
    """Return the least factor, up or down, that brings a point of the disk onto -1: `1 + 2 k Re L + k^2 q = 0`."""
    q, along = np.abs(L) ** 2 * (1.0 - W**2), np.real(L)
    root = np.sqrt(np.maximum(along**2 - q, 0.0))
    real = along**2 >= q
    ratios = []
    for sign in (-1.0, 1.0):
        k = (-along + sign * root) / np.where(q == 0.0, 1e-300, q)
        ratios.append(np.where(real & (k > 0.0), np.maximum(k, 1.0 / np.maximum(k, 1e-300)), math.inf))
    return np.minimum(*ratios)


def tested_axes(
    families: Mapping[str, Any], law: LinearLaw, axes: tuple[str, ...], extra: int, rolloff: float
) -> list[TestedAxis]:
    """Return what the data support about every axis of every family that was tested against them."""
    return [
        replace(
            axis_on_data(measured, law, axes.index(axis), source=name, name=axis, extra=extra, rolloff=rolloff),
            unheard=tuple(family.findings.get("tested", {}).get("unheard", {}).get(axis, ())),
        )
        for name, family in families.items()
        for axis, measured in getattr(family, "measured", {}).items()
        if axis in axes
    ]
