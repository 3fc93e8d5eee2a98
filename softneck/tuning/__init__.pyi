from ._tune import tune as tune

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._compare import Loosened as Loosened
from ._compare import objectives as objectives
from ._judge import LEVELS as LEVELS
from ._judge import judge_candidate as judge_candidate
from ._requirements import check_feasibility as check_feasibility
from ._search import Candidate as Candidate
from ._task import circle_angles as circle_angles
from ._task import curve_times as curve_times
from ._task import has_observer as has_observer
from ._tune import Tuned as Tuned
from ._tune import task_of as task_of
