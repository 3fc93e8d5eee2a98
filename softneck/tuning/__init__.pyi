from ._requirements import TuneRequirements as TuneRequirements
from ._requirements import make_tune_requirements as make_tune_requirements
from ._requirements import read_tune_requirements as read_tune_requirements
from ._tune import Tuned as Tuned
from ._tune import tune as tune
