"""Verification: a controller on every plant of its family, requirement by requirement.

It gives a certificate, and a loop file of the worst case of each requirement.
May import `cosim`, `design` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
