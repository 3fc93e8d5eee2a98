"""From a logged experiment on a tendon-driven soft robotic neck to a verified controller on its drives.

The front door: what a first script needs, each name imported when it is first used (PEP 562).
Everything else is in the subpackages: `softneck.signals`, `softneck.identification`, `softneck.design`, ...
"""

import lazy_loader

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
