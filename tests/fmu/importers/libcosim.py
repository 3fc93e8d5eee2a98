"""libcosim (Open Simulation Platform), by its Python binding libcosimpy."""

import sys

import numpy as np
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

fmu, job, out = sys.argv[1:4]
task = np.load(job)
names, outputs = task["names"].tolist(), task["outputs"].tolist()
booleans = set(task["booleans"].tolist())
execution = CosimExecution.from_step_size(round(float(task["step"]) * 1e9))
slave = execution.add_local_slave(CosimLocalSlave(fmu_path=fmu, instance_name="part"))
reference = {variable.name.decode(): variable.reference for variable in execution.slave_variables(slave)}
manipulator, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
execution.add_manipulator(manipulator)
execution.add_observer(observer)
kinds = [[name for name in names if (name in booleans) is flag] for flag in (False, True)]
seen = []
for row in task["inputs"]:
    value = dict(zip(names, row.tolist(), strict=True))
    reals, flags = kinds
    if reals:
        manipulator.slave_real_values(slave, [reference[n] for n in reals], [value[n] for n in reals])
    if flags:
        manipulator.slave_boolean_values(slave, [reference[n] for n in flags], [value[n] > 0.5 for n in flags])
    execution.step()
    seen.append(
        [
            float(
                (observer.last_boolean_values if n in booleans else observer.last_real_values)(slave, [reference[n]])[0]
            )
            for n in outputs
        ]
    )
np.save(out, np.array(seen))
