"""The virtual neck: a physics model that behaves like the real one."""

from ._neck import VirtualNeck as VirtualNeck
from ._parameters import NeckParameters as NeckParameters
from ._record import record as record
from ._record import settle as settle
