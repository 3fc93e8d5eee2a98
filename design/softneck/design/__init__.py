"""Design: controllers for the neck out of identified linear models, with limits and tendon allocation."""

from ._assembly import AxisController as AxisController
from ._assembly import pi_axis as pi_axis
from ._controller import LinearController as LinearController
from ._margins import Margins as Margins
from ._margins import loop_margins as loop_margins
from ._mu import Mu as Mu
from ._mu import Structure as Structure
from ._mu import mu_bounds as mu_bounds
from ._mu import mu_lower as mu_lower
from ._mu import mu_upper as mu_upper
from ._mu import two_scalars as two_scalars
from ._pi import PiSettings as PiSettings
from ._robustness import DiskMargin as DiskMargin
from ._robustness import RobustStability as RobustStability
from ._robustness import WorstCaseGain as WorstCaseGain
from ._robustness import diskmargin as diskmargin
from ._robustness import robstab as robstab
from ._robustness import wcgain as wcgain
from ._robustness import worst_gains as worst_gains
from ._robustness_gap import nugap as nugap
