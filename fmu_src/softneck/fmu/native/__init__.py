"""FMUs without Python: the runtimes translated to C, one library for all kinds, FMI 2.0 and 3.0."""

from ._build import build_compiled_fmu as build_compiled_fmu
from ._library import build_all as build_all
from ._library import platforms_built as platforms_built
from ._platforms import PLATFORMS as PLATFORMS
from ._sources import c_sources as c_sources
