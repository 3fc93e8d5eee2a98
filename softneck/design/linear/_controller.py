"""The linear controller of all axes: the law of one axis, its arrays, and the controller in loops, FMUs and files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, Vector, atomic_write, require_header, to_si, write_archive
from softneck.identification import redefined_input
from softneck.robot import Robot
from softneck.runtime import Block, SteppedMixin, sized_name

from ..plants._uncertain import sampling_line
from ._linear_parts_runtime import LinearArrays
from ._ports import ControllerLimits, controller_inputs, controller_outputs

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisController:
    """`v = C x + Dr r + Dy y`, `x+ = A x + Br r + By y` of one axis, with the gain of its conditioning.

    Attributes:
        A: (n, n).
        Br, By: (n, 1) from reference and angle.
        C: (1, n).
        Dr, Dy: direct gains [rad/rad].
        L: (n, 1) gain on what the limits took away; None for Hanus' `Br / Dr`.
    """

    A: Matrix
    Br: Matrix
    By: Matrix
    C: Matrix
    Dr: float
    Dy: float
    L: Matrix | None = None

    def conditioning(self) -> Matrix:
        """Return L (n, 1).

        Raises SettingsError: no direct gain from the reference and no L given, or an unstable conditioned state.
        """
        if self.L is None and self.Dr == 0.0:
            raise SettingsError("a controller without direct gain from the reference needs `L` for its conditioning.")
        L = self.Br / self.Dr if self.L is None else self.L
        radius = float(np.abs(np.linalg.eigvals(self.A - L @ self.C)).max(initial=0.0))
        if radius >= 1.0:
            raise SettingsError(
                f"the conditioned controller would be unstable at its limits (spectral radius {radius:.3f}); "
                "give another `L` or a controller whose zeros from the reference are stable."
            )
        return L


@dataclass(frozen=True, slots=True)
class ReferenceFilter:
    """The reference filter `(1 + T1 s)/(1 + T2 s)`, without a sample of delay.

    `time`: T2 [s]; 0 for none. `lead`: T1 [s].
    """

    time: float
    lead: float = 0.0

    def pole(self, sample_time: float) -> float:
        """Return a of `rf+ = a rf + (1 - a) r`."""
        return math.exp(-sample_time / self.time) if self.time > 0.0 else 0.0

    @property
    def jump(self) -> float:
        """T1/T2, the part of a step that passes the filter at once."""
        return self.lead / self.time if self.time > 0.0 else 0.0


def pi_axis(gain: float, integral_time: float, sample_time: float) -> AxisController:
    """Return `v = K (e + s)`, `s+ = s + Ts/Ti e` with e = r - y.

    `gain`: K [rad/rad]. `integral_time`: Ti [s]. `sample_time`: Ts [s].
    """
    one = np.eye(1)
    rate = sample_time / integral_time
    return AxisController(A=one, Br=rate * one, By=-rate * one, C=gain * one, Dr=gain, Dy=-gain)


def assemble(
    axes: Sequence[AxisController],
    *,
    filters: Sequence[ReferenceFilter],
    redefinition: tuple[Matrix, Matrix],
    constants: Vector,
) -> tuple[Matrix, ...]:
    """Return the arrays of `LinearArrays`.

    `axes`: controllers of all axes: of pitch and roll. `filters`: of the references of all axes and of co-contraction.
    `redefinition`: T (axes + 1, motors) and its inverse. `constants`: of the runtime, the sample time [s] first.
    """
    from scipy.linalg import block_diag

    A, Br, By, C, L = (
        np.asarray(block_diag(*parts), dtype=np.float64)
        for parts in (
            [axis.A for axis in axes],
            [axis.Br for axis in axes],
            [axis.By for axis in axes],
            [axis.C for axis in axes],
            [axis.conditioning() for axis in axes],
        )
    )
    Dr, Dy = np.diag([axis.Dr for axis in axes]), np.diag([axis.Dy for axis in axes])
    return assemble_law((A, Br, By, C, Dr, Dy, L), filters=filters, redefinition=redefinition, constants=constants)


def assemble_law(
    law: tuple[Matrix, ...],
    *,
    filters: Sequence[ReferenceFilter],
    redefinition: tuple[Matrix, Matrix],
    constants: Vector,
) -> tuple[Matrix, ...]:
    """Return the arrays of `LinearArrays` for one controller of all axes: A, Br, By, C, Dr, Dy and L.

    The rest is as in `assemble`.
    """
    A, Br, By, C, Dr, Dy, L = law
    sample_time = float(constants[0])
    a = np.array([item.pole(sample_time) for item in filters])
    # rf_k = x_k + d r_k with x = a (1 - jump) at rest under r = 1: without lead rf_k = a rf_k-1 + (1 - a) r_k.
    held = a * (1.0 - np.array([item.jump for item in filters]))
    Af, Bf, Cf, Df = np.diag(a), np.diag(held * (1.0 - a)), np.eye(a.size), np.diag(1.0 - held)
    align = _alignment(A, Br + By, C, Dr + Dy)
    # The filter's state at rest, where rf = r.
    rest = np.diag(held)
    return (Af, Bf, Cf, Df, A, Br, By, C, Dr, Dy, L, align, rest, *redefinition, constants)


def _alignment(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Matrix:
    """Return M (n, 2 axes) with x = M (y, v): the state nearest to rest under r = y that gives exactly v.

    x minimises |(I - A) x - B y| subject to C x = v - D y, by its Lagrange conditions.
    """
    n = A.shape[0]
    E = np.eye(n) - A
    top = np.hstack([E.T @ E, C.T])
    m = C.shape[0]
    bottom = np.hstack([C, np.zeros((m, m))])
    right = np.block([[E.T @ B, np.zeros((n, m))], [-D, np.eye(m)]])
    return np.linalg.lstsq(np.vstack([top, bottom]), right, rcond=None)[0][:n]


_RUNTIME_MODULE = "softneck.design.linear._linear_controller_runtime"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class LinearController(SteppedMixin, ReprMixin):
    """A designed controller of all outputs with reference filter, limits, conditioning and allocation.

    Attributes:
        kind: name in the table of kinds.
        sample_time: [s].
        arrays: those of `LinearArrays`.
        limits: of the set-points.
        order: of the loop it is for.
        design: JSON values: the settings, gains and margins by axis, for `summary` and the header.
    """

    kind: str
    sample_time: float
    arrays: tuple[Matrix, ...]
    limits: ControllerLimits
    order: str
    design: Mapping[str, Any]

    @property
    def robot(self) -> Robot:
        """Whose controller it is."""
        return self.limits.robot

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return Block(
            kind=self.kind,
            role="controller",
            runtime=sized_name(_RUNTIME_MODULE, len(self.robot.motors.names), len(self.robot.outputs.names)),
            sample_time=self.sample_time,
            arrays=self.arrays,
            inputs=controller_inputs(self.robot),
            outputs=controller_outputs(self.robot),
            parameters=self.limits.ports(),
        )

    def ss(self) -> control.StateSpace:
        """Return it without limits, from (pitch_reference, roll_reference, pitch, roll) to (theta_i, phi_i)."""
        import control

        p = LinearArrays(self.arrays)
        names = self.robot.outputs.names
        m = len(names)
        Af, Bf, Cf, Df = p.Af[:m, :m], p.Bf[:m, :m], p.Cf[:m, :m], p.Df[:m, :m]
        states = np.block([[Af, np.zeros((m, len(p.A)))], [p.Br @ Cf, p.A]])
        inputs = np.block([[Bf, np.zeros((m, m))], [p.Br @ Df, p.By]])
        return control.StateSpace(
            states,
            inputs,
            np.hstack([p.Dr @ Cf, p.C]),
            np.hstack([p.Dr @ Df, p.Dy]),
            self.sample_time,
            inputs=[*(f"{name}_reference" for name in names), *names],
            outputs=[redefined_input(self.robot, name) for name in names],
            name=self.kind,
        )

    def to_mat(self, path: str | Path, *, force: bool = False) -> None:
        """Write `ss()` to a MATLAB file: A, B, C, D, Ts, InputName, OutputName."""
        from scipy.io import savemat

        system = self.ss()
        values = {
            "A": system.A, "B": system.B, "C": system.C, "D": system.D, "Ts": self.sample_time,
            "InputName": np.array(system.input_labels, dtype=object),
            "OutputName": np.array(system.output_labels, dtype=object),
        }  # fmt: skip
        with atomic_write(path, force=force) as temporary, temporary.open("wb") as file:
            savemat(file, values)

    def summary(self) -> str:
        """Return some lines for people."""
        lines = [
            f"{self.kind} controller, {self.sample_time * 1e3:g} ms, {self.order} order, "
            f"{self.design.get('extra_delay', 0)} samples of delay added to the plant for it",
            *self.limits.lines(self.sample_time),
            *sampling_line(self.design),
            *assumed_lines(self.design.get("assumed", {})),
        ]
        for axis in self.robot.outputs.names:
            item = self.design.get(axis, {})
            gains = ", ".join(self._gain(name, value) for name, value in item.get("gains", {}).items())
            lines.append(f"  {axis}: {gains}; designed for a dead time of {1e3 * item.get('dead_time_s', 0.0):g} ms")
            lines += _findings(item)
            if "margins_family" in item:
                lines.append(f"    worst of its {item['family']} plants: {_margins(item['margins_family'])}")
                lines += _band_lines(item)
            for title, key in (("", "margins"), (", small moves", "margins_small_moves")):
                if key in item and (key == "margins" or item[key] != item.get("margins")):
                    lines.append(f"    nominal model only{title}: {_margins(item[key])}")
        return "\n".join(lines)

    def _gain(self, name: str, value: float) -> str:
        """Return a gain as text; K in the units of the robot's file."""
        motors, outputs = self.robot.motors.unit, self.robot.outputs.unit
        if name != "K":
            return f"{name} {value:.4g}"
        return f"K {value * to_si(outputs)[0] / to_si(motors)[0]:.4g} {motors}/{outputs}"

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller to one `.npz` file."""
        header = {
            **self.block().in_header(),
            **self.limits.header(),
            "order": self.order,
            "design": dict(self.design),
            **self.robot.in_header(),
        }
        write_archive(path, header, dict(zip(LinearArrays.names(), self.arrays, strict=True)), force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> LinearController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        robot = robot_in(header)
        require_header(header, {"design": design_schema(robot)})
        return cls(
            kind=str(header["kind"]),
            sample_time=float(header["sample_time"]),
            arrays=tuple(LinearArrays.read(arrays).values()),
            limits=ControllerLimits.from_header(header, robot),
            order=str(header["order"]),
            design=dict(header["design"]),
        )


def design_schema(robot: Robot) -> dict[str, Any]:
    """Return the types of `design` in a header, as far as a summary reads it (see `require_header`)."""
    margins = {str: (float, None)}
    axis = {
        "gains": {str: float}, "dead_time_s": float, "margins": margins, "margins_small_moves": margins,
        "samples": int, "samples_unstable": int, "worst_sensitivity": (float, None), "gamma": float, "remark": str,
    }  # fmt: skip
    settings = {"sample_time": (float, None)}
    common = {"extra_delay": int, "assumed": {str: float}, "held_s": (float, None), "settings": settings}
    return common | dict.fromkeys(robot.outputs.names, axis)


def robot_in(header: Mapping[str, Any]) -> Robot:
    """Return the robot of a file's header; the neck if it names none."""
    return Robot.from_dict(header["robot"]) if "robot" in header else Robot.preset("neck")


