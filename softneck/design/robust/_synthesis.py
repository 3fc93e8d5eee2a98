"""Names of the field on `control` systems: `mixsyn`, `hinfsyn`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, require_between

from ._riccati import least_gamma, partition, solve_at
from ._weights import to_continuous, to_discrete, weight_image

if TYPE_CHECKING:
    import control


# The optimal controller has a pole near infinity (3e9 rad/s); a little above gamma it is an ordinary one.
_ABOVE = 1.05
# |T_zw| found on a grid may exceed gamma by rounding of the synthesis, not more.
_SLACK = 1e-3
# A weight below this at infinity counts as strictly proper.
_LEAST_DIRECT = 1e-9


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Synthesis:
    """A controller and what it was found to do.

    Attributes:
        controller: K for negative feedback, `u = K (r - y)`, with the plant's dt and names.
        gamma: the least possible norm.
        achieved: the norm with this controller, on a grid of frequencies.
    """

    controller: control.StateSpace
    gamma: float
    achieved: float


def mixsyn(
    G: Any,
    W1: Any = None,
    W2: Any = None,
    W3: Any = None,
    *,
    above: float = _ABOVE,
) -> Synthesis:
    """Return the controller that keeps `|W1 S; W2 K S; W3 T|` small (Skogestad and Postlethwaite 2005, sec. 9.3.6).

    Args:
        G: plant of any number of inputs and outputs; a discrete one, dead time as poles at zero, is taken exactly
            through the bilinear map.
        W1, W2, W3: None, numbers or stable systems, continuous or of the plant's dt: of as many inputs as the plant
            has outputs (W1, W3) or inputs (W2), or scalar ones, which weigh each of the signals alike. Continuous
            weights of a discrete plant act at `2/Ts tan(w Ts/2)`.
        above: the controller is built at this factor above the least gamma.

    Raises:
        SettingsError: no weight, one that cannot be solved for, another dt, or no controller.
    """
    dt = _dt_of(G)
    outputs, inputs = G.noutputs, G.ninputs
    sized = (("W1", W1, outputs), ("W2", W2, inputs), ("W3", W3, outputs))
    weights = [weight_image(W, dt, name, size) for name, W, size in sized]
    if all(W is None for W in weights):
        raise SettingsError("`mixsyn` needs at least one weight.")
    if not any(W is not None and np.abs(np.asarray(W.D)).max() > _LEAST_DIRECT for W in weights[1:]):
        raise SettingsError(
            "the control effort is not weighted at high frequencies (D12 has not full rank), where the search for a "
            "controller hangs: give W2 a gain there, a number for example, or a W3 with as many zeros as poles."
        )
    found = hinfsyn(_augmented(to_continuous(G), weights), outputs, inputs, above=above)
    K = to_discrete(found.controller, dt) if dt else found.controller
    return Synthesis(controller=_named(K, G, dt), gamma=found.gamma, achieved=found.achieved)


def hinfsyn(P: Any, nmeas: int, ncon: int, *, above: float = _ABOVE) -> Synthesis:
    """Return the H-infinity controller of the generalised plant P, built at `above` times the least gamma.

    What makes the search hang is refused (D12 or D21 of less than full rank), and what comes out is verified: a stable
    loop and its norm. A discrete P gives a controller of its dt.

    Raises:
        SettingsError: as said, or no controller exists.
    """
    import control

    require_between("above", above, 1.001, 100.0)
    dt = _dt_of(P)
    image: Any = to_continuous(P)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (image.A, image.B, image.C, image.D))
    plant = partition(A, B, C, D, nmeas=nmeas, ncon=ncon)
    gamma = least_gamma(plant)
    parts = solve_at(plant, above * gamma)
    if parts is None:
        raise SettingsError(f"no controller at {above:g} times gamma {gamma:.4g}; scale the weights.")
    K = control.StateSpace(*parts, 0)
    closed: Any = image.lft(K)
    return Synthesis(
        controller=to_discrete(K, dt) if dt else K,
        gamma=gamma,
        achieved=_verified(closed, above * gamma),
    )


def _augmented(G: Any, weights: list[Any]) -> control.StateSpace:
    """Return P from (r, u) to (W1 e, W2 u, W3 y, e) with e = r - G u (python-control's `augw`, which warns)."""
    import control

    n, ny, nu = G.nstates, G.noutputs, G.ninputs
    one = control.StateSpace([], [], [], np.eye(ny), 0)
    blocks = [(W, part) for W, part in zip(weights, ("e", "u", "y"), strict=True) if W is not None]
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (G.A, G.B, G.C, G.D))
    rows = {
        "e": (-C, np.hstack([np.eye(ny), -D])),
        "u": (np.zeros((nu, n)), np.hstack([np.zeros((nu, ny)), np.eye(nu)])),
        "y": (C, np.hstack([np.zeros((ny, ny)), D])),
    }
    states, inputs = A, np.hstack([np.zeros((n, ny)), B])
    outputs, direct = [], []
    for W, part in [*blocks, (one, "e")]:
        before = states.shape[0]
        row, gain = rows[part]
        row = np.hstack([row, np.zeros((len(row), before - row.shape[1]))])
        Aw, Bw, Cw, Dw = (np.asarray(item, dtype=np.float64) for item in (W.A, W.B, W.C, W.D))
        states = np.block([[states, np.zeros((before, Aw.shape[0]))], [Bw @ row, Aw]])
        inputs = np.vstack([inputs, Bw @ gain])
        outputs.append(np.hstack([Dw @ row, Cw]))
        direct.append(Dw @ gain)
    wide = [np.hstack([row, np.zeros((len(row), states.shape[0] - row.shape[1]))]) for row in outputs]
    return control.StateSpace(states, inputs, np.vstack(wide), np.vstack(direct), 0)


def _verified(closed: Any, bound: float) -> float:
    """Return the norm of the closed loop on a grid; raise where it is not stable or beyond `bound`."""
    largest = float(np.max(np.linalg.eigvals(np.asarray(closed.A)).real, initial=-np.inf))
    if largest >= 0.0:
        raise SettingsError(
            f"the result is not stable (a pole at {largest:.3g} rad/s): the problem is near singular. Weigh the "
            "control effort more (W2), or build further `above` gamma."
        )
    response = np.moveaxis(np.asarray(closed(1j * np.geomspace(1e-4, 1e5, 400), squeeze=False)), -1, 0)
    size = float(np.linalg.norm(response, 2, axis=(1, 2)).max())
    if size > (1.0 + _SLACK) * bound:
        raise SettingsError(f"the result has a norm of {size:.4g}, beyond {bound:.4g}: scale the weights.")
    return size


def _dt_of(system: Any) -> float:
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction):
        raise SettingsError(f"a control.StateSpace or TransferFunction is needed; got {type(system).__name__}.")
    if system.dt is None or system.dt is True:
        raise SettingsError("the system must say its sample time: give it dt = 0 (continuous) or dt in seconds.")
    return float(system.dt)


def _named(K: Any, G: Any, dt: float) -> control.StateSpace:
    """Return K, from the plant's outputs to its inputs by name."""
    import control

    parts: list[Matrix] = [np.asarray(part) for part in (K.A, K.B, K.C, K.D)]
    return control.StateSpace(*parts, dt, inputs=list(G.output_labels), outputs=list(G.input_labels))
