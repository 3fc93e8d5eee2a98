"""Design: controllers for the neck out of identified linear models, with limits and tendon allocation."""

from ._assembly import AxisController as AxisController
from ._assembly import pi_axis as pi_axis
from ._controller import LinearController as LinearController
from ._margins import Margins as Margins
from ._margins import loop_margins as loop_margins
from ._pi import PiSettings as PiSettings
