from ._demo import DemoSettings as DemoSettings
from ._demo import run_demo as run_demo
from ._project import project_page as project_page
from ._project import read_project as read_project
from ._reproduce import ReproduceSettings as ReproduceSettings
from ._reproduce import paper_page as paper_page
from ._reproduce import reproduce as reproduce
from ._study_page import study_page as study_page
from ._validation_page import validation_page as validation_page

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._demo import FIT_HEAD as FIT_HEAD
from ._demo import FIT_NOTE as FIT_NOTE
from ._demo import Demo as Demo
from ._demo import fit_rows as fit_rows
from ._demo import fmu_rows as fmu_rows
from ._demo import loop_rows as loop_rows
from ._project import Project as Project
from ._reproduce import LINEAR_HEAD as LINEAR_HEAD
from ._reproduce import PAPER_HEAD as PAPER_HEAD
from ._reproduce import PAPER_NOTE as PAPER_NOTE
from ._reproduce import group_entries as group_entries
from ._reproduce import linear_facts as linear_facts
from ._reproduce import linear_rows as linear_rows
from ._reproduce import paper_entries as paper_entries
from ._study_page import failures as failures
from ._study_page import study_head as study_head
from ._study_page import study_rows as study_rows
from ._tune import failing_requirement as failing_requirement
from ._tune import requirement_rows as requirement_rows
from ._tune import tune_notes as tune_notes
from ._tune import tune_verdict as tune_verdict
from ._tune import write_tuned as write_tuned
from ._validation_page import curves as curves
from ._validation_page import fit_table as fit_table
from ._validation_page import remarks as remarks
