"""Closed loops over FMUs and Python parts: loop files, results, studies, SSP.

fmpy makes the FMI calls.
May import `fmu`, `loop` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
