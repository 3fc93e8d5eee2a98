"""The closed loop over objects with `step`: wiring by name, order, references, faults, metrics.

Arrays and no FMI; a clock only paces a run, a file only keeps its state.
May import `signals` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
