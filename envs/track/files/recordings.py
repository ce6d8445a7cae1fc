"""Readers of hydrophone recordings: WAV, NumPy and SIO files, tables of element positions, and true bearings."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.track.files.points import csv_number, csv_rows
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.types import Array

RECORDING_SUFFIXES = (".wav", ".npy", ".sio")
"""Endings of recordings."""
_SIO_CHECK = 32677
"""Number in the header of an SIO file that shows the order of its bytes."""
_SIO_HEADER = 128
"""Length of the used part of the header, bytes."""


class Recording(NamedTuple):
    """Signals of hydrophones.

    Attributes:
        samples: One column per channel; a memory map where the file allows it. Shape (samples, channels).
        rate: Sampling frequency, Hz.
    """

    samples: NDArray[Any]
    rate: float


class BearingTruth(NamedTuple):
    """True bearings at the rows of a record.

    Attributes:
        bearings: NaN while a target does not exist. Shape (n, T), deg.
        known: Rows at which the truth says which targets exist. Shape (T,), bool.
    """

    bearings: Array
    known: NDArray[np.bool_]


def is_recording_file(source: str) -> bool:
    """Return True if a source's name is that of a recording."""
    return "://" not in source and source.lower().endswith(RECORDING_SUFFIXES)


def read_recording(path: Path, rate: float | None = None) -> Recording:
    """Read a recording of several channels.

    Args:
        path: A .wav file; a .npy file with an array of shape (samples, channels); or a .sio file of the Scripps
            Institution of Oceanography, see `read_sio`.
        rate: Sampling frequency, Hz; needed for .npy and .sio, which do not hold it, and an override for .wav.

    Raises:
        SequenceError: The file cannot be read, is truncated, or holds no channels of numbers; the rate is missing or
            not positive.
    """
    if not path.is_file():
        raise SequenceError(f"{path} does not exist")
    if not path.stat().st_size:
        raise SequenceError(f"{path} is empty")
    suffix = path.suffix.lower()
    if suffix == ".wav":
        own, samples = _read_wav(path)
        rate = float(own) if rate is None else rate
    elif suffix == ".sio":
        samples = read_sio(path)
    else:
        try:
            samples = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise SequenceError(f"{path} must be an array that numpy.save wrote, whole and without objects") from error
    if rate is None:
        raise SequenceError(f"{path} does not hold its sampling frequency; give it with --rate")
    if not 0.0 < rate < np.inf:
        raise SequenceError(f"{path} must have a positive sampling frequency, got {rate:g} Hz; give it with --rate")
    samples = samples[:, None] if samples.ndim == 1 else samples
    if samples.ndim != 2 or samples.dtype.kind not in "fiu":
        raise SequenceError(
            f"{path} must hold numbers of shape (samples, channels), got {samples.dtype} {samples.shape}"
        )
    if not samples.size:
        raise SequenceError(f"{path} holds no samples")
    return Recording(samples, rate)


def _read_wav(path: Path) -> tuple[float, NDArray[Any]]:
    from scipy.io import wavfile

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message=".*(EOF|Incomplete).*", category=wavfile.WavFileWarning)
            try:
                return wavfile.read(path, mmap=True)
            except ValueError:
                # Samples of 24 bits cannot be mapped.
                return wavfile.read(path)
    except (OSError, ValueError, EOFError, TypeError, ZeroDivisionError, struct.error, UnboundLocalError) as error:
        raise SequenceError(f"{path} is no WAV file that can be read ({error}); convert it to PCM") from error
    except wavfile.WavFileWarning as error:
        raise SequenceError(f"{path} is truncated ({error}); copy it again") from error


