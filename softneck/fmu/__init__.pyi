from .compiled._build import build_compiled_fmu as build_compiled_fmu
from .describe._describe import FmuInfo as FmuInfo
from .describe._describe import fmu_info as fmu_info
from .python._build import build_fmu as build_fmu
from .python._zip import unpack as unpack
from .python._zip import unpacked as unpacked
