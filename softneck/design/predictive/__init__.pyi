from ._plan import PlanSettings as PlanSettings
from ._plan import plan as plan
