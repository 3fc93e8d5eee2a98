"""libcosim (Open Simulation Platform), by its Python binding libcosimpy."""

import json
import sys
from pathlib import Path

import numpy as np
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver

ssp, job, out = sys.argv[1:4]
task = json.loads(Path(job).read_text())
execution = CosimExecution.from_ssp_file(ssp_path=ssp, step_size=round(task["step"] * 1e9))
observer = CosimObserver.create_last_value()
execution.add_observer(observer)
places = []
for part, name in task["signals"]:
    slave = int(execution.slave_index_from_instance_name(part) or 0)
    references = {variable.name.decode(): variable.reference for variable in execution.slave_variables(slave)}
    places.append((slave, references[name]))
rows = [[np.nan] * len(places)]  # before its first step this observer has nothing
for _ in range(task["rows"] - 1):
    execution.step()
    rows.append([observer.last_real_values(slave, [reference])[0] for slave, reference in places])
np.save(out, np.array(rows))
