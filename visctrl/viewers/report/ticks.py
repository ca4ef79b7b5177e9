"""The columns of a run's ``ticks.csv``."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visctrl.contracts import Array
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_text
from visctrl.runtime.recorder import COLUMNS, WORDS

#: Largest log that is read: a day at 10 Hz (bytes).
MOST_BYTES = 512_000_000
#: What every log has, by name without unit.
_NEEDED = tuple(title.partition(" [")[0] for title in COLUMNS)
_GREATEST = 1e100


@dataclass(frozen=True)
class Ticks:
    """The columns of a ``ticks.csv`` by name without unit; empty cells are NaN.

    numbers : numeric columns; words : the others; units : of the numeric ones.
    """

    numbers: dict[str, Array]
    words: dict[str, list[str]]
    units: dict[str, str]

    def __len__(self) -> int:
        return len(self.words["stage"])

    @property
    def t(self) -> Array:
        """Times since the run's first tick (s)."""
        return self.numbers["t"]

    def degrees(self, name: str) -> Array:
        """Return an angle column in degrees."""
        return np.degrees(self.numbers[name])

    @property
    def pose_source(self) -> str:
        """Which pose there is: ``true`` where it is known, else ``odometry``."""
        return "true" if np.isfinite(self.numbers["x_true"]).any() else "odometry"

    def pose(self) -> tuple[Array, Array, Array]:
        """Return x, y (m) and φ (rad) from `pose_source`."""
        x, y, phi = (self.numbers[f"{name}_{self.pose_source}"] for name in ("x", "y", "phi"))
        return x, y, phi


def read_ticks(path: Path) -> Ticks:
    """Read a ``ticks.csv``; a last line cut short by a crash is left out.

    Raises
    ------
    InputError
        There is no such file, or it is not one of ours.
    """
    try:
        header, *rows = list(csv.reader(io.StringIO(read_text(path, MOST_BYTES), ""))) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: is not a tick log: {error}") from None
    whole = [row for row in rows if len(row) == len(header)]
    columns = list(zip(*whole, strict=True)) or [() for _ in header]
    numbers: dict[str, Array] = {}
    words: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    for title, cells in zip(header, columns, strict=True):
        name, _, unit = title.partition(" [")
        if name in WORDS:
            words[name] = list(cells)
        else:
            numbers[name] = _as_numbers(cells, path)
            units[name] = unit.rstrip("]")
    missing = [name for name in _NEEDED if name not in numbers and name not in words]
    if missing or len(numbers) + len(words) != len(header):
        what = f"column '{missing[0]}' is missing" if missing else "a column stands there twice"
        raise InputError(f"{path}: is not a tick log: {what}")
    t = numbers["t"]
    if not (np.isfinite(t).all() and (np.diff(t) >= 0.0).all()):
        raise InputError(f"{path}: is not a tick log: its times do not go forward")
    return Ticks(numbers, words, units)


def _as_numbers(cells: Sequence[str], path: Path) -> Array:
    try:
        found = np.array([float(cell or "nan") for cell in cells])
    except ValueError as error:
        raise InputError(f"{path}: is not a tick log: {error}") from None
    # Numbers that no picture can show are as good as none.
    return np.where(np.abs(found) < _GREATEST, found, np.nan)
