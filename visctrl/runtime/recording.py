"""Images to replay: those of a recorded run with what was sent meanwhile, or a plain folder."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.cameras.pictures import Grey, read_grey
from visctrl.hal.types import STANDSTILL, Frame, Pose, Velocity
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_text
from visctrl.runtime.images import CAMERA, INDEX, INITIAL, TARGET, TICK
from visctrl.runtime.recorder import CONFIG, IMAGES, TICKS
from visctrl.runtime.target_view import load_target

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"),
    *(".pgm", ".ppm", ".pnm", ".gif", ".webp"),
)
#: Largest table that is read (bytes).
MOST_BYTES = 512_000_000
#: Stages of a run that can be replayed.
STAGES = ("approach", "main", "final")
#: Longer numbers in file names are times, which have gaps by nature.
_MOST_DIGITS = 8
_NOWHERE = Pose(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Driven:
    """What a run's log says about a tick; a folder of images knows next to nothing.

    before : what had been sent when its frame was taken; sent : what was sent in this tick.
    """

    number: int
    t: float
    dt: float
    stage: str = "main"
    phase: str = ""
    wanted: Velocity = STANDSTILL
    before: Velocity = STANDSTILL
    sent: Velocity = STANDSTILL
    odometry: Pose = _NOWHERE
    measured: Velocity = STANDSTILL
    truth: Pose | None = None
    battery_v: float | None = None
    event: str = ""


@dataclass(frozen=True)
class Shot:
    """One use of a frame.

    role : ``target``, ``initial`` or ``tick``; ``driven`` is set for ticks only.
    age : of the frame when its tick began (s).
    """

    role: str
    sequence: int
    stamp: float
    age: float
    path: Path
    driven: Driven | None = None


@dataclass(frozen=True)
class Recording:
    """Images in the order of their use.

    source : what the user named.
    camera : file of the camera that took them, None if it is not known.
    config : file of the run's configuration, None for a plain folder.
    target : frames of the target view, read already; target_origin : where they came from.
    shots : the others; the first is an initial view.
    """

    source: Path
    camera: Path | None
    config: Path | None
    target: tuple[Frame, ...]
    target_origin: Path
    shots: tuple[Shot, ...]


def open_recording(source: Path, target: Path | None, rate_hz: Callable[[], float]) -> Recording:
    """Look at what there is to replay, and see that every file is there.

    Parameters
    ----------
    source : Path
        A run directory, its ``images`` folder, or a folder of images.
    target : Path or None
        An image or a file of ``visctrl teach`` to use as the target view instead of the run's
        (of the last image, in a plain folder).
    rate_hz : callable
        Images a second in a plain folder; asked for only then.

    Raises
    ------
    InputError
        There are no images, or some are missing; the message names the first.
    """
    if not os.path.isdir(source):
        raise InputError(f"{source}: no such run directory or folder of images")
    run = source.parent if os.path.exists(source / INDEX) else source
    if os.path.exists(run / IMAGES / INDEX):
        return _recorded_run(source, run, target)
    if os.path.exists(run / CONFIG):
        raise InputError(
            f"{source}: this run was recorded without images: run it again with --record-images"
        )
    return _plain_folder(source, target, rate_hz())


def read_image(path: Path, camera: CentralCamera | None = None) -> Grey:
    """Return an image file in grey (height, width).

    Raises
    ------
    InputError
        It is missing, no image, or of another size than the camera's.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path}: the image is missing")
    image = read_grey(path)
    if camera is not None and image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise InputError(
            f"{path}: is {width}x{height}, but camera '{camera.name}' takes "
            f"{camera.width}x{camera.height}"
        )
    return image


def image_files(folder: Path) -> list[Path]:
    """Return the image files of a folder, numbers in their names in order of value.

    Hidden files are none: beside every picture some systems leave ``._picture.jpg``.
    """
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    ]
    return sorted(files, key=lambda path: _natural(path.name))


def _recorded_run(source: Path, run: Path, target: Path | None) -> Recording:
    folder = run / IMAGES
    log = _read_log(run / TICKS)
    shots: list[Shot] = []
    targets: list[Shot] = []
    for row in _rows(folder / INDEX):
        driven = log.get(row.get("tick", ""))
        if row.get("role") == TICK and driven is None:
            continue  # The log ends before the images do: the run was cut short.
        shot = _shot(row, folder, driven)
        (targets if shot.role == TARGET else shots).append(shot)
    if not shots or shots[0].role != INITIAL:
        raise InputError(f"{folder / INDEX}: the run has no initial view: it ended before it began")
    _all_there([shot.path for shot in (*targets, *shots)])
    if target is None and not targets:
        raise InputError(f"{folder / INDEX}: the run has no target view: give one with --target")
    frames = _target_frames(target) if target else [_frame(shot) for shot in targets]
    origin = target or targets[0].path
    return Recording(source, folder / CAMERA, run / CONFIG, tuple(frames), origin, tuple(shots))


