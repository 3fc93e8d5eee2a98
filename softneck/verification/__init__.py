"""Verification: a controller on every plant of its family, requirement by requirement.

Writes a certificate, or the worst case of what does not hold.
May import `cosim`, `design` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
