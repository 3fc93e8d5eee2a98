"""FMI 2.0 FMUs out of blocks, through pythonfmu."""

from ._build import build_fmu as build_fmu
from ._describe import Buildable as Buildable
from ._describe import describe as describe
from ._info import FmuInfo as FmuInfo
from ._unpack import unpack as unpack
from ._unpack import unpacked as unpacked
