from ._tune import tune as tune

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._requirements import check_feasibility as check_feasibility
from ._search import Candidate as Candidate
from ._tune import Loosened as Loosened
from ._tune import Tuned as Tuned
from ._tune import loops_start as loops_start
from ._tune import step_response as step_response
from ._tune import task_of as task_of
