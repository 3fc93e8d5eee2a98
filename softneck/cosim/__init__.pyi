from .loops._loop_file import load_loop as load_loop
from .loops._loop_file import load_ssp as load_ssp
from .loops._loop_file import make_loop as make_loop
from .loops._simulate import Loop as Loop
from .loops._simulate import Result as Result
from .loops._simulate import simulate as simulate
from .loops._write_ssp import write_ssp as write_ssp
from .parts._fmu_part import FmuError as FmuError
from .parts._fmu_part import FmuPart as FmuPart
from .parts._fmu_part import simulate_fmu as simulate_fmu
from .parts._isolated import IsolatedPart as IsolatedPart
from .studies._run_study import study as study
from .studies._store import group_runs as group_runs
from .studies._store import pareto_front as pareto_front
from .studies._store import rank as rank
from .studies._store import read_runs as read_runs
from .studies._store import worst_runs as worst_runs
from .studies._study import load_study as load_study
from .studies._study import make_study as make_study

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from .loops._loop_file import LoopSetup as LoopSetup
from .loops._loop_file import find_python as find_python
from .loops._loop_file import is_loop_file as is_loop_file
from .loops._loop_file import reference_of as reference_of
from .loops._loop_file import require_trusted as require_trusted
from .loops._loop_parts import read_toml as read_toml
from .loops._simulate import describe_excess_range as describe_excess_range
from .loops._simulate import run_setup as run_setup
from .studies._run_study import WorkerPool as WorkerPool
from .studies._run_study import open_workers as open_workers
from .studies._run_study import run_study as run_study
from .studies._store import STUDY_FILE as STUDY_FILE
from .studies._store import pareto_rows as pareto_rows
from .studies._store import read_study_description as read_study_description
from .studies._store import write_worst as write_worst
from .studies._study import Study as Study
