"""The target view as a file: pictures from one pose, and the camera that took them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose
from visctrl.robots.documents import StrictModel, parse_json, validate
from visctrl.robots.errors import InputError
from visctrl.robots.files import replacing, writing
from visctrl.robots.model import Mount
from visctrl.runtime.archive import read_archive
from visctrl.schemes.scheme import Scheme

#: Raised when what a file holds changes.
_FORMAT = 1
_KEYS = ("format", "images", "camera", "facts")
#: Bytes of the pictures, and of each other part, that are read at most.
_MOST_PICTURES, _MOST_TEXT = 512_000_000, 1_000_000
#: Fields of a camera that may differ between teaching and driving.
_HARMLESS = frozenset({"name"})
#: Places of a camera on its robot this close (m) are the same: as well as one can measure them.
_SAME_PLACE_M = 0.005
#: Relative difference of calibrations that counts as rounding.
_ROUNDING = 1e-9


class _Facts(StrictModel):
    """What the file says of the view besides its camera (see `TargetView`)."""

    odometry: tuple[float, float, float] | None
    backend: str
    robot: str
    taken: str
    mount: Mount | None = None


@dataclass(frozen=True)
class TargetView:
    """What a robot saw from where it shall drive to.

    images : (N, height, width) uint8, N pictures from the same pose.
    camera : their calibration.
    odometry : pose of the base in its own odometry, where it is known.
    backend, robot : what took them.
    taken : when, ISO 8601.
    mount : where the camera sat; None in files that do not say.
    """

    images: NDArray[np.uint8]
    camera: CentralCamera
    odometry: Pose | None = None
    backend: str = ""
    robot: str = ""
    taken: str = ""
    mount: Mount | None = None

    def frames(self) -> list[Frame]:
        """Return the pictures as a camera would deliver them."""
        return [Frame(0.0, k, image) for k, image in enumerate(self.images)]

    def save(self, path: Path) -> None:
        """Write the view as a compressed NumPy archive.

        Raises
        ------
        InputError, DiskError
            The file cannot be written; one that was there is as it was.
        """
        facts = {
            "odometry": None if self.odometry is None else list(self.odometry),
            "backend": self.backend,
            "robot": self.robot,
            "taken": self.taken,
            "mount": None if self.mount is None else self.mount.model_dump(),
        }
        with writing(path), replacing(path) as fresh, fresh.open("wb") as file:
            np.savez_compressed(
                file,
                format=_FORMAT,
                images=self.images,
                camera=self.camera.model_dump_json(),
                facts=json.dumps(facts),
            )

    def check_camera(self, camera: CentralCamera, origin: str) -> None:
        """Refuse a view that another camera took.

        Raises
        ------
        InputError
            The calibrations differ; the message says in what.
        """
        taken, used = self.camera.model_dump(), camera.model_dump()
        different = [
            f"{key} {taken.get(key, 'none')} there, {used.get(key, 'none')} here"
            for key in taken | used
            if key not in _HARMLESS and not _same(taken.get(key), used.get(key))
        ]
        if different:
            raise InputError(
                f"{origin}: the target was taken by camera '{self.camera.name}', this run uses "
                f"'{camera.name}': {'; '.join(different)}. Use the same camera, or teach again"
            )

    def check_mount(self, mount: Mount, robot: str, scheme: Scheme, origin: str) -> str:
        """Compare where the camera sat with where it sits now; return what to mind, or "".

        Raises
        ------
        InputError
            The scheme needs the camera at the height of the target view, and it is not.
        """
        if self.mount is None:
            return ""
        there, here = self.mount, mount
        who = f"{origin}: the target was taught on robot '{self.robot}'"
        if abs(there.height_m - here.height_m) > _SAME_PLACE_M:
            heights = (
                f"{who}, its camera {there.height_m:g} m above the floor; on '{robot}' it is "
                f"{here.height_m:g} m"
            )
            if scheme.same_height:
                raise InputError(
                    f"{heights}, and this scheme needs the same height: move the camera, teach "
                    "again, or use a scheme that measures azimuths alone, such as 'trifocal'"
                )
            return f"{heights}: fewer features may be recognised"
        ahead = here.forward_m - there.forward_m
        if abs(ahead) > _SAME_PLACE_M:
            return (
                f"{who}, its camera {there.forward_m:g} m ahead of the axle; on '{robot}' it is "
                f"{here.forward_m:g} m: the camera will be where it was, the robot "
                f"{abs(ahead):g} m {'behind' if ahead > 0.0 else 'ahead of'} there"
            )
        return ""


def now_text() -> str:
    """Return the date and time as a target view keeps them."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def load_target(path: Path) -> TargetView:
    """Read a target view.

    Raises
    ------
    InputError
        There is no such file, or it holds no target view.
    """
    content = read_archive(path, {**dict.fromkeys(_KEYS, _MOST_TEXT), "images": _MOST_PICTURES})
    if content.keys() != set(_KEYS) or content["format"].tolist() != _FORMAT:
        raise InputError(f"{path}: not a target view of this version: teach it again")
    images = content["images"]
    if images.ndim != 3 or images.dtype != np.uint8 or images.size == 0:
        raise InputError(f"{path}: expected 8-bit grey images, found {images.dtype} {images.shape}")
    camera = parse_camera(_json(content["camera"], f"{path}: camera"), f"{path}: camera")
    facts = validate(_json(content["facts"], f"{path}: facts"), _Facts, f"{path}: facts")
    if images.shape[1:] != (camera.height, camera.width):
        raise InputError(f"{path}: its images do not have the size of its camera")
    odometry = None if facts.odometry is None else Pose(*facts.odometry)
    return TargetView(
        images, camera, odometry, facts.backend, facts.robot, facts.taken, facts.mount
    )


def _json(content: NDArray[Any], origin: str) -> dict[str, Any]:
    """Return the mapping that a JSON text in an archive holds."""
    found = parse_json(str(content), origin)
    if not isinstance(found, dict):
        raise InputError(f"{origin}: expected a mapping of keys, found {type(found).__name__}")
    return found


def _same(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= _ROUNDING * max(abs(a), abs(b))
    return a == b
