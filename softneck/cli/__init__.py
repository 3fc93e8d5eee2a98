"""The `softneck` command: one thin module for each subcommand.

Errors become one line and an exit code in one place, `_main`.
May import everything; nothing imports it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
