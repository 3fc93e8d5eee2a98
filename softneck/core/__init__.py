"""Errors, checks, array types, units, archives, certificates and the table of kinds.

Used by every subpackage.
Imports no other subpackage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
