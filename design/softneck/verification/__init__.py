"""Verification: a controller against all that its plant may be, on what it claims."""

from ._agreement import Agreement as Agreement
from ._evidence import Evidence as Evidence
from ._page import verdict_table as verdict_table
from ._page import verification_page as verification_page
from ._plants import UncertainNeck as UncertainNeck
from ._requirements import DEFAULT_FILE as DEFAULT_FILE
from ._requirements import METRIC_NAMES as METRIC_NAMES
from ._requirements import Requirement as Requirement
from ._requirements import Requirements as Requirements
from ._requirements import make_requirements as make_requirements
from ._requirements import read_requirements as read_requirements
from ._verify import Verdict as Verdict
from ._verify import Verification as Verification
from ._verify import sources_of as sources_of
from ._verify import verify as verify
from ._worst import linear_plant as linear_plant
from ._worst import virtual_neck as virtual_neck
