"""Predictive control: linear over identified transfer functions, nonlinear over networks and their like."""

from ._controller import MpcController as MpcController
from ._disturbance import MeasuredDisturbance as MeasuredDisturbance
from ._nmpc import NmpcController as NmpcController
from ._nmpc import NmpcSettings as NmpcSettings
from ._program import MpcInfo as MpcInfo
from ._program import MpcProgram as MpcProgram
from ._settings import MpcSettings as MpcSettings
