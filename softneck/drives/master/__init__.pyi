from ._events import Event as Event
from ._fieldbus import Frame as Frame
from ._gate import Tilt as Tilt
from ._master import Master as Master
from ._settings import MasterSettings as MasterSettings
from ._supervisor import Phase as Phase
