"""Estimation: the inclinometer's Kalman filter over set-points, gyro rates or nothing else."""

from ._axis import AXES as AXES
from ._axis import AxisPlant as AxisPlant
from ._axis import HasTransferFunctions as HasTransferFunctions
from ._axis import LinearNeck as LinearNeck
from ._axis import axis_plant as axis_plant
from ._consistency import Consistency as Consistency
from ._consistency import Squares as Squares
from ._consistency import consistency as consistency
from ._forms import FORMS as FORMS
from ._kalman import KalmanObserver as KalmanObserver
from ._noise import NoiseFit as NoiseFit
from ._noise import fit_noise as fit_noise
from ._offline import Estimates as Estimates
from ._sensors import SENSORS as SENSORS
from ._sensors import Sensor as Sensor
from ._sensors import find_sensor as find_sensor
from ._settings import ORDERS as ORDERS
from ._settings import KalmanSettings as KalmanSettings
from ._ukf import UkfObserver as UkfObserver
from ._ukf import ukf as ukf
from ._ukf_part import UkfPart as UkfPart
