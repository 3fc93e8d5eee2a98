"""PI with a model of the response that is asked for: what feedback sees is only what the model does not explain."""

from __future__ import annotations

import numpy as np

from softneck.estimation import AxisPlant

from ..linear._assembly import AxisController
from ..linear._tuning import Gains


def following_axis(gains: Gains, plant: AxisPlant, delay: int, leak_time: float) -> AxisController:
    """Return `v = r/G0 + K (ym - y) + s`, `s+ = s + K Ts/Ti (ym - y)`, `ym = z^-d (1 - a)/(z - a) r`.

    The static gain G0 and the pole a are the plant's: if it is as modelled, y follows ym, the feedback rests, and the
    response is that of the plant with its input filtered as the reference is (Astrom and Hagglund 2006, Advanced PID
    Control, sec. 5.4). Loop and margins are those of the PI alone.

    Conditioning: the model gets what the motors can do instead of what was asked, so that it waits for a limited
    input; the integral besides leaks what is beyond a limit, over `leak_time`.

    States: s, the model's lag, its delay line. All mean the same for all gains.

    Args:
        gains: K and Ti.
        plant: of order one, or of any with the slowest pole taken.
        delay: of the model beyond its first sample [samples].
        leak_time: [s].
    """
    Ts = plant.sample_time
    a = float(np.abs(np.roots(plant.denominator)).max(initial=0.0))
    forward, K, rate = 1.0 / plant.static_gain, gains.gain, gains.gain * Ts / gains.integral_time
    n = 2 + delay
    A = np.zeros((n, n))
    A[0, 0], A[1, 1] = 1.0, a
    A[0, -1] += rate
    for i in range(2, n):
        A[i, i - 1] = 1.0
    Br, By, C, L = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((1, n)), np.zeros((n, 1))
    Br[1], By[0] = 1.0 - a, -rate
    C[0, 0], C[0, -1] = 1.0, K
    L[0], L[1] = Ts / leak_time, (1.0 - a) / forward
    return AxisController(A=A, Br=Br, By=By, C=C, Dr=forward, Dy=-K, L=L)
