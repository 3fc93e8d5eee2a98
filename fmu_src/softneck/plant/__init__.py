"""The virtual neck: a physics model that behaves like the real one."""

from ._batch import simulate_batch as simulate_batch
from ._energy import NeckEnergy as NeckEnergy
from ._energy import free_lengths as free_lengths
from ._energy import neck_energy as neck_energy
from ._energy import potential_energy as potential_energy
from ._neck import RUNTIME as RUNTIME
from ._neck import VirtualNeck as VirtualNeck
from ._parameters import NeckParameters as NeckParameters
from ._record import record as record
from ._record import settle as settle
