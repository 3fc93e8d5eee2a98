"""The drives of the neck: conversions between SI and the internal units of Technosoft iPOS drives."""

from ._units import DriveScale as DriveScale
from ._units import acceleration_to_internal as acceleration_to_internal
from ._units import counts_to_position as counts_to_position
from ._units import current_to_internal as current_to_internal
from ._units import internal_to_acceleration as internal_to_acceleration
from ._units import internal_to_current as internal_to_current
from ._units import internal_to_speed as internal_to_speed
from ._units import position_to_counts as position_to_counts
from ._units import speed_to_internal as speed_to_internal
