"""Models of the neck from recordings, judged honestly."""

from ._drive import DriveModel as DriveModel
from ._drive import fit_drive as fit_drive
from ._ensemble import Ensemble as Ensemble
from ._ensemble import combine as combine
from ._gamma import GammaCurve as GammaCurve
from ._gamma import gamma_curve as gamma_curve
from ._gamma import offending_pair as offending_pair
from ._greybox import GreyBox as GreyBox
from ._linear import continuous_parameters as continuous_parameters
from ._model import WARM_UP as WARM_UP
from ._model import Model as Model
from ._model import load_model as load_model
from ._network import Network as Network
from ._play import Play as Play
from ._regressors import PAPER_EQ21 as PAPER_EQ21
from ._residual_any import Residual as Residual
from ._rls import Rls as Rls
from ._rows import row_hashes as row_hashes
from ._scores import nrmse_fit as nrmse_fit
from ._scores import rmse as rmse
from ._set_membership import SetMembership as SetMembership
from ._set_membership import noise_level as noise_level
from ._validation import INFINITE as INFINITE
from ._validation import Validation as Validation
from ._validation import validate as validate
