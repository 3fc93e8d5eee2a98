from ._neck import VirtualNeck as VirtualNeck
from ._parameters import NeckParameters as NeckParameters
from ._record import record as record
from ._record import settle as settle

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._calibration import Calibration as Calibration
from ._calibration import calibrate as calibrate
from ._neck import has_own_tendons as has_own_tendons
from ._neck import require_tendons as require_tendons
from ._neck import tendons_of as tendons_of
from ._presets import PRESETS as PRESETS
