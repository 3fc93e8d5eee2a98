"""PathSim with its FMI toolbox: sources, the FMU as a block, and a scope, connected by name."""

import sys

import numpy as np

sys.path.remove(sys.path[0])  # this folder: the script has the importer's name
from pathsim import Connection, Simulation
from pathsim.blocks import Scope, Source
from pathsim.solvers import EUF
from pathsim_fmi import CoSimulationFMU

fmu, job, out = sys.argv[1:4]
task = np.load(job)
step, inputs, names = float(task["step"]), task["inputs"], task["names"].tolist()
# Its ports are all real: it sets Booleans as 0.0 and 1.0, which our FMUs take, and cannot read them.
outputs = [name for name in task["outputs"].tolist() if name not in set(task["booleans"].tolist())]
part = CoSimulationFMU(fmu, dt=step)


def signal(column):
    return lambda t: float(inputs[min(int(t / step + 1e-6), len(inputs) - 1), column])


sources = [Source(signal(column)) for column in range(len(names))]
scope = Scope(labels=outputs)
connections = [Connection(source, part[name]) for source, name in zip(sources, names, strict=True)]
connections += [Connection(part[name], scope[index]) for index, name in enumerate(outputs)]
simulation = Simulation([part, *sources, scope], connections, dt=step, Solver=EUF, log=False)  # pyright: ignore[reportArgumentType]
simulation.run(step * (len(inputs) - 1), adaptive=False)  # pyright: ignore[reportArgumentType]
np.save(out, np.array(scope.read()[1]).T)
