"""The closed loop over anything that steps: wiring by name, order, metrics; arrays only, no FMI, no files."""

from ._loop import ORDERS as ORDERS
from ._loop import Loop as Loop
from ._loop import run_loop as run_loop
from ._metrics import SETTLING_BAND as SETTLING_BAND
from ._metrics import check_limits as check_limits
from ._metrics import metrics as metrics
from ._part import BlockPart as BlockPart
from ._part import Part as Part
from ._references import RampReference as RampReference
from ._references import RecordingReference as RecordingReference
from ._references import Reference as Reference
from ._references import RotationReference as RotationReference
from ._references import SineReference as SineReference
from ._references import StepReference as StepReference
from ._references import make_reference as make_reference
from ._result import LoopResult as LoopResult
