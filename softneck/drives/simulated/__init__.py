"""Simulated CANopen drives on the virtual neck.

They share no code with the master (a contract forbids it).
May import `plant` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
