"""The CiA 402 master without I/O: frames and time in, frames out.

States, events and reactions are tables.
Imports `core` and `drives.supervision`: no clock, no bus, no thread.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
