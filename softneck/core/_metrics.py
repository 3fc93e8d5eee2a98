"""All aggregated numbers that softneck states, by name: what they are and which direction is better.

A number over several members (plants, axes, runs, payloads, recordings) is the worst of them. One that is not known is
the worst of all: a NaN never vanishes in a maximum or a mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ._errors import SettingsError


@dataclass(frozen=True, slots=True)
class Metric:
    """One aggregated number.

    `title`: its plain name. `of`: "peak" (the largest or smallest of its samples), "mean" (of their squares or sizes),
    "ratio" (of an error to the measured signal), "step" (of the shape of a response) or "time" (with a condition).
    `larger`: whether larger is better.
    """

    title: str
    of: str
    larger: bool = False

    @property
    def unknown(self) -> float:
        """What counts where it could not be computed: no margin at all, else an infinite value or error."""
        return math.inf if not self.larger else 0.0 if self.of == "peak" else -math.inf


#: Names without the unit at their end, in every table of results, and their metrics.
METRICS = {
    # Linear methods and experiments on loops.
    "radius": Metric("spectral radius", "peak"),
    "searched_radius": Metric("spectral radius, searched", "peak"),
    "sensitivity": Metric("peak sensitivity", "peak"),
    "complementary": Metric("peak complementary sensitivity", "peak"),
    "control_sensitivity": Metric("peak control sensitivity", "peak"),
    "disk_margin": Metric("disk margin", "peak", larger=True),
    "gain_margin": Metric("gain margin", "peak", larger=True),
    "phase_margin": Metric("phase margin", "peak", larger=True),
    "delay_margin": Metric("delay margin", "peak", larger=True),
    "mu": Metric("structured singular value", "peak"),
    # Responses of loops.
    "overshoot": Metric("overshoot", "step"),
    "rise": Metric("rise time", "step"),
    "settling": Metric("settling time", "step"),
    "steady_rms": Metric("steady-state error", "mean"),
    "rms_error": Metric("tracking error, rms", "mean"),
    "load_rms": Metric("error under the load, rms", "mean"),
    "iae": Metric("integral of the absolute error", "mean"),
    "ise": Metric("integral of the squared error", "mean"),
    "itae": Metric("integral of the absolute error times time", "mean"),
    "coupling": Metric("coupling", "peak"),
    "max": Metric("largest set-point", "peak"),
    "max_rate": Metric("largest rate of a set-point", "peak"),
    "effort": Metric("effort of the motors", "mean"),
    "total_variation": Metric("total variation of the set-points", "mean"),
    "limit_violation": Metric("time beyond the limits", "time"),
    "slack": Metric("time with a slack tendon", "time"),
    "min": Metric("least validity", "peak", larger=True),
    "circle_rms": Metric("error on a circle, rms", "mean"),
    "ahead_rms": Metric("error on a circle known ahead, rms", "mean"),
    "variation": Metric("variation of the set-points", "mean"),
    # Models and observers against recordings.
    "fits": Metric("fit", "ratio", larger=True),
    "r2": Metric("coefficient of determination", "ratio", larger=True),
    "rmse": Metric("error, rms", "mean"),
    "worst": Metric("largest error", "peak"),
    "cold_fits": Metric("fit from the first row alone", "ratio", larger=True),
    "coverage": Metric("samples within the bounds", "mean", larger=True),
    "mean_width": Metric("mean width of the bounds", "mean"),
    "outside": Metric("samples outside what the model has seen", "mean"),
    "log_likelihood": Metric("log likelihood of a measurement", "mean", larger=True),
    "checks": Metric("look-ahead error, rms", "mean"),
    # Runs of a study.
    "failed": Metric("runs that failed", "mean"),
    "holds": Metric("runs that keep their limits", "mean", larger=True),
}


def metric_of(name: str) -> Metric:
    """Return the metric of a name such as "sim.rise_s" or "motors.max_bar"; raise SettingsError if there is none."""
    known = _key_and_unit(name)[0]
    if not known:
        raise SettingsError(f"`{name}` is not a metric of softneck; register it in `softneck.core._metrics`.")
    return METRICS[known]


def unit_of_metric(name: str) -> str:
    """Return the unit at the end of a metric's name, with a space before it; "" for none."""
    unit = _key_and_unit(name)[1].replace("pct", "%").replace("_", "/")
    return unit and f" {unit}"


def _key_and_unit(name: str) -> tuple[str, str]:
    """Return the key of a metric and what follows: a unit, or nothing; two empty texts for another name."""
    # Which of several runs it is may follow too: `load_rms_mm`, `rise_s`, `rise_s worst`, `holds [%]`.
    last = name.partition(" ")[0].rpartition(".")[2]
    known = max((key for key in METRICS if f"{last}_".startswith(f"{key}_")), key=len, default="")
    return known, last[len(known) + 1 :] if known else ""


def worst(name: str, values: Iterable[float]) -> float:
    """Return the worst value of a metric over its members; with a NaN among them `Metric.unknown`."""
    found, metric = [float(value) for value in values], metric_of(name)
    if any(map(math.isnan, found)):
        return metric.unknown
    return min(found) if metric.larger else max(found)
