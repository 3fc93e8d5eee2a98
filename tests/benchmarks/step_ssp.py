"""Print the microseconds per step of an SSP file in another master: `step_ssp.py libcosim|ecos FILE.ssp STEPS`."""

import sys
import time

master, path, steps = sys.argv[1], sys.argv[2], int(sys.argv[3])
if master == "ecos":
    from ecospy import EcosSimulation

    with EcosSimulation(ssp_path=path, step_size=0.02) as simulation:
        simulation.init(parameter_set="initialValues")
        begin = time.perf_counter()
        simulation.step(steps)
        print("\nus_per_step", 1e6 * (time.perf_counter() - begin) / steps, flush=True)
else:
    from libcosimpy.CosimExecution import CosimExecution

    execution = CosimExecution.from_ssp_file(ssp_path=path, step_size=20_000_000)
    begin = time.perf_counter()
    execution.step(steps)
    print("\nus_per_step", 1e6 * (time.perf_counter() - begin) / steps, flush=True)
