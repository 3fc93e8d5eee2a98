"""What a nonlinear predictive controller computes once: references, disturbance, in the order of the horizon."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ._horizon_estimate import disturbance_ahead, estimate_gains

if TYPE_CHECKING:
    from ._nmpc import NmpcController

# Samples without measurement until the motors hold, and samples after which a model has settled.
COAST = 25
SETTLE = 200


class Preparation:
    """Filters over the horizon, the moves that a moving reference asks for itself, and the disturbance's gains."""

    def __init__(self, controller: NmpcController) -> None:
        """Prepare `controller`."""
        s, Ts = controller.settings, controller.sample_time
        p = self.problem = controller.problem()
        plants = controller.plants()
        pole = max(float(-plant.denominator[1]) for plant in plants)
        if s.disturbance_time is not None:
            pole = math.exp(-Ts / s.disturbance_time)
        self.gains = estimate_gains(pole, s.window)
        self.future = disturbance_ahead(pole, p.horizon)
        self.gain = np.array([plant.static_gain for plant in plants])
        self.ahead = round(s.preview / Ts)
        self.keep = math.exp(-Ts / s.reference_time) if s.reference_time > 0.0 else 0.0
        self.lead = min(round(s.reference_time / Ts), self.ahead)
        delay = max(plant.delay for plant in plants)
        L = p.horizon + delay + 1
        i = np.arange(1, L + 1)
        self.decay = self.keep**i
        lag = i[:, None] - i[None, :]
        self.filter = np.where(lag >= 0, (1.0 - self.keep) * self.keep ** np.maximum(lag, 0), 0.0)
        self.asked_at = np.minimum(i + self.lead, max(self.ahead, 1)) - 1
        ends = (*p.starts[1:], p.horizon)
        middles = np.array([-0.5, *(0.5 * (a + b) for a, b in zip(p.starts, ends, strict=True))]) + delay
        places = np.clip(middles, 0.0, L - 1.0)
        low = np.minimum(np.floor(places).astype(int), L - 2)
        weights = np.zeros((places.size, L))
        weights[np.arange(places.size), low] += 1.0 - (places - low)
        weights[np.arange(places.size), low + 1] += places - low
        self.slopes = np.diff(weights, axis=0)
        self.inverse = np.linalg.inv(p.T)[:, :2]
