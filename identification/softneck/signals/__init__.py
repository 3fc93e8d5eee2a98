"""Recordings, importers, excitation signals and the paper's input redefinition."""

from ._channels import MOTOR_POSITIONS as MOTOR_POSITIONS
from ._channels import OUTPUTS as OUTPUTS
from ._channels import SET_POINTS as SET_POINTS
from ._channels import column_name as column_name
from ._channels import file_unit as file_unit
from ._channels import known_channels as known_channels
from ._channels import si_unit as si_unit
from ._excitation import SAMPLE_TIME as SAMPLE_TIME
from ._excitation import Excitation as Excitation
from ._excitation import signal as signal
from ._excitation import signal_names as signal_names
from ._files import read_recording as read_recording
from ._files import recording_frame as recording_frame
from ._files import recording_suffix as recording_suffix
from ._files import write_recording as write_recording
from ._layout import Imported as Imported
from ._layout import Layout as Layout
from ._layout import import_log as import_log
from ._layout import read_layout as read_layout
from ._recording import Recording as Recording
from ._recording import concatenate as concatenate
from ._redefinition import TENDON_ANGLES as TENDON_ANGLES
from ._redefinition import motors_from as motors_from
from ._redefinition import redefine as redefine
from ._redefinition import redefinition_matrix as redefinition_matrix
from ._tilt import pitch_roll as pitch_roll
