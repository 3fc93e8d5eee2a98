"""Model predictive control, linear and nonlinear, and trajectories planned before anything moves.

The QP is written once in CasADi; a runtime solves it in loops and FMUs.
May import `design.linear` and `design.plants`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
