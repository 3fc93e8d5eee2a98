"""ecos, by its Python binding ecospy."""

import sys

import numpy as np
from ecospy import EcosSimulation, EcosSimulationStructure

fmu, job, out = sys.argv[1:4]
task = np.load(job)
names, outputs = task["names"].tolist(), task["outputs"].tolist()
booleans = set(task["booleans"].tolist())
with EcosSimulationStructure() as structure:
    structure.add_model("part", fmu)
    with EcosSimulation(structure=structure, step_size=float(task["step"])) as simulation:
        simulation.init()
        seen = []
        for row in task["inputs"]:
            for name, value in zip(names, row.tolist(), strict=True):
                if name in booleans:
                    simulation.set_bool(f"part::{name}", value > 0.5)
                else:
                    simulation.set_real(f"part::{name}", value)
            simulation.step()
            seen.append(
                [
                    float((simulation.get_bool if name in booleans else simulation.get_real)(f"part::{name}"))
                    for name in outputs
                ]
            )
np.save(out, np.array(seen))
