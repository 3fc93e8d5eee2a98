"""Simulated CANopen drives on the virtual neck; shares no code with the master (a contract forbids it)."""

from ._axis import Axis as Axis
from ._frame import CanFrame as CanFrame
from ._neck import SimulatedNeck as SimulatedNeck
from ._neck import SimulatedSettings as SimulatedSettings
from ._neck import TiltSample as TiltSample
from ._node import SimulatedDrive as SimulatedDrive
from ._profiles import PROFILES as PROFILES
from ._server import serve as serve