def _plain_folder(folder: Path, target: Path | None, rate_hz: float) -> Recording:
    files = image_files(folder)
    if not files:
        raise InputError(f"{folder}: no images here (looked for {', '.join(SUFFIXES)})")
    if len(files) < 2:
        raise InputError(f"{folder}: a sequence has two images or more, here is one")
    _no_gaps(files)
    origin = target or files[-1]
    frames = _target_frames(origin)
    period = 1.0 / rate_hz
    shots = [Shot(INITIAL, 0, 0.0, 0.0, files[0])]
    for i, path in enumerate(files):
        shots.append(Shot(TICK, i, i * period, 0.0, path, Driven(i, i * period, period)))
    return Recording(folder, None, None, tuple(frames), origin, tuple(shots))


def _target_frames(path: Path) -> list[Frame]:
    if path.suffix == ".npz":
        return load_target(path).frames()
    return [Frame(0.0, 0, read_image(path))]


def _frame(shot: Shot) -> Frame:
    return Frame(shot.stamp, shot.sequence, read_image(shot.path))


def _rows(path: Path) -> list[dict[str, str]]:
    """Return the whole rows of a table with their columns' names; a last one cut short is not."""
    text = io.StringIO(read_text(path, MOST_BYTES), newline="")
    try:
        rows = list(csv.DictReader(text))
    except csv.Error as error:
        raise InputError(f"{path}: is not a table: {error}") from None
    return [row for row in rows if None not in row.values() and None not in row]


def _shot(row: dict[str, str], folder: Path, driven: Driven | None) -> Shot:
    """Return what a row of the index says."""
    try:
        role, name = row["role"], row["file"]
        if role not in (TARGET, INITIAL, TICK) or Path(name).name != name:
            raise ValueError(f"row {list(row.values())}")
        stamp, age = _finite(row["stamp [s]"]), _finite(row["age [s]"])
        return Shot(role, int(row["sequence"]), stamp, age, folder / name, driven)
    except (KeyError, ValueError) as error:
        raise InputError(f"{folder / INDEX}: is not a list of recorded images: {error}") from None


def _read_log(path: Path) -> dict[str, Driven]:
    """Return what was done in each tick, by its number."""
    log: dict[str, Driven] = {}
    before: Driven | None = None
    try:
        for row in _rows(path):
            before = log[row["tick"]] = _driven(row, before)
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is not a tick log: {error}") from None
    return log


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def _driven(row: dict[str, str], before: Driven | None) -> Driven:
    def number(name: str) -> float:
        return _finite(row[name])

    if row["stage"] not in STAGES:
        raise ValueError(f"stage '{row['stage']}'")

    truth = row["x_true [m]"] != ""
    return Driven(
        number=int(row["tick"]),
        t=number("t [s]"),
        dt=number("dt [s]"),
        stage=row["stage"],
        phase=row["phase"],
        wanted=Velocity(number("v_wanted [m/s]"), number("omega_wanted [rad/s]")),
        before=before.sent if before and before.stage == row["stage"] else STANDSTILL,
        sent=Velocity(number("v_sent [m/s]"), number("omega_sent [rad/s]")),
        odometry=Pose(*map(number, ("x_odometry [m]", "y_odometry [m]", "phi_odometry [rad]"))),
        measured=Velocity(number("v_odometry [m/s]"), number("omega_odometry [rad/s]")),
        truth=Pose(*map(number, ("x_true [m]", "y_true [m]", "phi_true [rad]"))) if truth else None,
        battery_v=number("battery [V]") if row["battery [V]"] else None,
        event=row["event"],
    )


def _all_there(paths: list[Path]) -> None:
    missing = sorted({path for path in paths if not os.path.isfile(path)})
    if missing:
        more = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(f"{missing[0]}: the image is missing{more}")


def _no_gaps(files: list[Path]) -> None:
    """Refuse a numbered sequence from which images are missing."""
    found = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in files]
    parts = [match.groups() for match in found if match is not None]
    if len(parts) < len(files) or len({prefix for prefix, _ in parts}) > 1:
        return
    if max(len(digits) for _, digits in parts) > _MOST_DIGITS:
        return
    numbers = [int(digits) for _, digits in parts]
    steps = [b - a for a, b in pairwise(numbers)]
    usual = Counter(steps).most_common(1)[0][0]
    for (before, after), step in zip(pairwise(files), steps, strict=True):
        if step != usual:
            gap = f"between {before.name} and {after.name}"
            raise InputError(
                f"{before.parent}: images are missing {gap} (the others are {usual} apart): put "
                "them back, or number the images without a gap"
            )


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
