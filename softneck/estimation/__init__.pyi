from ._axis import AxisPlant as AxisPlant
from ._axis import LinearNeck as LinearNeck
from ._axis import axis_plant as axis_plant
from ._kalman import KalmanObserver as KalmanObserver
from ._noise import consistency as consistency
from ._noise import fit_noise as fit_noise
from ._nonlinear import NonlinearObserver as NonlinearObserver
from ._observer import observer as observer
from ._offline import Estimates as Estimates
from ._settings import KalmanSettings as KalmanSettings

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._axis import AXES as AXES
from ._axis import REACH_OF_STATIC_GAIN as REACH_OF_STATIC_GAIN
from ._axis import directions_of as directions_of
from ._axis import linear_reach as linear_reach
from ._axis import motor_ends as motor_ends
from ._axis import plants_scaling as plants_scaling
from ._axis import robot_of as robot_of
from ._axis import slowest_seconds as slowest_seconds
from ._forms import NECK_REACH as NECK_REACH
from ._observer import FittedObserver as FittedObserver
from ._observer import design_observer as design_observer
from ._observer import fit_observer as fit_observer
from ._settings import ORDERS as ORDERS
