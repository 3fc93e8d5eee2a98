from .compiled._build import build_compiled_fmu as build_compiled_fmu
from .describe._describe import FmuInfo as FmuInfo
from .describe._describe import fmu_info as fmu_info
from .python._build import build_fmu as build_fmu
from .python._zip import unpack as unpack
from .python._zip import unpacked as unpacked

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from .compiled._compilers import PLATFORMS as PLATFORMS
from .compiled._library import platforms_built as platforms_built
from .compiled._look_ahead import next_outputs as next_outputs
from .compiled._model_file import node_of as node_of
from .describe._describe import Buildable as Buildable
from .describe._describe import buildable as buildable
from .describe._describe import has_keys as has_keys
from .describe._description import LIMIT_OUTPUTS as LIMIT_OUTPUTS
from .describe._description import exported_block as exported_block
