"""NumPy archives from anybody: what their heads claim is checked before anything is unpacked."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from visctrl.robots.errors import InputError

#: Kinds of arrays that hold no Python objects: numbers, booleans, text.
_PLAIN = frozenset("biufU")
_HEAD = 10_000


def read_archive(path: Path, parts: Mapping[str, int]) -> dict[str, NDArray[Any]]:
    """Return the arrays that an ``.npz`` file holds, of those that are wanted.

    Parameters
    ----------
    path : Path
        The file.
    parts : mapping
        Names of the arrays, and the bytes that each may have.

    Raises
    ------
    InputError
        There is no such file, it is no archive of this kind, or an array is larger than it may
        be or than the file can hold.
    """
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file; `visctrl teach -o {path}` makes one")
    if not os.path.isfile(path):
        raise _refusal(path, "it is no file")
    try:
        with zipfile.ZipFile(path) as archive:
            return {name: _read(archive, name, most) for name, most in parts.items()}
    except _DifferentError as error:
        raise _refusal(path, str(error)) from None
    except Exception:
        # Damaged archives fail in every way that decompressors and parsers have.
        raise _refusal(path, "it is damaged, or of another kind") from None


class _DifferentError(Exception):
    """An array is not what it has to be."""


def _refusal(path: Path, reason: str) -> InputError:
    return InputError(
        f"{path}: not a target view (expected a file made by `visctrl teach`): {reason}"
    )


def _read(archive: zipfile.ZipFile, name: str, most: int) -> NDArray[Any]:
    try:
        about = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise _DifferentError(f"'{name}' is missing") from None
    if about.flag_bits & 1:
        raise _DifferentError("it is encrypted")
    if about.file_size > most:
        raise _DifferentError(f"'{name}' claims {about.file_size:,} bytes: at most {most:,}")
    with archive.open(about) as file:
        version = npy.read_magic(file)
        read_head = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read_head(file, max_header_size=_HEAD)
        if dtype.kind not in _PLAIN:
            raise _DifferentError(f"'{name}' holds {dtype}")
        size = math.prod(shape) * dtype.itemsize
        if size > about.file_size:
            raise _DifferentError(f"'{name}' claims {size:,} bytes, of {about.file_size:,}")
        # One byte more than that would be another array's.
        data = file.read(size + 1)
    if len(data) != size:
        raise _DifferentError(f"'{name}' is cut short")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if fortran else "C")
