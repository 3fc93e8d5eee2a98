"""Models of a robot from recordings, and their validation.

One part for each family of methods, and `validation` and `selection` above them.
May import `plant`, `loop`, `signals` and below; no controller enters.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
