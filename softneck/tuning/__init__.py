"""Tuning: search kinds and settings for the controller that meets the requirements.

Requirements, the space of settings, judging by levels, search, results; nothing here reads or writes but its own log.
May import `verification` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
