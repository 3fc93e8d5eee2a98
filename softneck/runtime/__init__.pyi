from ._block import Block as Block
from ._block import Port as Port
from ._block import State as State
from ._bundle import bundle as bundle
from ._compile import load_functions as load_functions
from ._compile import load_runtime as load_runtime
