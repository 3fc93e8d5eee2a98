"""Closed loops over FMUs and Python parts: FMUs as parts, loop files, results."""

from softneck.loop import Loop as Loop
from softneck.loop import LoopRun as LoopRun
from softneck.loop import LoopState as LoopState
from softneck.loop import LoopStep as LoopStep

from ._fmu_part import FmuError as FmuError
from ._fmu_part import FmuPart as FmuPart
from ._free_run import drive_fmu as drive_fmu
from ._free_run import simulate_fmu_free_run as simulate_fmu_free_run
from ._isolated import IsolatedPart as IsolatedPart
from ._loop_file import is_loop_file as is_loop_file
from ._loop_file import load_loop as load_loop
from ._loop_file import make_loop as make_loop
from ._loop_file import reference_of as reference_of
from ._result import Result as Result
from ._run_study import run_study as run_study
from ._run_study import study as study
from ._simulate import LoopSetup as LoopSetup
from ._simulate import simulate as simulate
from ._ssp import write_ssp as write_ssp
from ._store import read_description as read_description
from ._store import read_runs as read_runs
from ._study import Study as Study
from ._study import load_study as load_study
from ._study import make_study as make_study
from ._study_results import grouped as grouped
from ._study_results import pareto_front as pareto_front
from ._study_results import rank as rank
from ._study_results import worst_runs as worst_runs
from ._study_results import write_worst as write_worst
from ._vary import Vary as Vary
