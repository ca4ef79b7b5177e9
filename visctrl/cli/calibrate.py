"""``visctrl calibrate``: from image files to a calibration."""

from __future__ import annotations

import json
import math
import os
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from visctrl.calibration.boards import Board
from visctrl.calibration.camera import MISFIT_PX, BoardView, Calibration, Model, calibrate
from visctrl.calibration.centre import Centre, find_centre
from visctrl.calibration.edges import Segments, find_segments
from visctrl.hal.cameras.catalogue import parse_camera
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.files import FORMATS, Format, find_camera, write_camera
from visctrl.robots.errors import InputError
from visctrl.robots.files import write_bytes, writing
from visctrl.runtime.recording import SUFFIXES, image_files, read_image

Grey = NDArray[np.uint8]

#: Relative standard deviation of a focal length that deserves a word.
_VAGUE = 0.005


@dataclass(frozen=True)
class Mounting:
    """What images of a board do not say about a camera."""

    axis: str
    polar_deg: tuple[float, float] | None
    mirrored: bool


def calibrate_camera(
    sources: Sequence[Path],
    board: Board,
    model: Model,
    mounting: Mounting,
    out: Path | None,
    form: str,
    *,
    as_json: bool,
) -> None:
    """Calibrate a camera from images of a board, report, and write the file.

    Raises
    ------
    InputError
        Images or options cannot be used, or the board is not found.
    """
    form = _format(form)
    files = _files(sources)
    images = _images(files)
    size = (images[0].shape[1], images[0].shape[0])
    seen, unseen = [], []
    for path, image in _tracked(list(zip(files, images, strict=True)), "looking for the board"):
        # A mirror's picture is turned round, so that markers can be read.
        corners = board.find(np.ascontiguousarray(image[:, ::-1]) if mounting.mirrored else image)
        if corners is None:
            unseen.append(str(path))
        else:
            seen.append(BoardView(str(path), corners))
    if not seen:
        more = f" nor in the {len(files) - 1} others" if len(files) > 1 else ""
        raise InputError(
            f"{files[0]}: no {board.kind} of {board.columns}x{board.rows} squares found here"
            f"{more}: check --board and --size (squares, not corners), focus and light"
        )
    name = out.stem if out is not None else "camera"
    try:
        result = calibrate(board, seen, size, model, name)
    except InputError as error:
        where = f"; not found in {', '.join(unseen)}" if unseen else ""
        raise InputError(f"{files[0].parent}: {error}{where}") from error
    camera = _mounted(result, mounting)
    if out is not None:
        write_camera(camera, out, form)
    report = _report(result, camera, unseen)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        _show_camera(result, camera, unseen, out)


def calibrate_centre(
    sources: Sequence[Path], camera: str | None, out: Path | None, form: str, *, as_json: bool
) -> None:
    """Find the projection centre of an omnidirectional camera, report, and write the file.

    Raises
    ------
    InputError
        Images or options cannot be used, or they show no vertical lines.
    """
    form = _format(form)
    if out is not None and camera is None:
        raise InputError("--out: say with --camera which calibration shall get the new centre")
    known = find_camera(camera) if camera is not None else None
    files = _files(sources)
    images = _images(files, known)
    size = (images[0].shape[1], images[0].shape[0])
    pairs = _tracked(list(zip(files, images, strict=True)), "looking for lines")
    parts = {str(path): find_segments(image) for path, image in pairs}
    whole = Segments.joined(list(parts.values()))
    try:
        centre = find_centre(whole, size, seed=0)
    except InputError as error:
        others = f" (and {len(files) - 1} more images)" if len(files) > 1 else ""
        raise InputError(f"{files[0]}{others}: {error}") from error
    if known is not None and out is not None:
        x, y = centre.point.tolist()
        write_camera(known.altered(cx=x, cy=y), out, form)
    report = _centre_report(centre, parts, size)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        _show_centre(report, known, out)


