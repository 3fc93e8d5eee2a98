"""The closed loop over anything that steps: wiring by name, order, references, faults, metrics.

Arrays only: no FMI, no files, no clocks.
May import `signals` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
