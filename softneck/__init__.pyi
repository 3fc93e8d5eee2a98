from . import core as core
from . import cosim as cosim
from . import design as design
from . import drives as drives
from . import estimation as estimation
from . import fmu as fmu
from . import identification as identification
from . import loop as loop
from . import plant as plant
from . import plots as plots
from . import report as report
from . import robot as robot
from . import runtime as runtime
from . import signals as signals
from . import verification as verification
from .core._kinds import load as load
from .cosim.loops._simulate import simulate as simulate
from .cosim.studies._run_study import study as study
from .design._design import design_controller as design_controller
from .fmu.python._build import build_fmu as build_fmu
from .identification._identify import identify as identify
from .identification.validation._validation import validate as validate
from .plant._neck import VirtualNeck as VirtualNeck
from .plant._record import record as record
from .signals.recording._files import read_recording as read_recording
from .verification._verify import verify as verify

__version__: str
