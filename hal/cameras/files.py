"""Calibrations as files: this program's YAML, and those of other programs.

A file is recognised by what it says it is, never by its suffix. Numbers survive the way there
and back exactly, where the other format can hold them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml

from visctrl.hal.cameras.catalogue import camera_names, load_camera, model_names, parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.formats import (
    basalt,
    camodocal,
    colmap,
    kalibr,
    ocamcalib,
    opencv,
    ros,
)
from visctrl.hal.cameras.formats.storage import mapping_of
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_text, write_text, writing
from visctrl.robots.plain_yaml import MOST_BYTES

Format = Literal["visctrl", "kalibr", "opencv", "ros", "camodocal", "basalt", "ocamcalib", "colmap"]
FORMATS: tuple[Format, ...] = (
    *("visctrl", "kalibr", "opencv", "ros"),
    *("camodocal", "basalt", "ocamcalib", "colmap"),
)
_WRITERS: dict[Format, Callable[[CentralCamera], str]] = {
    "kalibr": kalibr.write,
    "ros": ros.write,
    "camodocal": camodocal.write,
    "basalt": basalt.write,
    "ocamcalib": ocamcalib.write,
    "colmap": colmap.write,
}
#: Keys of this program's own files by which they are recognised.
_OWN = {"model", "name", "width", "height", "xi", "fx", "fy", "cx", "cy", "optical_axis"}


def read_camera(path: Path, cam: int | None = None) -> CentralCamera:
    """Read a calibration of any of the formats.

    Parameters
    ----------
    path : Path
        The file.
    cam : int, optional
        Which camera, of a file that holds several.

    Raises
    ------
    InputError
        The file is missing or not a calibration, or has what no model here has; the message is
        one line that names the file and the key.
    """
    text = read_text(path, MOST_BYTES)
    where = str(path)
    if ocamcalib.recognises(text):
        return _only(cam, where, ocamcalib.read(text, where, path.stem))
    if colmap.recognises(text):
        return colmap.read(text, where, cam, path.stem)
    data = mapping_of(text, where)
    if basalt.recognises(data):
        return basalt.read(data, where, cam, path.stem)
    if kalibr.recognises(data):
        return kalibr.read(data, where, cam, path.stem)
    header = text.lstrip()[:12].startswith("%YAML:1.0") or "opencv-matrix" in text
    return _only(cam, where, _single(data, where, path.stem, of_opencv=header))


def find_camera(name: str, cam: int | None = None) -> CentralCamera:
    """Return a camera by the name of a built-in one, or by the path of a calibration.

    Raises
    ------
    InputError
        There is no such camera or file (see `load_camera`, `read_camera`).
    """
    path = Path(name)
    if name in camera_names() or not (path.suffix or len(path.parts) > 1 or os.path.exists(path)):
        return _only(cam, f"camera '{name}'", load_camera(name))
    return read_camera(path, cam)


def write_camera(camera: CentralCamera, path: Path, form: Format) -> None:
    """Write a calibration.

    Raises
    ------
    InputError, DiskError
        The format cannot hold this camera, or the file cannot be written.
    """
    if form == "visctrl":
        data = camera.model_dump(mode="json")
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    elif form == "opencv":
        text = opencv.write(camera, path.suffix)
    else:
        text = _WRITERS[form](camera)
    with writing(path):
        write_text(path, text)


def _single(data: Mapping[str, Any], where: str, name: str, *, of_opencv: bool) -> CentralCamera:
    """Return the camera of a file of a format that holds one.

    of_opencv : the text has what only OpenCV's storage has.
    """
    if camodocal.recognises(data):
        return camodocal.read(data, where, name)
    if ros.recognises(data):
        return ros.read(data, where, name)
    # A model's name of ours goes with our own keys, whatever else there is.
    ours = data.get("model") in model_names() or ":" in str(data.get("model", ""))
    if not ours and (of_opencv or opencv.recognises(data)):
        return opencv.read(data, where, name)
    if len(_OWN & set(data)) < 2:
        keys = ", ".join(map(str, list(data)[:6])) or "none"
        raise InputError(
            f"{where}: no calibration of a known format (keys here: {keys}); known: "
            f"{', '.join(FORMATS)}"
        )
    return parse_camera(data, where)


def _only(cam: int | None, where: str, camera: CentralCamera) -> CentralCamera:
    """Return the camera, unless another than the first was asked for."""
    if cam not in (None, 0):
        raise InputError(f"{where}: has no camera {cam}: there is one only")
    return camera
