"""Keys of a foreign file: each is read under its own name, and none is passed over unread."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]

#: Where other formats have no place for what is ours: mounting and field of view.
EXTRA = "visctrl"
OURS = (
    *("name", "optical_axis", "yaw_deg", "pitch_deg", "roll_deg"),
    *("min_polar_deg", "max_polar_deg"),
)


class Keys:
    """The keys of a mapping, with a note of which have been read.

    Parameters
    ----------
    data : mapping
    where : str
        What opens a message: the file, and the part of it.
    loose : bool
        Case and underscores do not count (formats that people write by hand).
    """

    def __init__(self, data: object, where: str, *, loose: bool = False) -> None:
        if not isinstance(data, Mapping):
            raise InputError(f"{where}: expected a mapping of keys")
        self.where = where
        self._spell: Callable[[str], str] = _plain if loose else str
        self._data = {str(key): value for key, value in data.items()}
        self._read: set[str] = set()

    def find(self, *names: str) -> str | None:
        """Return the key that is there of several that mean the same.

        Raises
        ------
        InputError
            More than one is there.
        """
        wanted = {self._spell(name) for name in names}
        found = [key for key in self._data if self._spell(key) in wanted]
        if len(found) > 1:
            raise InputError(f"{self.where}: keys '{found[0]}' and '{found[1]}' say the same twice")
        return found[0] if found else None

    def take(self, *names: str) -> Any:
        """Return the value of a key, by any of its names; it must be there."""
        key = self.find(*names)
        if key is None or self._data[key] is None:
            raise InputError(f"{self.where}: key '{names[0]}' is missing")
        self._read.add(key)
        return self._data[key]

    def text(self, *names: str, default: str | None = None) -> str:
        """Return the text of a key."""
        if default is not None and self.find(*names) is None:
            return default
        found = self.take(*names)
        if not isinstance(found, str):
            raise InputError(f"{self.where}: key '{names[0]}': expected a name (got {found!r})")
        return found

    def numbers(self, *names: str, count: int | Sequence[int] | None = None) -> Array:
        """Return a number, a list of numbers or a matrix as an array (N,)."""
        found = self.take(*names)
        key = self.find(*names)
        return numbers(found, f"{self.where}: key '{key}'", count)

    def number(self, *names: str) -> float:
        """Return one number."""
        return float(self.numbers(*names, count=1)[0])

    def lengths(self, *names: str, count: int = 1) -> list[int]:
        """Return numbers of pixels."""
        values = self.numbers(*names, count=count)
        if not all(value > 0 and value == int(value) for value in values):
            raise InputError(
                f"{self.where}: key '{self.find(*names)}': expected positive whole numbers of "
                f"pixels (got {', '.join(f'{value:g}' for value in values)})"
            )
        return [int(value) for value in values]

    def within(self, name: str) -> Keys:
        """Return the keys of a mapping within this one."""
        return Keys(self.take(name), f"{self.where}: {name}")

    def ours(self) -> Mapping[str, Any] | None:
        """Return what the file says under our own key, None if nothing."""
        if self.find(EXTRA) is None:
            return None
        found = self.take(EXTRA)
        if not isinstance(found, Mapping):
            raise InputError(f"{self.where}: key '{EXTRA}': expected a mapping of keys")
        Keys(found, f"{self.where}: {EXTRA}").all_known(OURS)
        return found

    def all_known(self, harmless: Collection[str] = ()) -> None:
        """Refuse keys that were neither read nor are known to say nothing about the projection."""
        known = {self._spell(key) for key in harmless}
        for key in self._data:
            if key not in self._read and self._spell(key) not in known:
                hint = suggestion(key, self._read)
                raise InputError(f"{self.where}: key '{key}' is not understood; {hint}")


def numbers(found: object, where: str, count: int | Sequence[int] | None = None) -> Array:
    """Return numbers (N,) from a scalar, a list or a matrix with its rows and columns.

    Raises
    ------
    InputError
        Not finite numbers, or not so many.
    """
    expected = None
    if isinstance(found, Mapping):
        if "data" not in found:
            raise InputError(f"{where}: expected numbers, 'data' is missing")
        expected = _area(found, where)
        found = found["data"]
    try:
        if _holds_flags(found):
            raise TypeError
        values = np.asarray(found, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"{where}: expected numbers (got {found!r})") from None
    if not np.isfinite(values).all():
        raise InputError(f"{where}: expected finite numbers (got {found!r})")
    if expected is not None and len(values) != expected:
        raise InputError(f"{where}: expected rows x cols = {expected} numbers, found {len(values)}")
    counts = [count] if isinstance(count, int) else count
    if counts is not None and len(values) not in counts:
        listed = " or ".join(map(str, counts))
        raise InputError(f"{where}: expected {listed} numbers, found {len(values)}")
    return values


def camera_of(
    fields: Mapping[str, Any],
    ours: Mapping[str, Any] | None,
    origin: str,
    name: str,
    *,
    within_deg: float = 180.0,
) -> CentralCamera:
    """Return the camera of a foreign file.

    Where the file does not say how the camera is mounted, it looks ahead, and its field of view
    is all that its model sees in the picture, but not more than ``within_deg``.

    Raises
    ------
    InputError
        A parameter is out of its range; one line, that opens with ``origin``.
    """
    try:
        if ours is not None:
            return parse_camera({"name": name, **ours, **fields}, origin)
        camera = parse_camera({"name": name, "max_polar_deg": 180.0, **fields}, origin)
        return camera.altered(max_polar_deg=min(camera.widest_polar_deg, within_deg))
    except InputError as error:
        raise InputError(str(error).splitlines()[0]) from None


def ours_of(camera: CentralCamera) -> dict[str, Any]:
    """Return what other formats keep beside, under `EXTRA`."""
    return {key: getattr(camera, key) for key in OURS}


def unwritable(camera: CentralCamera, what: str) -> InputError:
    """Return the error for a camera that a format cannot hold."""
    return InputError(
        f"camera '{camera.name}': {what} cannot hold model '{camera.model}' with these parameters; "
        "keep it in this program's own format (--format visctrl)"
    )


def without_skew(camera: CentralCamera, what: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera for a format that has no skew.

    Raises
    ------
    InputError
        The camera has skew.
    """
    K = camera.K
    if K[0, 1] != 0.0 or K[1, 0] != 0.0:
        raise InputError(f"camera '{camera.name}': {what} has no skew (here {K[0, 1]:g})")
    return float(K[0, 0]), float(K[1, 1]), camera.cx, camera.cy


def _area(matrix: Mapping[Any, Any], where: str) -> int | None:
    sides = [matrix.get("rows"), matrix.get("cols")]
    if sides == [None, None]:
        return None
    lengths = [int(side) for side in sides if isinstance(side, int | float) and side == side // 1]
    if len(lengths) != 2:
        raise InputError(f"{where}: expected whole 'rows' and 'cols' (got {sides[0]}, {sides[1]})")
    return lengths[0] * lengths[1]


def _holds_flags(found: object) -> bool:
    if isinstance(found, list | tuple):
        return any(map(_holds_flags, found))
    return isinstance(found, bool) or found is None


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())
