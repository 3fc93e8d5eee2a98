"""Logs of one neck as hundreds of labs would write them: units, clocks, wraps, titles and formats, with the truth.

Nothing of softneck is used here: units and dates have tables of their own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

ROWS, SAMPLE_TIME = 400, 0.02
#: Radians of one unit. What a set-point or an angle can be.
ANGLES = {
    "rad": 1.0, "deg": np.pi / 180.0, "mrad": 1e-3, "turns": 2.0 * np.pi, "rev": 2.0 * np.pi, "gon": np.pi / 200.0,
    "grad": np.pi / 200.0, "cdeg": np.pi / 18000.0, "arcmin": np.pi / 10800.0,
}  # fmt: skip
#: Numbers of one radian in units that no angle has: such a column is refused, or doubted by the unit's name.
OTHERS = {"%": 20.0, "V": 1.5, "bar": 0.4, "mm": 7.5, "kPa": 40.0, "A": 0.8, "Nm": 0.1}
#: Seconds of one unit.
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
#: Titles: of a set-point (number, unit), of an angle (name, unit) and of the time (unit).
STYLES: dict[str, tuple[str, str, str]] = {
    "softneck": ("motor_setpoint_{0} [{1}]", "{0} [{1}]", "time [{0}]"),
    "round": ("cmd {0} ({1})", "{0} ({1})", "t ({0})"),
    "ending": ("ref_{0}_{1}", "{0}_{1}", "time_{0}"),
    "slash": ("setpoint {0} / {1}", "{0} / {1}", "time / {0}"),
}


@dataclass(frozen=True)
class Log:
    """One log.

    Attributes:
        name: of the case.
        suffix: of its file.
        write: writes it.
        set_points, angles: (rows, 3) and (rows, 2) [rad], as they were.
        sample_time: [s].
        positions: (rows, 3) of the motors [rad], if the log has them.
        named: what the message or the doubt must name, where the log cannot be taken as it is.
    """

    name: str
    suffix: str
    write: Callable[[Path], None]
    set_points: np.ndarray
    angles: np.ndarray
    sample_time: float = SAMPLE_TIME
    named: tuple[str, ...] = ()
    positions: np.ndarray | None = None


def neck(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return set-points (rows, 3) and angles (rows, 2) [rad] of a lag behind three tendons at 0, 120, 240 degrees."""
    rng = np.random.default_rng(seed)
    U = np.column_stack([np.repeat(rng.uniform(0.2, 3.0, ROWS // 20 + 1), 20)[7 * j : 7 * j + ROWS] for j in range(3)])
    angle = np.radians([0.0, 120.0, 240.0])
    T = np.array([np.cos(angle), np.sin(angle)]) * 2.0 / 3.0
    Y = np.zeros((ROWS, 2))
    for k in range(4, ROWS):
        Y[k] = 0.9 * Y[k - 1] + 0.1 * 0.15 * T @ U[k - 4]
    return U, Y + 5e-4 * rng.standard_normal(Y.shape)


def table(time: np.ndarray | list[str] | None, U: np.ndarray, Y: np.ndarray, *, style: str = "softneck",
          motor: str = "rad", output: str = "deg", clock: str = "s") -> pd.DataFrame:  # fmt: skip
    """Return the columns under their titles, set-points and angles in the numbers that they have in the file."""
    command, angle, instant = STYLES[style]
    columns: dict[str, object] = {} if time is None else {instant.format(clock): time}
    columns |= {command.format(j + 1, motor): U[:, j] for j in range(3)}
    columns |= {angle.format(name, output): Y[:, i] for i, name in enumerate(("pitch", "roll"))}
    return pd.DataFrame(columns)


def as_csv(frame: pd.DataFrame, *, sep: str = ",", decimal: str = ",", titles: bool = True) -> Callable[[Path], None]:
    text = frame.to_csv(sep=sep, decimal="." if sep == "," else decimal, index=False, header=titles,
                        float_format="%.10g")  # fmt: skip
    return as_text(text)


def as_text(text: str) -> Callable[[Path], None]:
    """Return what writes a text."""

    def write(path: Path) -> None:
        path.write_text(text, encoding="utf-8")

    return write


def units() -> Iterator[Log]:
    """Yield every unit of set-points and of angles under every style of titles."""
    U, Y = neck()
    t = np.arange(ROWS) * SAMPLE_TIME
    for style in STYLES:
        for motor, size in ANGLES.items():
            frame = table(t, U / size, Y / ANGLES["deg"], style=style, motor=motor)
            yield Log(f"set-points in {motor}, {style}", ".csv", as_csv(frame), U, Y)
        for output, size in ANGLES.items():
            frame = table(t, U, Y / size, style=style, output=output)
            yield Log(f"angles in {output}, {style}", ".csv", as_csv(frame), U, Y)
        for unit, number in OTHERS.items():
            if style == "ending" and unit == "%":
                continue
            frame = table(t, U * number, Y / ANGLES["deg"], style=style, motor=unit)
            yield Log(f"set-points in {unit}, {style}", ".csv", as_csv(frame), U, Y, named=(unit,))
            frame = table(t, U, Y * number, style=style, output=unit)
            yield Log(f"angles in {unit}, {style}", ".csv", as_csv(frame), U, Y, named=(unit,))


def clocks() -> Iterator[Log]:
    """Yield every unit of time, titles that are wrong, dates, uneven and coarse clocks, under every style of titles."""
    U, Y = neck()
    deg = Y / ANGLES["deg"]
    for Ts in (0.001, 0.02, 0.5):
        t = np.arange(ROWS) * Ts
        for style in STYLES:
            for unit, size in TIMES.items():
                if unit == "ns" and Ts > 0.02:
                    continue
                frame = table(t / size, U, deg, style=style, clock=unit)
                yield Log(f"time in {unit}, {Ts:g} s, {style}", ".csv", as_csv(frame), U, Y, Ts)
    t = np.arange(ROWS) * SAMPLE_TIME
    for style in STYLES:
        for title, real in (("ms", "s"), ("s", "ms"), ("us", "s"), ("s", "us"), ("min", "s")):
            frame = table(t / TIMES[real], U, deg, style=style, clock=title)
            yield Log(f"time in {real} under [{title}], {style}", ".csv", as_csv(frame), U, Y, named=("title",))
    texts = {
        "HH:MM:SS:mmm": [f"09:{int(x // 60):02d}:{int(x + 1e-9) % 60:02d}:{round(1e3 * x) % 1000:03d}" for x in t],
        "mm:ss.mmm": [f"{int(x // 60):02d}:{x % 60:06.3f}" for x in t],
        "HH:MM:SS.mmm": [f"10:{int(x // 60):02d}:{x % 60:06.3f}" for x in t],
    }  # fmt: skip
    for name, stamps in texts.items():
        yield Log(f"clock {name}", ".csv", as_csv(table(stamps, U, deg, clock=name)), U, Y)
    whole = table(t, U, deg)
    days = whole.rename(columns={"time [s]": "datenum"})
    days["datenum"] = 739_000.25 + t / 86400.0
    text = days.to_csv(index=False, float_format="%.12g")
    yield Log("datenum", ".csv", as_text(text), U, Y)
    step = whole.rename(columns={"time [s]": "dt"})
    step["dt"] = SAMPLE_TIME
    yield Log("a column dt", ".csv", as_csv(step), U, Y)
    stamps = pd.DataFrame(
        {"sec": 1_700_000_000 + (t // 1.0).astype(int), "nanosec": np.round(1e9 * (t % 1.0)).astype(int)}
    )
    split = pd.concat([stamps, whole.drop(columns="time [s]")], axis=1)
    for titles in (True, False):
        yield Log(f"seconds and nanoseconds, {'titled' if titles else 'untitled'}", ".csv",
                  as_csv(split, titles=titles), U, Y)  # fmt: skip
    coarse = whole.rename(columns={"time [s]": "time"})
    coarse["time"] = np.floor(t).astype(int)
    yield Log("whole seconds of 50 rows each", ".csv", as_csv(coarse), U, Y)
    for count in (20, 100):
        slow = np.arange(ROWS) / count
        coarse = whole.rename(columns={"time [s]": "time [s]"}).assign(**{"time [s]": np.floor(slow).astype(int)})
        yield Log(f"whole seconds of {count} rows each, [s]", ".csv", as_csv(coarse), U, Y, 1.0 / count)
    for unit, size in (("ms", 1e-3), ("s", 1.0)):
        step = whole.drop(columns="time [s]").assign(**{f"dt [{unit}]": SAMPLE_TIME / size})
        yield Log(f"a column dt [{unit}]", ".csv", as_csv(step), U, Y)
    sheet = whole.rename(columns={"time [s]": "time"}).assign(time=45_000.25 + t / 86400.0)
    yield Log("days of a spreadsheet", ".csv", as_text(sheet.to_csv(index=False, float_format="%.17g")), U, Y)
    uneven = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, ROWS)) * SAMPLE_TIME
    yield Log("an uneven clock without titles", ".csv",
              as_csv(whole.assign(**{"time [s]": uneven}), titles=False), U, Y, named=("uneven",))  # fmt: skip
    double = whole.copy()
    double.loc[200, "time [s]"] = double.loc[199, "time [s]"]
    yield Log("a double stamp", ".csv", as_csv(double), U, Y)


def wraps() -> Iterator[Log]:
    """Yield angles around a place where they jump by a turn."""
    U, Y = neck()
    t = np.arange(ROWS) * SAMPLE_TIME
    for unit, turn in (("deg", 360.0), ("rad", 2.0 * np.pi)):
        for name, low in (("at half a turn", -0.5 * turn), ("at a whole turn", 0.0)):
            for i, output in enumerate(("pitch", "roll")):
                numbers = Y / ANGLES[unit]
                numbers[:, i] = (numbers[:, i] + (low + turn) - low) % turn + low
                for style in ("softneck", "round"):
                    frame = table(t, U, numbers, style=style, output=unit)
                    yield Log(f"{output} in {unit} wraps {name}, {style}", ".csv", as_csv(frame), U, Y)
    # Encoders of one turn, in many units, beside set-points of any number of turns.
    lagged = U.copy()
    for k in range(1, ROWS):
        lagged[k] = lagged[k - 1] + 0.3 * (U[k] - lagged[k - 1])
    for offset, turns in ((0.0, 1.0), (2.0, 1.2), (-5.9, 1.9)):
        for unit, size in ANGLES.items():
            asked, reached = offset + turns * U, offset + turns * lagged
            frame = table(t, asked / size, Y / ANGLES["deg"], motor=unit)
            for j in range(3):
                frame[f"motor_position_{j + 1} [{unit}]"] = (reached[:, j] % (2.0 * np.pi)) / size
            yield Log(f"encoders of a turn in {unit}, about {offset:g}", ".csv", as_csv(frame), asked, Y,
                      positions=reached)  # fmt: skip


def encoders() -> Iterator[Log]:
    """Yield logs with positions that follow their set-points and wrap within a turn."""
    U, Y = neck()
    t = np.arange(ROWS) * SAMPLE_TIME
    P = np.zeros_like(U)
    P[0] = U[0]
    for k in range(1, ROWS):
        P[k] = P[k - 1] + 0.3 * (U[k - 1] - P[k - 1])
    for unit, turn in (("deg", 360.0), ("rad", 2.0 * np.pi), ("turns", 1.0)):
        for low in (0.0, -0.5):
            whole = (2.0 * P / ANGLES[unit] - low * turn) % turn + low * turn
            frame = table(t, 2.0 * U / ANGLES[unit], Y / ANGLES["deg"], motor=unit)
            for j in range(3):
                frame[f"motor_position_{j + 1} [{unit}]"] = whole[:, j]
            yield Log(f"encoders in {unit} from {low} turns", ".csv", as_csv(frame), 2.0 * U, Y)


def formats() -> Iterator[Log]:
    """Yield one log in many formats."""
    U, Y = neck()
    t = np.arange(ROWS) * SAMPLE_TIME
    frame = table(t, U, Y / ANGLES["deg"])
    for sep, decimal in ((",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")):
        yield Log(f"separator {sep!r}, decimal {decimal!r}", ".csv", as_csv(frame, sep=sep, decimal=decimal), U, Y)
    rows = frame.to_dict(orient="records")
    yield Log("JSON lines", ".jsonl", as_text("\n".join(map(json.dumps, rows))), U, Y,
              named=("JSON",))  # fmt: skip
    long = frame.melt(id_vars="time [s]", var_name="name").sort_values("time [s]", kind="stable")
    yield Log("long form", ".csv", as_csv(long), U, Y, named=("long", "pivot"))
    arrays = {"t": t, "u": U, "pitch": Y[:, 0], "roll": Y[:, 1]}
    yield Log(
        "npz",
        ".npz",
        lambda path: np.savez(path, t=arrays["t"], u=arrays["u"], pitch=arrays["pitch"], roll=arrays["roll"]),
        U,
        Y,
    )
    matrix = frame.to_numpy()
    yield Log("npy", ".npy", lambda path: np.save(path, matrix), U, Y)
    yield Log("wider than long", ".csv", as_csv(pd.DataFrame(matrix.T), titles=False), U, Y, named=("transpose",))
    units_in_cells = frame.map(lambda x: f"{x:.8g}")
    units_in_cells.iloc[:, 1:4] = units_in_cells.iloc[:, 1:4] + " rad"
    yield Log("units in cells", ".csv", as_csv(units_in_cells), U, Y, named=("rad",))
    yield Log("spreadsheet", ".xlsx", lambda path: frame.to_excel(path, index=False), U, Y)
    yield Log("LabVIEW", ".lvm", _labview(frame), U, Y)
    yield Log("LabVIEW without times", ".lvm", _labview(frame, times=False), U, Y)
    nested = [
        {"stamp": row["time [s]"], "cmd": list(u), "imu": {name: row[name] for name in ("pitch [deg]", "roll [deg]")}}
        for row, u in zip(rows, U.tolist(), strict=True)
    ]
    yield Log("nested JSON lines", ".ndjson", as_text("\n".join(map(json.dumps, nested))), U, Y)
    yield Log("JSON list", ".json", as_text(json.dumps(rows)), U, Y)
    lists = frame.drop(columns=[f"motor_setpoint_{j} [rad]" for j in (1, 2, 3)])
    lists["command"] = [json.dumps([round(x, 8) for x in row]) for row in U.tolist()]
    yield Log("lists in cells", ".csv", as_csv(lists), U, Y)
    for mark, decimal, sep in ((",", ".", ";"), (".", ",", ";")):
        grouped = pd.DataFrame({name: [f"{x:.6f}".replace(".", decimal) for x in frame[name]] for name in frame})
        cells = [f"{x:,.3f}".translate(str.maketrans(",.", mark + decimal)) for x in 1e3 * t]
        grouped.insert(0, "time [ms]", cells)
        yield Log(f"thousands by {mark!r}", ".csv", as_csv(grouped.drop(columns="time [s]"), sep=sep), U, Y)
    can = "\n".join(f"({1e9 + x:.6f}) can0 181#0011223344556677" for x in t)
    yield Log("candump", ".log", as_text(can), U, Y, named=("CAN",))
    yield Log("TDMS", ".tdms", _tdms, U, Y, named=("TDMS",))


def _tdms(path: Path) -> None:
    path.write_bytes(b"TDSm" + bytes(600))


def _labview(frame: pd.DataFrame, *, times: bool = True) -> Callable[[Path], None]:
    """Return what writes a measurement file of LabVIEW: two headers, tabs, decimal commas."""
    head = ["LabVIEW Measurement", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,", "Multi_Headings\tNo",
            "X_Columns\tOne", "***End_of_Header***", "", f"Channels\t{frame.shape[1] - 1}", f"Samples\t{ROWS}",
            "***End_of_Header***"]  # fmt: skip
    titles = "\t".join(["X_Value", *frame.columns[1:], "Comment"])
    if not times:
        head[5] = "X_Columns\tNo"
        head.insert(-1, f"Delta_X\t{SAMPLE_TIME:.6f}\t{SAMPLE_TIME:.6f}".replace(".", ","))
    rows = [[f"{x:.6f}".replace(".", ",") for x in row] for row in frame.to_numpy()]
    body = "\n".join("\t".join(row if times else ["", *row[1:]]) for row in rows)
    return as_text("\n".join([*head, titles, body, ""]))


def logs() -> Iterator[Log]:
    """Yield all logs."""
    for make in (units, clocks, wraps, encoders, formats):
        yield from make()
