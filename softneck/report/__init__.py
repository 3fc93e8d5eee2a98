"""Pages on whole jobs: the demo, the paper, a project, a study, a validation.

It computes nothing but what it shows, through the subpackages below.
May import everything but `cli`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
