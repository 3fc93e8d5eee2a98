"""Recordings, importers of foreign logs, quality reports and excitation signals.

Files are read and written here; models do not enter.
May import `robot` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
