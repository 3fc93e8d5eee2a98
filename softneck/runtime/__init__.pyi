from ._block import Block as Block
from ._block import Port as Port
from ._block import State as State
from ._bundle import bundle as bundle
from ._compile import load_functions as load_functions
from ._compile import load_runtime as load_runtime

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._block import SteppedMixin as SteppedMixin
from ._bundle import ANY_SIZE as ANY_SIZE
from ._bundle import content_name as content_name
from ._bundle import layout_of as layout_of
from ._bundle import sized_name as sized_name
from ._bundle import split_members as split_members
from ._casadi_walk import step_function as step_function
from ._compile import COMPILE_OPTIONS as COMPILE_OPTIONS
from ._compile import cache_folder as cache_folder
from ._compile import compiled_name as compiled_name
from ._compile import have_numba as have_numba
from ._compile import load_around_step as load_around_step
from ._compile import load_linked as load_linked
from ._compile import load_tangent as load_tangent
from ._numba_cache import compile_without_failing_cache as compile_without_failing_cache
from ._numba_cache import numba_cache_name as numba_cache_name
from ._own import PREFIX as PREFIX
from ._own import OwnStep as OwnStep
from ._own import own_runtime as own_runtime
from ._tangent import with_tangent as with_tangent
from ._tangent_activity import TangentError as TangentError