def convert(source: str, cam: int | None, out: Path, form: str, changes: dict[str, Any]) -> None:
    """Read a calibration of any known format and write it in another.

    Raises
    ------
    InputError
        It cannot be read, or the format cannot hold it.
    """
    camera = find_camera(source, cam)
    if changes:
        camera = parse_camera({**camera.model_dump(), **changes}, source)
    write_camera(camera, out, _format(form))


def draw_board(board: Board, out: Path, px_per_square: int) -> None:
    """Write a board as a picture to print.

    Raises
    ------
    InputError, DiskError
        The file cannot be written.
    """
    import cv2

    picture, _ = board.picture(px_per_square)
    try:
        encoded, data = cv2.imencode(out.suffix or ".", picture)
    except cv2.error:
        encoded = False
    if not encoded:
        raise InputError(f"{out}: cannot be written as a picture: name a .png")
    with writing(out):
        write_bytes(out, data.tobytes())
    width, height = (100.0 * side for side in board.size_m)
    print(f"{out}: print it so that the squares together measure {width:g} x {height:g} cm")


def parse_size(text: str) -> tuple[int, int]:
    """Return (columns, rows) of ``8x6``.

    Raises
    ------
    InputError
        It is not of that form.
    """
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None:
        raise InputError(f"--size {text}: expected squares across x down, as 8x6")
    return int(match[1]), int(match[2])


def _mounted(result: Calibration, mounting: Mounting) -> CentralCamera:
    """Return the camera with its field of view and the way it is mounted."""
    camera = result.camera
    if mounting.mirrored:
        camera = camera.stretched(-1.0, 1.0).altered(cx=camera.width - 1 - camera.cx)
    if mounting.polar_deg is not None:
        low, high = mounting.polar_deg
    elif mounting.axis == "forward":
        low, high = 0.0, camera.widest_polar_deg
    else:
        low, high = (math.degrees(angle) for angle in result.polar)
    try:
        return camera.altered(optical_axis=mounting.axis, min_polar_deg=low, max_polar_deg=high)
    except ValueError:
        raise InputError(
            f"--polar {low:g} {high:g}: expected 0 <= least < greatest <= 180 degrees"
        ) from None


def _report(result: Calibration, camera: CentralCamera, unseen: list[str]) -> dict[str, Any]:
    names = ("xi", "fx", "fy", "cx", "cy")
    return {
        "camera": camera.model_dump(mode="json"),
        "sigmas": dict(zip(names, result.fit.sigmas.tolist(), strict=True)),
        "rms_px": result.fit.total_rms,
        "images": result.rms,
        "bad": list(result.bad),
        "corners_left_out": result.corners_left_out,
        "not_found": unseen,
        "repeats": list(result.repeats),
        "misfit_px": result.fit.misfit_px,
        "polar_deg": [math.degrees(angle) for angle in result.polar],
    }


def _show_camera(
    result: Calibration, camera: CentralCamera, unseen: list[str], out: Path | None
) -> None:
    fit = result.fit
    for name in sorted(result.rms):
        verdict = "  BAD, left out" if name in result.bad else ""
        print(f"{name}  {result.rms[name]:.3f} px{verdict}")
    for name in unseen:
        print(f"{name}  board not found")
    for name in result.repeats:
        print(f"{name}  shows the board where another image does, left out")
    low, high = (math.degrees(angle) for angle in result.polar)
    values = zip(("xi", "fx", "fy", "cx", "cy"), fit.sigmas.tolist(), strict=True)
    print("  ".join(f"{key} {getattr(camera, key):.4f} ± {sd:.4f}" for key, sd in values))
    used = len(fit.residuals)
    seen = f"corners {low:.0f} to {high:.0f} deg off axis"
    print(f"{used} images, rms {fit.total_rms:.3f} px; {seen}")
    if result.corners_left_out:
        print(f"{result.corners_left_out} single corners left out")
    if fit.misfit_px > MISFIT_PX:
        print(
            f"visctrl: this model fits to {fit.misfit_px:.2f} px only: corners of a place are off "
            "together (lens distortion?); the standard deviations include it",
            file=sys.stderr,
        )
    vague = max(fit.sigmas[1:3] / np.abs(fit.intrinsics[1:3]))
    if vague > _VAGUE:
        print(
            f"visctrl: the focal length is known to {100 * vague:.1f} % only: add images with the "
            "board tilted, and near the rim",
            file=sys.stderr,
        )
    if out is not None:
        print(f"written to {out}")