def assumed_lines(values: Mapping[str, float]) -> list[str]:
    """Return a line on the values assumed from the paper's neck, if any."""
    words = {"least_delay": "a dead time of at least {:g} s", "small_move_pole": "small moves as fast as {:g} 1/s",
             "taut_pole": "a neck with taut tendons as fast as {:g} 1/s"}  # fmt: skip
    told = [words[name].format(value) for name, value in values.items()]
    return [f"  of the paper's neck, not of this plant: {' and '.join(told)}"] if told else []


def _findings(item: Mapping[str, Any]) -> list[str]:
    """Return a line on the samples that a design was verified on."""
    lines = []
    if item.get("samples", 1) > 1:
        worst, lost = item.get("worst_sensitivity"), item.get("samples_unstable", 0)
        held = f"stable on all {item['samples']} samples" if not lost else f"NOT stable on {lost} of {item['samples']}"
        lines.append(f"    {held}" + (f", worst Ms {worst:.3g}" if worst is not None else ""))
    if "remark" in item:
        lines.append(f"    {item['remark']}")
    if "gamma" in item:
        lines.append(f"    gamma {item['gamma']:.4g}")
    return lines


def _band_lines(item: Mapping[str, Any]) -> list[str]:
    """Return in words the band of the recordings, and whether the loop crosses above it."""
    if (band := item.get("band_rad_s")) is None:
        return ["    the band of its recordings is not known: `softneck family` finds it"]
    crossover = item["margins_family"].get("crossover")
    known = f"    its recordings support {band[0]:.3g} to {band[1]:.3g} rad/s"
    if crossover is None or crossover <= band[1]:
        return [known]
    return [f"{known}; the crossover is above: these margins are of the models alone"]


def _margins(values: Mapping[str, float | None]) -> str:
    """Return margins as text; None means infinity, which JSON lacks."""
    units = (("gain margin", "gain", 1.0, ""), ("phase margin", "phase", math.degrees(1.0), " deg"),
             ("Ms", "sensitivity", 1.0, ""), ("crossover", "crossover", 1.0, " rad/s"),
             ("delay margin", "delay", 1e3, " ms"))  # fmt: skip
    parts = []
    for title, key, factor, unit in units:
        value = values.get(key)
        parts.append(f"{title} inf" if value is None else f"{title} {factor * value:.3g}{unit}")
        if key == "gain" and values.get("gain_down"):
            parts.append(f"down {values['gain_down']:.3g}")
    return ", ".join(parts)