def read_sio(path: Path) -> NDArray[Any]:
    """Map an SIO file, in which records of one channel after the other alternate; used by the SWellEx-96 data.

    The first record is the header, of big-endian or little-endian integers of 4 bytes: identity, number of records,
    bytes per record, number of channels, bytes per sample, 1 for real numbers or 0 for integers, samples per channel,
    and 32677, which shows the order of bytes; then a name of 24 bytes and a comment of 72.

    Returns:
        Samples, mapped from the file if its records hold whole numbers of samples. Shape (samples, channels).

    Raises:
        SequenceError: The file has no such header, another kind of numbers, or fewer records than its header says.
    """
    with path.open("rb") as file:
        head = file.read(_SIO_HEADER)
    order = next(
        (o for o in "><" if len(head) == _SIO_HEADER and struct.unpack(f"{o}I", head[28:32])[0] == _SIO_CHECK), None
    )
    if order is None:
        raise SequenceError(f"{path} must be an SIO file with the number {_SIO_CHECK} at byte 28 of its header")
    _, _, record, channels, width, real, length = struct.unpack(f"{order}7I", head[:28])
    kind = {(2, 0): "i2", (4, 0): "i4", (4, 1): "f4", (8, 1): "f8"}.get((width, real))
    if kind is None or not channels or not length or record < _SIO_HEADER or record % width:
        raise SequenceError(
            f"{path} must have samples of 2 or 4 bytes, or real ones of 4 or 8, in whole records, got {width} bytes "
            f"(real: {real}), {channels} channels, {length} samples and {record} bytes per record"
        )
    inside = record // width
    turns = -(-length // inside)
    needed = record * (1 + turns * channels)
    if path.stat().st_size < needed:
        raise SequenceError(
            f"{path} is truncated: its header names {length} samples of {channels} channels, {needed} bytes, "
            f"and it has {path.stat().st_size}; copy it again"
        )
    blocks = np.memmap(path, np.dtype(order + kind), "r", record, (turns, channels, inside))
    return blocks.transpose(0, 2, 1).reshape(-1, channels)[:length]


def read_positions(path: Path) -> Array:
    """Read places of elements, one row per channel in the order of the channels.

    Args:
        path: CSV file with a header and the columns `x`, `y`[, `z`], m. Further columns are ignored.

    Returns:
        Places, shape (channels, 2) or (channels, 3), m.

    Raises:
        SequenceError: The file cannot be read, has other columns, or a place that is no finite number; the message
            names path and row.
    """
    lines = list(csv_rows(path))
    head = [cell.strip().lower() for cell in lines[0][1]] if lines else []
    names = [name for name in "xyz" if name in head]
    if names[:2] != ["x", "y"]:
        raise SequenceError(f"{path} row 1 must name the columns x, y[, z] in m, got {','.join(head) or 'nothing'}")
    places = []
    for number, row in lines[1:]:
        where = f"{path} row {number}"
        if len(row) != len(head):
            raise SequenceError(f"{where} must have {len(head)} columns as the header, got {len(row)}")
        places.append([csv_number(row[head.index(name)], name, where) for name in names])
    if len(places) < 2:
        raise SequenceError(f"{path} must hold at least two elements, got {len(places)}")
    return np.array(places)


def read_bearing_truth(path: Path, times: Array) -> BearingTruth:
    """Read true bearings, linear between the rows of a target.

    Args:
        path: CSV file with the columns `time` (s from the start of the recording), `id` and `bearing` (deg).
        times: Times of the record's rows, s. Shape (T,).

    Raises:
        SequenceError: The file cannot be read, has other columns, or no time in common with the record.
    """
    lines = list(csv_rows(path))
    head = [cell.strip().lower() for cell in lines[0][1]] if lines else []
    if not {"time", "id", "bearing"} <= set(head):
        raise SequenceError(f"{path} row 1 must name the columns time, id, bearing, got {','.join(head) or 'nothing'}")
    found: dict[str, list[tuple[float, float]]] = {}
    for number, row in lines[1:]:
        where = f"{path} row {number}"
        if len(row) != len(head):
            raise SequenceError(f"{where} must have {len(head)} columns as the header, got {len(row)}")
        time, bearing = (csv_number(row[head.index(name)], name, where) for name in ("time", "bearing"))
        found.setdefault(row[head.index("id")].strip(), []).append((time, bearing))
    every = [time for pairs in found.values() for time, _ in pairs]
    known = (times >= min(every, default=np.inf)) & (times <= max(every, default=-np.inf))
    if not known.any():
        raise SequenceError(f"{path} must overlap the recording in time, 0 to {times[-1]:g} s")
    bearings = np.full((len(found), len(times)), np.nan)
    for path_of_target, pairs in zip(bearings, found.values(), strict=True):
        own = np.array(sorted(pairs))
        inside = (times >= own[0, 0]) & (times <= own[-1, 0])
        path_of_target[inside] = np.interp(times[inside], own[:, 0], np.unwrap(own[:, 1], period=360.0))
    return BearingTruth(bearings, known)
