from ._design import design_controller as design_controller
from .linear._controller import LinearController as LinearController
from .linear._custom import CustomSettings as CustomSettings
from .linear._fopi import FopiSettings as FopiSettings
from .linear._fopi import fopi as fopi
from .linear._lqg import LqgSettings as LqgSettings
from .linear._own import OwnController as OwnController
from .linear._pi import PiSettings as PiSettings
from .linear._pid import PidSettings as PidSettings
from .linear._ports import ControllerLimits as ControllerLimits
from .plants._uncertain import uncertain_plant as uncertain_plant
from .predictive._controller import MpcController as MpcController
from .predictive._nmpc import NmpcController as NmpcController
from .predictive._nmpc import NmpcSettings as NmpcSettings
from .predictive._settings import MpcSettings as MpcSettings
from .robust._hinf import HinfSettings as HinfSettings
from .robust._hinf import hinfsyn as hinfsyn
from .robust._hinf import mixsyn as mixsyn
from .robust._mu import mu_upper as mu_upper
from .robust._weights import makeweight as makeweight
from .varying._adaptive import AdaptiveSettings as AdaptiveSettings
from .varying._adaptive import VaryingController as VaryingController

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._design import linear_plant as linear_plant
from .linear._axis_loop import least_rise as least_rise
from .linear._controller import assumed_lines as assumed_lines
from .linear._own import own_attributes as own_attributes
from .linear._own import own_controller as own_controller
from .linear._own import own_module as own_module
from .linear._ports import motor_ranges as motor_ranges
from .linear._settings import AxisSettings as AxisSettings
from .linear._settings import LoopSettings as LoopSettings
from .linear._settings import axis_test as axis_test
from .plants._uncertain import UncertainPlant as UncertainPlant
from .robust._mu import two_scalars as two_scalars
