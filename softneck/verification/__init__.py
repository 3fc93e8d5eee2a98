"""Verification: a controller against all that its plant may be, requirement by requirement.

What holds becomes a certificate; what does not is shown as its worst case.
May import `cosim`, `design` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
