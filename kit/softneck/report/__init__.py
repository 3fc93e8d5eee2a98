"""The main job end to end, and its report."""

from ._demo import Demo as Demo
from ._demo import DemoSettings as DemoSettings
from ._demo import run_demo as run_demo
from ._paper_figures import paper_chart as paper_chart
from ._paper_page import LINEAR_HEAD as LINEAR_HEAD
from ._paper_page import grouped as grouped
from ._paper_page import linear_facts as linear_facts
from ._paper_page import linear_rows as linear_rows
from ._paper_page import paper_page as paper_page
from ._paper_tables import PAPER_HEAD as PAPER_HEAD
from ._paper_tables import PAPER_NOTE as PAPER_NOTE
from ._paper_tables import paper_entries as paper_entries
from ._reproduce import ReproduceSettings as ReproduceSettings
from ._reproduce import Reproduction as Reproduction
from ._reproduce import reproduce as reproduce
from ._tables import FIT_HEAD as FIT_HEAD
from ._tables import FIT_NOTE as FIT_NOTE
from ._tables import fit_rows as fit_rows
from ._tables import fmu_rows as fmu_rows
from ._tables import loop_rows as loop_rows
from ._validation_page import VALIDATION_NOTE as VALIDATION_NOTE
from ._validation_page import validation_page as validation_page
