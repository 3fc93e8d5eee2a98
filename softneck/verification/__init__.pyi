from ._page import verification_page as verification_page
from ._requirements import METRIC_NAMES as METRIC_NAMES
from ._requirements import Requirements as Requirements
from ._requirements import make_requirements as make_requirements
from ._requirements import read_requirements as read_requirements
from ._verify import Verification as Verification
from ._verify import verify as verify
from ._worst import linear_plant as linear_plant
