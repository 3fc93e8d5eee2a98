from ._drives import SimulatedSettings as SimulatedSettings
from ._neck import SimulatedNeck as SimulatedNeck
from ._node import SimulatedDrive as SimulatedDrive
from ._server import serve as serve
