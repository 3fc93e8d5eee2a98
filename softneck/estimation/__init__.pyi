from ._axis import AxisPlant as AxisPlant
from ._axis import LinearNeck as LinearNeck
from ._axis import axis_plant as axis_plant
from ._consistency import consistency as consistency
from ._kalman import KalmanObserver as KalmanObserver
from ._noise import fit_noise as fit_noise
from ._nonlinear import NonlinearObserver as NonlinearObserver
from ._observer import observer as observer
from ._offline import Estimates as Estimates
from ._settings import KalmanSettings as KalmanSettings

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._axis import AXES as AXES
from ._axis import directions_of as directions_of
from ._axis import robot_of as robot_of
from ._fitted import FittedObserver as FittedObserver
from ._forms import Reach as Reach
from ._observer import designed as designed
from ._observer import fitted as fitted
from ._reach import REACHED as REACHED
from ._reach import linear_reach as linear_reach
from ._reach import motor_ends as motor_ends
from ._scaling import plants_scaling as plants_scaling
from ._scaling import slowest_seconds as slowest_seconds
from ._settings import ORDERS as ORDERS
