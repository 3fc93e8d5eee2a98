"""Charts as plain data, drawn by matplotlib or Bokeh, and self-contained pages.

A chart knows recordings, but no model and no controller.
May import `signals` and below.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
