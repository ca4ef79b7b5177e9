"""The target view as a file: pictures from one pose, and the camera that took them."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.types import Frame, Pose
from visctrl.robots.errors import InputError
from visctrl.robots.files import replacing, writing

#: Raised when what a file holds changes.
_FORMAT = 1
_KEYS = ("format", "images", "camera", "facts")
#: Fields of a camera that may differ between teaching and driving.
_HARMLESS = frozenset({"name"})
#: Relative difference of calibrations that counts as rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class TargetView:
    """What a robot saw from where it shall drive to.

    images : (N, height, width) uint8, N pictures from the same pose.
    camera : their calibration.
    odometry : pose of the base in its own odometry, where it is known.
    backend, robot : what took them.
    taken : when, ISO 8601.
    """

    images: NDArray[np.uint8]
    camera: CentralCamera
    odometry: Pose | None = None
    backend: str = ""
    robot: str = ""
    taken: str = ""

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
    content = _read(path)
    if any(key not in content for key in _KEYS) or int(content["format"]) != _FORMAT:
        raise InputError(f"{path}: not a target view of this version: teach it again")
    images = content["images"]
    if images.ndim != 3 or images.dtype != np.uint8 or len(images) == 0:
        raise InputError(f"{path}: expected 8-bit grey images, found {images.dtype} {images.shape}")
    camera = parse_camera(json.loads(str(content["camera"])), f"{path}: camera")
    if images.shape[1:] != (camera.height, camera.width):
        raise InputError(f"{path}: its images do not have the size of its camera")
    facts = json.loads(str(content["facts"]))
    odometry = facts["odometry"]
    return TargetView(
        images=images,
        camera=camera,
        odometry=None if odometry is None else Pose(*odometry),
        backend=facts["backend"],
        robot=facts["robot"],
        taken=facts["taken"],
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; `visctrl teach -o {path}` makes one") from None
    except (OSError, ValueError, zipfile.BadZipFile, AttributeError):
        raise InputError(
            f"{path}: not a target view (expected a file made by `visctrl teach`)"
        ) from None


def _same(a: object, b: object) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= _ROUNDING * max(abs(a), abs(b))
    return a == b
