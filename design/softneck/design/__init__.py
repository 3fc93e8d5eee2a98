"""Design: controllers for the neck out of identified linear models, with limits and tendon allocation."""

from ._adaptive import AdaptiveSettings as AdaptiveSettings
from ._assembly import AxisController as AxisController
from ._assembly import pi_axis as pi_axis
from ._controller import LinearController as LinearController
from ._margins import Margins as Margins
from ._margins import loop_margins as loop_margins
from ._neck_table import FIGURES as FIGURES
from ._neck_table import NECK_HEAD as NECK_HEAD
from ._neck_table import NeckCase as NeckCase
from ._neck_table import NeckRow as NeckRow
from ._neck_table import NeckSteps as NeckSteps
from ._neck_table import neck_row as neck_row
from ._neck_table import neck_step as neck_step
from ._neck_table import neck_table as neck_table
from ._neck_table import table_cells as table_cells
from ._pi import PiSettings as PiSettings
from ._scheduled import ScheduledSettings as ScheduledSettings
from ._varying import Limits as Limits
from ._varying import VaryingController as VaryingController
