from ._neck import VirtualNeck as VirtualNeck
from ._parameters import NeckParameters as NeckParameters
from ._record import record as record
from ._record import settle as settle
