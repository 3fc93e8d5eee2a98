"""Plain names of metrics for pages and tables: "gain margin, worst axis (axes.gain_margin)"."""

from __future__ import annotations

_TITLES = {
    "radius": "spectral radius",
    "searched_radius": "spectral radius, searched",
    "sensitivity": "peak sensitivity",
    "complementary": "peak complementary sensitivity",
    "control_sensitivity": "peak control sensitivity",
    "disk_margin": "disk margin",
    "gain_margin": "gain margin",
    "phase_margin": "phase margin",
    "delay_margin": "delay margin",
    "mu": "structured singular value",
    "overshoot": "overshoot",
    "rise": "rise time",
    "settling": "settling time",
    "steady_rms": "steady-state error",
    "rms_error": "tracking error, rms",
    "load_rms": "error under the load, rms",
    "coupling": "coupling",
    "max": "largest set-point",
    "limit_violation": "time beyond the limits",
    "slack": "time with a slack tendon",
    "circle_rms": "error on a circle, rms",
    "ahead_rms": "error on a circle known ahead, rms",
    "variation": "variation of the set-points",
}
_GROUPS = {
    "stability": "every plant", "axes": "worst axis", "mimo": "all axes at once", "robust": "whole uncertainty",
    "step": "linear plants", "sim": "simulation", "track": "simulation",
}  # fmt: skip


def metric_title(metric: str) -> str:
    """Return the plain name of a metric with its key: "gain margin, worst axis (axes.gain_margin)"."""
    group, _, name = metric.partition(".")
    # What follows the name is the unit of the robot or of the metric: `load_rms_mm`, `rise_s`.
    known = max((key for key in _TITLES if f"{name}_".startswith(f"{key}_")), key=len, default="")
    return f"{_TITLES[known]}, {_GROUPS.get(group, group)} ({metric})" if known else metric
