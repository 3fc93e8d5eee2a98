from ._loading import find_robot as find_robot
from ._robot import Robot as Robot

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._channels import MOST_MOTORS as MOST_MOTORS
from ._channels import Directions as Directions
from ._channels import Motors as Motors
from ._channels import Outputs as Outputs
from ._channels import is_set_point as is_set_point
from ._channels import motor_positions_among as motor_positions_among
from ._file import OPTIONAL_KEYS as OPTIONAL_KEYS
from ._file import ROBOT_KEYS as ROBOT_KEYS
from ._file import ROBOT_PRESETS as ROBOT_PRESETS
from ._file import preset_text as preset_text
from ._loading import ROBOT_FILE as ROBOT_FILE
from ._loading import load_for_robot as load_for_robot
from ._loading import robot_file_of as robot_file_of
from ._scaling import MOTOR_RANGE as MOTOR_RANGE
from ._scaling import OUTPUT_RANGE as OUTPUT_RANGE
from ._scaling import TIME_CONSTANT as TIME_CONSTANT
from ._scaling import Scaling as Scaling
from ._scaling import round_scaled as round_scaled
from ._scaling import scaled_robot as scaled_robot
