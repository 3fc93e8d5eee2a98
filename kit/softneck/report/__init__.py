"""The main job end to end, and its report."""

from ._demo import Demo as Demo
from ._demo import DemoSettings as DemoSettings
from ._demo import run_demo as run_demo
from ._tables import FIT_HEAD as FIT_HEAD
from ._tables import FIT_NOTE as FIT_NOTE
from ._tables import fit_rows as fit_rows
from ._tables import fmu_rows as fmu_rows
from ._tables import loop_rows as loop_rows
from ._validation_page import VALIDATION_NOTE as VALIDATION_NOTE
from ._validation_page import validation_page as validation_page
