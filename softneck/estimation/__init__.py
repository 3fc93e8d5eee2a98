"""Observers: Kalman filters over linear models, simulation with a disturbance over nonlinear ones.

filterpy designs and tests; our runtimes run in loops and FMUs.
May import `identification` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
