"""ecos, by its Python binding ecospy."""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.remove(sys.path[0])  # this folder: scripts have their masters' names
from ecospy import EcosSimulation

ssp, job, out = sys.argv[1:4]
task = json.loads(Path(job).read_text())
with EcosSimulation(ssp_path=ssp, step_size=task["step"]) as simulation:
    simulation.init(parameter_set="initialValues")

    def row():
        return [simulation.get_real(f"{part}::{name}") for part, name in task["signals"]]

    rows = [row()]
    for _ in range(task["rows"] - 1):
        simulation.step()
        rows.append(row())
np.save(out, np.array(rows))
