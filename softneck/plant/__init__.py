"""The virtual neck: a physics model that behaves like the real one.

It shares no equation with any identified model; no FMI here.
May import `loop`, `signals` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
