"""Tuning: search kinds and settings for the controller that meets the requirements.

It holds requirements, the search space, judging by levels, the search and its results; it writes its own log only.
May import `verification` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
