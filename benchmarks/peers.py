"""Print peers and our kinds in one table: same rows, same split, each tuned by the free run on the last fifth of them.

`python benchmarks/peers.py [--data virtual payload arm] [--folder FOLDER] [--peers ...] [--ours ...] [--seeds 0]`

`virtual` is Eq. 22 on the virtual neck and its three tests, `payload` the lab's neck in closed loop (trained on 0 and
1000 g, tested on 400 g), `arm` its arm (read pitch); FOLDER holds these as for `hardware_fits.py`. SysIdentPy,
scikit-learn and jax-sysid run in environments of their own, which are made under build/peers: they need other versions
of numpy and jax than ours. `edmd` and `n4sid` need numpy alone. `mimo` is `rls` with one state space of all motors.
Peers are given set-points and outputs, as their own examples are.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path
from typing import Any

import numpy as np
from five_seeds import TESTS, recordings
from hardware_fits import arm, payload
from threadpoolctl import threadpool_limits

from softneck.core import KINDS, SoftneckError, resolve
from softneck.identification import WARM_UP, nrmse_fit
from softneck.signals import Recording

PACKAGES = {"frols": ["sysidentpy"], "mlp": ["scikit-learn"], "jax_sysid_nss": ["jax-sysid"], "edmd": [], "n4sid": []}
OURS: dict[str, tuple[str, dict[str, Any]]] = {
    "mimo": ("rls", {"structure": "mimo"}), "oe": ("oe", {}), "nlsm": ("nlsm", {"form": "residual"}),
    "play": ("play", {}), "greybox": ("greybox", {}), "nn": ("nn", {}),
}  # fmt: skip
HERE = Path(__file__).parent


def rows_of(data: str, folder: Path | None, seed: int) -> tuple[Recording, dict[str, Recording]]:
    """Return what to train on, and what to test on by name."""
    if data == "virtual":
        made = recordings("eq22", seed)
        return made["train"], {name: made[name] for name in ("validation", *TESTS)}
    if folder is None:
        raise SystemExit(f"--data {data} needs --folder")
    train, test = (arm if data == "arm" else payload)(folder)
    return train, {data: test}


def interpreter(peer: str) -> str:
    """Return the interpreter of a peer's environment, which is made where it is not there."""
    if not PACKAGES[peer]:
        return sys.executable
    folder = HERE.parent / "build" / "peers" / peer
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PACKAGES[peer]], check=True)
    return str(python)


def peer_runs(peer: str, train: Recording, tests: dict[str, Recording], seed: int) -> tuple[dict[str, Any], str]:
    """Return the free runs of a peer by test, and what it chose."""
    arrays = {}
    named = {"train": train, **tests}
    for name, recording in named.items():
        for number, run in enumerate(recording.runs(), start=1):
            arrays[f"u_{name}_{number}"], arrays[f"y_{name}_{number}"] = run.set_points, run.outputs
    with tempfile.TemporaryDirectory() as folder:
        data, result = Path(folder) / "data.npz", Path(folder) / "result.npz"
        np.savez(data, **arrays)
        # Ours are no packages of the peer's environment.
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        call = [interpreter(peer), HERE / "peers" / f"{peer}.py", data, result, str(seed)]
        done = subprocess.run(call, env=clean, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SoftneckError(f"failed: {done.stderr.strip().splitlines()[-1:]}")
        answer = np.load(result)
        free = {
            name: np.concatenate([answer[f"{name}_{n}"] for n in range(1, len(recording.runs()) + 1)])
            for name, recording in tests.items()
        }
        return free, str(answer["chosen"])


def our_runs(name: str, train: Recording, tests: dict[str, Recording], seed: int) -> tuple[dict[str, Any], str]:
    """Return the free runs of a kind of ours with its defaults."""
    kind, given = OURS[name]
    settings = resolve(KINDS[kind].settings)
    seeded = {"seed": seed} if "seed" in settings.__dataclass_fields__ else {}
    model = settings(**given, **seeded).fit(train)
    return {name: model.simulate(test)[:, : test.outputs.shape[1]] for name, test in tests.items()}, ""


def fits(test: Recording, free: np.ndarray) -> str:
    """Return the fits [%] of the outputs behind the warm-up of each run."""
    judged = np.concatenate([np.arange(len(run)) >= WARM_UP for run in test.runs()])
    return "/".join(f"{nrmse_fit(test.outputs[judged, i], free[judged, i]):.1f}" for i in range(free.shape[1]))


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", nargs="+", default=["virtual"], choices=["virtual", "payload", "arm"])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--peers", nargs="*", default=list(PACKAGES), choices=PACKAGES)
    parser.add_argument("--ours", nargs="*", default=list(OURS), choices=OURS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    wanted = parser.parse_args()
    for data in wanted.data:
        for seed in wanted.seeds:
            train, tests = rows_of(data, wanted.folder, seed)
            print(f"\n{data}, seed {seed}, {len(train)} rows: {', '.join(tests)}; fit in % of each output", flush=True)
            for name in (*wanted.peers, *wanted.ours):
                begin = time.perf_counter()
                try:
                    with threadpool_limits(1):
                        free, chosen = (peer_runs if name in PACKAGES else our_runs)(name, train, tests, seed)
                except SoftneckError as error:
                    print(f"{name:14} {error}", flush=True)
                    continue
                row = " ".join(f"{fits(test, free[what]):>12}" for what, test in tests.items())
                print(f"{name:14} {row}  {time.perf_counter() - begin:4.0f} s  {chosen}", flush=True)


if __name__ == "__main__":
    main()
