"""What the writer writes the importer reads back; what nobody wrote is one clear line, never a crash."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from softneck.core import DataError, SoftneckError
from softneck.signals import (
    SET_POINTS,
    Recording,
    guess_layout,
    import_log,
    layout_toml,
    parse_layout,
    read_layout,
    read_recording,
    write_recording,
)
from softneck.signals.recording._channels import known_channels

from ..data import neck_recording

MISSABLE = ("pitch", "roll", "pitch_rate", "compression", "motor_velocity_2", "motor_position_1", "tension_1")


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Any recording: odd sample times, several runs that restart or go on, a little jitter, missed samples."""
    runs = draw(st.lists(st.integers(3, 9), min_size=1, max_size=3))
    n, Ts = sum(runs), draw(st.floats(1e-4, 10.0))
    run = np.repeat(draw(st.lists(st.integers(-5, 5), min_size=3, max_size=3, unique=True))[: len(runs)], runs)
    jitter = np.array(draw(st.lists(st.floats(-0.004, 0.004), min_size=n, max_size=n)))
    # Neighbours may be apart by 0.8 % less or more, which is even within the 2 % that a recording allows.
    start = draw(st.sampled_from([0.0, 5.0, -1.0]))
    restart = draw(st.booleans())
    time = start + Ts * (np.concatenate([np.arange(rows) for rows in runs]) if restart else np.arange(n))
    time = time + (Ts * jitter if draw(st.booleans()) else 0.0)
    optional = draw(st.sets(st.sampled_from(known_channels()[1:]), max_size=6))
    channels = {}
    for name in {*SET_POINTS, "pitch", "roll", *optional}:
        channels[name] = np.array(draw(st.lists(st.floats(-3.0, 3.0), min_size=n, max_size=n)))
    for name in set(MISSABLE) & set(channels):
        missed = draw(st.lists(st.integers(1, n - 1), max_size=n))  # the first is there: a channel has a sample
        channels[name][missed] = np.nan
    return Recording(time, Ts, channels, run if len(runs) > 1 else np.zeros(n, dtype=np.int64))


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@given(recording=recordings())
@settings(max_examples=30)
def test_import_of_what_the_writer_writes_is_the_identity(tmp_path: Path, suffix: str, recording: Recording) -> None:
    path = tmp_path / f"a.{suffix}"
    write_recording(path, recording, force=True)
    guess = guess_layout(path)
    for back in (import_log(path, guess.layout).recording, import_log(path, parse_layout(guess.text)).recording):
        np.testing.assert_array_equal(back.time, recording.time)
        assert [len(run) for run in back.runs()] == [len(run) for run in recording.runs()]
        assert set(back.channels) == set(recording.channels)
        # Jitter of 0.4 % at both ends of 3 rows or more moves the mean step by 0.4 % at most.
        assert back.sample_time == pytest.approx(recording.sample_time, rel=5e-3)
        for name, values in recording.channels.items():
            # Degrees in the file: one quotient and one product, half an ulp each. NaN stays NaN.
            np.testing.assert_allclose(back.channels[name], values, rtol=2.3e-16, atol=1e-300)


@pytest.mark.parametrize("name", ["pitch", "motor_position_2"])
def test_a_channel_without_a_sample_is_neither_written_nor_read(tmp_path: Path, name: str) -> None:
    r = neck_recording(60)
    with pytest.raises(DataError, match=f"channel `{name}` has no sample in any of its 60 rows"):
        write_recording(tmp_path / "a.csv", r.with_channels(**{name: np.full(60, np.nan)}))
    assert list(tmp_path.iterdir()) == []
    write_recording(tmp_path / "a.csv", r)
    frame = pd.read_csv(tmp_path / "a.csv")
    frame[next(title for title in frame.columns if title.startswith(name))] = np.nan
    frame.to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(DataError, match=rf"a\.csv: channel `{name}` has no sample in any of its 60 rows"):
        read_recording(tmp_path / "a.csv")


def test_missed_samples_may_be_written_as_nan(tmp_path: Path) -> None:
    r = neck_recording(60)
    write_recording(tmp_path / "a.csv", r)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    place = lines[0].split(",").index("pitch [deg]")
    for row, word in ((5, "NaN"), (6, " nan"), (7, "")):
        cells = lines[row].split(",")
        cells[place] = word
        lines[row] = ",".join(cells)
    (tmp_path / "b.csv").write_text("\n".join(lines))
    back = import_log(tmp_path / "b.csv", guess_layout(tmp_path / "b.csv").layout).recording
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(back.outputs[:, 0])), [4, 5, 6])


LOG = {
    "time": 0.02 * np.arange(60),
    **{f"target{j}": np.sin(0.1 * j * np.arange(60)) for j in (1, 2, 3)},
    **{f"encoder{j}": np.sin(0.1 * j * np.arange(60) - 0.1) for j in (1, 2, 3)},
    "pitch": 0.1 * np.sin(0.1 * np.arange(60) - 0.2),
    "roll": 0.1 * np.sin(0.2 * np.arange(60) - 0.2),
}


def write_log(path: Path) -> None:
    frame = pd.DataFrame(LOG)
    match path.name:
        case "log.csv":
            frame.to_csv(path, index=False)
        case "bare.csv":
            frame.to_csv(path, index=False, header=False, sep=";", float_format="%.4f", decimal=",")
        case "log.parquet":
            frame.to_parquet(path, index=False)
        case "v5.mat":
            savemat(path, LOG, oned_as="column")
        case "v73.mat":
            import h5py

            with h5py.File(path, "w") as file:
                file["log"] = frame.to_numpy().T


def mangled(data: st.DataObject, whole: bytes) -> bytes:
    """Flip, cut out, put in or double some bytes, and often cut the end off."""
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        match data.draw(st.sampled_from(["flip", "out", "in", "double"])):
            case "flip":
                content[at] ^= 1 << data.draw(st.integers(0, 7))
            case "out":
                del content[at : at + data.draw(st.integers(1, 20))]
            case "in":
                content[at:at] = data.draw(st.binary(min_size=1, max_size=8))
            case _:
                content[at:at] = content[at : at + 40]
        if not content:
            return b""
    return bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["log.csv", "bare.csv", "log.parquet", "v5.mat", "v73.mat"])
@given(data=st.data())
@settings(max_examples=60)
def test_mangled_logs_are_a_result_or_a_clear_error(tmp_path: Path, name: str, data: st.DataObject) -> None:
    whole = tmp_path / name
    if not whole.exists():
        write_log(whole)
        whole.with_suffix(".toml").write_text(guess_layout(whole).text)
    damaged = tmp_path / f"damaged{whole.suffix}"
    damaged.write_bytes(mangled(data, whole.read_bytes()))
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        import_log(damaged, read_layout(whole.with_suffix(".toml")))
    with contextlib.suppress(SoftneckError):
        guess = guess_layout(damaged)  # where an angle is lost, that of a robot of one output
        assert parse_layout(guess.text, robot=guess.layout.robot) == guess.layout
        import_log(damaged, guess.layout)


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=100)
def test_a_mangled_layout_is_a_result_or_a_clear_error(tmp_path: Path, data: st.DataObject) -> None:
    write_log(tmp_path / "log.csv")
    whole = layout_toml(guess_layout(tmp_path / "log.csv").layout).encode()
    (tmp_path / "damaged.toml").write_bytes(mangled(data, whole))
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        import_log(tmp_path / "log.csv", read_layout(tmp_path / "damaged.toml"))
