"""Design: controllers for the neck out of identified linear models, with limits and tendon allocation."""

from ._assembly import AxisController as AxisController
from ._assembly import pi_axis as pi_axis
from ._bake_off import BakeOff as BakeOff
from ._bake_off import BakeOffResult as BakeOffResult
from ._bake_off import bake_off_neck as bake_off_neck
from ._bake_off import bake_off_plant as bake_off_plant
from ._bake_off import bake_off_plants as bake_off_plants
from ._bake_off import bake_off_samples as bake_off_samples
from ._bake_off import block_stepper as block_stepper
from ._bake_off import run_bake_off as run_bake_off
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
from .mpc import MeasuredDisturbance as MeasuredDisturbance
from .mpc import MpcController as MpcController
from .mpc import MpcSettings as MpcSettings
