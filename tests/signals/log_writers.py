"""Logs as other tools write them: each writer takes columns and leaves a file, and none is ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from scipy.io import savemat

from softneck.core import Vector

Columns = Mapping[str, Vector]
START = datetime(2026, 11, 23, 6, 28, 37, tzinfo=UTC)
#: The columns of a log under the names that German and Spanish labs give them.
GERMAN = {"t": "Zeit [s]", "s": "Sollwert Motor {} [Grad]", "x": "Istwert Motor {} [Grad]", "pitch": "Nickwinkel [°]",
          "roll": "Wankwinkel [°]"}  # fmt: skip
SPANISH = {"t": "tiempo [s]", "s": "consigna_{} (grados)", "x": "posición_{} (grados)", "pitch": "cabeceo (grados)",
           "roll": "alabeo (grados)"}  # fmt: skip


def titled(columns: Columns, words: Mapping[str, str]) -> dict[str, Vector]:
    """The columns t, s1.., x1.., pitch, roll under other titles."""
    return {words.get(name, words.get(name[0], name).format(name[-1])): values for name, values in columns.items()}


def write_text(path: Path, columns: Columns, *, encoding: str = "utf-8", sep: str = ";", decimal: str = ",") -> None:
    text = pd.DataFrame(columns).to_csv(sep=sep, decimal=decimal, index=False, float_format="%.17g")
    path.write_bytes(text.encode(encoding))


def write_sheet(path: Path, columns: Columns, *, dates: bool = False) -> None:
    """By openpyxl, behind a sheet of remarks."""
    frame = pd.DataFrame(columns)
    if dates:
        # Excel keeps days as a double: 20 ms are 2e-7 of one, and are read back to the microsecond.
        frame["t"] = [START.replace(tzinfo=None) + timedelta(seconds=round(t, 6)) for t in columns["t"]]
    with pd.ExcelWriter(path, engine="openpyxl") as book:
        pd.DataFrame({"remark": ["made by the lab"]}).to_excel(book, sheet_name="notes", index=False)
        frame.to_excel(book, sheet_name="log", index=False)


def write_dates(path: Path, columns: Columns, form: str) -> None:
    """CSV whose time is a date by `form`, microseconds behind it, or the seconds or nanoseconds since 1970."""
    moments = [START + timedelta(microseconds=round(1e6 * t)) for t in columns["t"]]
    match form:
        case "epoch":
            stamps: list[Any] = [f"{moment.timestamp():.6f}" for moment in moments]
        case "epoch_ns":
            stamps = [int(START.timestamp()) * 10**9 + round(1e9 * t) for t in columns["t"]]
        case "iso":
            stamps = [moment.isoformat() for moment in moments]
        case _:
            stamps = [moment.strftime(form) for moment in moments]
    frame = pd.DataFrame({**columns, "t": stamps}).rename(columns={"t": "time"})
    frame.to_csv(path, index=False, float_format="%.17g")


def by_kind(columns: Columns) -> dict[str, np.ndarray]:
    """Vectors, and matrices beside them: t, u (n, 3), q (n, 3), pitch, roll."""
    found = {"u": np.column_stack([columns[f"s{j}"] for j in (1, 2, 3)])}
    if "x1" in columns:
        found["q"] = np.column_stack([columns[f"x{j}"] for j in (1, 2, 3)])
    return {"t": columns["t"], **found, "pitch": columns["pitch"], "roll": columns["roll"]}


def write_mat(path: Path, columns: Columns, *, turned: bool = False) -> None:
    content = by_kind(columns)
    savemat(path, {name: a.T if turned and a.ndim == 2 else a for name, a in content.items()}, oned_as="column")


def write_trials(path: Path, trials: Sequence[Columns]) -> None:
    """A cell of structures, one for each trial."""
    cell = np.empty((1, len(trials)), dtype=object)
    for k, columns in enumerate(trials):
        cell[0, k] = by_kind(columns)
    savemat(path, {"trials": cell, "gain": 3.0}, oned_as="column")


def write_trials_v73(path: Path, trials: Sequence[Columns]) -> None:
    """The same as MATLAB 7.3 has it: references to structures that lie elsewhere in the file."""
    with h5py.File(path, "w") as file:
        cell = file.create_dataset("trials", (len(trials), 1), dtype=h5py.ref_dtype)
        for k, columns in enumerate(trials):
            group = file.create_group(f"#refs#/{k}")
            for name, array in by_kind(columns).items():
                group[name] = np.atleast_2d(array) if array.ndim == 1 else array.T
            cell[k, 0] = group.ref
        cell.attrs["MATLAB_class"] = np.bytes_("cell")


_STAMPED = (
    "std_msgs/Header header\n{}\n"
    + "=" * 80
    + """
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
    + "=" * 80
    + """
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""
)


def write_mcap(
    path: Path, columns: Columns, *, late: float = 0.0, quaternion: bool = False,
    compression: CompressionType = CompressionType.ZSTD, piece: int = 2**20,
) -> None:  # fmt: skip
    """A bag of ROS 2: set-points on a topic without a stamp, positions and angles on stamped ones.

    Set-points come `late` [s] before the angles, as on a bus where a controller writes first.
    """
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=piece, compression=compression)
        array = writer.register_msgdef("std_msgs/Float64MultiArray", "float64[] data")
        joints = writer.register_msgdef("sensor_msgs/JointState", _STAMPED.format("string[] name\nfloat64[] position"))
        tilt = writer.register_msgdef("neck_msgs/Tilt", _STAMPED.format("float64 pitch\nfloat64 roll"))
        imu = writer.register_msgdef("neck_msgs/Imu", _IMU)
        begin = round(START.timestamp() * 1e9)
        for k, t in enumerate(columns["t"]):
            now = begin + round(1e9 * float(t))
            stamp = {"sec": now // 10**9, "nanosec": now % 10**9}
            header = {"stamp": stamp, "frame_id": "neck"}
            asked = {"data": [float(columns[f"s{j}"][k]) for j in (1, 2, 3)]}
            writer.write_message("/cmd", array, asked, log_time=now - round(1e9 * late))
            if "x1" in columns:
                there = [float(columns[f"x{j}"][k]) for j in (1, 2, 3)]
                message = {"header": header, "name": ["a", "b", "c"], "position": there}
                writer.write_message("/joint_states", joints, message, log_time=now)
            if quaternion:
                w, x, y, z = from_angles(float(columns["pitch"][k]), float(columns["roll"][k]))
                message = {"header": header, "orientation": {"x": x, "y": y, "z": z, "w": w}}
                writer.write_message("/imu", imu, message, log_time=now)
            else:
                message = {"header": header, "pitch": float(columns["pitch"][k]), "roll": float(columns["roll"][k])}
                writer.write_message("/tilt", tilt, message, log_time=now)
        writer.finish()


_IMU = (
    _STAMPED.format("geometry_msgs/Quaternion orientation")
    + "\n"
    + "=" * 80
    + """
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w"""
)


def from_angles(pitch: float, roll: float) -> tuple[float, float, float, float]:
    """w, x, y, z of a turn by pitch about y and then by roll about the turned x, as ROS composes them."""
    a, b = roll / 2.0, pitch / 2.0
    return (
        float(np.cos(a) * np.cos(b)), float(np.sin(a) * np.cos(b)), float(np.cos(a) * np.sin(b)),
        float(-np.sin(a) * np.sin(b)),
    )  # fmt: skip
