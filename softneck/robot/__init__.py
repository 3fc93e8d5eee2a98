"""The robot: its motors, outputs, directions and limits, read from a `robot.toml`, and the presets.

Defines the names of channels; values that are not given stay None.
May import `core`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
