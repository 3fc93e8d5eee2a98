"""Controllers out of identified linear models, with limits and tendon allocation.

One part for each family of controllers, `plants` below them.
May import `estimation`, `identification` and below; verification is above.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
