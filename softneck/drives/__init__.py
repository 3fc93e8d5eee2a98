"""Drives of necks and other robots: CANopen master, safety, commissioning, runs, logs, and simulated drives.

Hardware is touched in `bus` and `sensing` only.
May import `verification`, `cosim` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
