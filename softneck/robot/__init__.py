"""The robot: its motors, outputs, directions and limits, read from a `robot.toml`, and the presets.

Says what a file's channels are; what is not given is not assumed.
May import `core`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
