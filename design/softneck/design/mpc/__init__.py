"""Predictive control: linear over identified transfer functions."""

from ._controller import MpcController as MpcController
from ._disturbance import MeasuredDisturbance as MeasuredDisturbance
from ._settings import MpcSettings as MpcSettings