def _centre_report(
    centre: Centre, parts: dict[str, Segments], size: tuple[int, int]
) -> dict[str, Any]:
    """Return the centre over all images, and what each says alone (None if too little)."""
    images: dict[str, Any] = {}
    first = 0
    for name, segments in parts.items():
        count = int(centre.radial[first : first + len(segments)].sum())
        first += len(segments)
        try:
            alone: list[float] | None = find_centre(segments, size, seed=0).point.tolist()
        except InputError:
            alone = None
        images[name] = {"lines": count, "alone": alone}
    x, y = centre.point.tolist()
    known = np.array([i["alone"] for i in images.values() if i["alone"] is not None])
    spread = known.std(axis=0, ddof=1).tolist() if len(known) > 1 else None
    return {
        "cx": x,
        "cy": y,
        "sigmas": centre.sigmas.tolist(),
        "lines": int(centre.radial.sum()),
        "spread_over_images": spread,
        "images": images,
    }


def _show_centre(report: dict[str, Any], known: CentralCamera | None, out: Path | None) -> None:
    for name, image in report["images"].items():
        alone = image["alone"]
        says = f"alone ({alone[0]:.2f}, {alone[1]:.2f})" if alone else "too few alone"
        print(f"{name}  {image['lines']} vertical lines, {says}")
    (sx, sy), lines = report["sigmas"], report["lines"]
    print(
        f"centre ({report['cx']:.2f} ± {sx:.2f}, {report['cy']:.2f} ± {sy:.2f}) px, {lines} lines"
    )
    if known is not None:
        dx, dy = report["cx"] - known.cx, report["cy"] - known.cy
        print(
            f"camera '{known.name}' had ({known.cx:.2f}, {known.cy:.2f}): {dx:+.2f}, {dy:+.2f} px"
        )
    if out is not None:
        print(f"written to {out}")


def _format(name: str) -> Format:
    for form in FORMATS:
        if form == name:
            return form
    raise InputError(f"--format {name}: expected one of {', '.join(FORMATS)}")


def _files(sources: Sequence[Path]) -> list[Path]:
    """Return the image files that arguments name: files, or all images of folders."""
    files: list[Path] = []
    for source in sources:
        if os.path.isdir(source):
            here = image_files(source)
            if not here:
                raise InputError(f"{source}: no images here (looked for {', '.join(SUFFIXES)})")
            files += here
        elif os.path.exists(source):
            files.append(source)
        else:
            raise InputError(f"{source}: no such image or folder")
    return files


def _images(files: Sequence[Path], camera: CentralCamera | None = None) -> list[Grey]:
    """Read images, all of one size."""
    images = [read_image(path, camera) for path in files]
    for path, image in zip(files, images, strict=True):
        if image.shape != images[0].shape:
            raise InputError(
                f"{path}: is {image.shape[1]}x{image.shape[0]}, but {files[0]} is "
                f"{images[0].shape[1]}x{images[0].shape[0]}: all images must be of one camera"
            )
    return images


def _tracked(pairs: Sequence[tuple[Path, Grey]], what: str) -> Iterable[tuple[Path, Grey]]:
    console = Console(stderr=True)
    return track(pairs, what, console=console, transient=True, disable=not console.is_terminal)
