"""A camera from images of a board: which images serve, which model, how sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from visctrl.calibration.boards import Board, Corners
from visctrl.calibration.bundle import Bundle, CameraFit, camera_from
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Model = Literal["auto", "omni", "pinhole"]

_LEAST_IMAGES = 4
#: An image is bad if its distance is this many times the median image's, and more than (px):
_BAD_SHARE, _BAD_PX = 3.0, 0.3
#: A corner is wrong if it lies off by so many median distances, and by more than (px):
_CORNER_GATE, _LEAST_GATE_PX, _CORNER_ROUNDS = 4.0, 0.1, 4
#: Of the images, at least this share must be good.
_LEAST_GOOD = 0.6
#: A free ξ must lower the sum of squares by so many variances (three standard deviations).
_WORTH_XI = 9.0
#: Below so many standard deviations, ξ may as well be 0.
_DOUBTFUL = 20.0
#: Beyond this the images do not determine the camera.
_HOPELESS_PX = 5.0
#: What residuals of a place share, beyond chance (px): deserves a word; is another camera's.
MISFIT_PX, _REFUSED_PX = 0.1, 0.5
#: An image shows what another does if its corners lie within this of the other's (px).
_SAME_PX = 3.0
#: A fit this good (px) makes other starts superfluous.
_CONVINCING_PX = 0.5


@dataclass(frozen=True)
class BoardView:
    """A board seen in an image; ``name`` is the image's, for messages."""

    name: str
    corners: Corners


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera and how good it is.

    camera : sees everything its model can; the field of view is the user's to say.
    fit : over the images used, in their order.
    rms : of each image (px) by name, the bad ones included.
    bad : names of images that were left out.
    corners_left_out : wrong corners in the images that were not.
    repeats : names of images that show the board where another does; they say nothing new.
    polar : least and greatest angle from the optical axis at which corners were seen (rad).
    """

    camera: CentralCamera
    fit: CameraFit
    rms: dict[str, float]
    bad: tuple[str, ...]
    corners_left_out: int
    repeats: tuple[str, ...]
    polar: tuple[float, float]


def calibrate(
    board: Board, sights: Sequence[BoardView], size: tuple[int, int], model: Model, name: str
) -> Calibration:
    """Return the camera that took the images.

    Parameters
    ----------
    board : Board
    sights : sequence of BoardView
        The board in several poses.
    size : (width, height)
        Of the images (px).
    model : {"auto", "omni", "pinhole"}
        ``pinhole`` holds ξ at 0; ``auto`` frees it where that explains the images better.
    name : str
        Of the camera.

    Raises
    ------
    InputError
        Too few images, or they do not fit one camera.
    """
    sights, repeats = _without_repeats(sights)
    if len(sights) < _LEAST_IMAGES:
        same = f" ({len(repeats)} more show it where another does)" if repeats else ""
        raise InputError(
            f"the board was found in {len(sights)} images{same}, {_LEAST_IMAGES} are the least, "
            "and 20 all over the picture are good"
        )
    fit, used = _without_bad(board, sights, size, pinhole=model == "pinhole")
    if model == "auto" and fit.intrinsics[0] < _DOUBTFUL * fit.sigmas[0]:
        simpler = _without_bad(board, sights, size, pinhole=True)
        fit, used = _chosen((fit, used), simpler)
    found = sum(len(sights[i].corners) for i in used)
    fit = _without_wrong_corners(board, [sights[i].corners for i in used], fit)
    if fit.misfit_px > _REFUSED_PX:
        raise InputError(
            "this model does not fit: in parts of the picture all corners are off by the same, "
            f"{fit.misfit_px:.1f} px: the lens has distortion that (ξ, K) has not; calibrate with "
            "Kalibr, OpenCV or Basalt, and give that file to --camera"
        )
    camera = camera_from(fit, size, name)
    rms = dict(zip((sights[i].name for i in used), fit.rms.tolist(), strict=True))
    bad = [sight for i, sight in enumerate(sights) if i not in used]
    rms |= {sight.name: _rms_of(board, sight, fit) for sight in bad}
    return Calibration(
        camera,
        fit,
        rms,
        tuple(sight.name for sight in bad),
        found - sum(map(len, fit.residuals)),
        repeats,
        _polar(camera, sights, used),
    )


def _without_repeats(sights: Sequence[BoardView]) -> tuple[list[BoardView], tuple[str, ...]]:
    """Return the images that differ from one another, and the names of the others."""
    kept: list[BoardView] = []
    repeats: list[str] = []
    for sight in sights:
        if any(_same_view(sight.corners, other.corners) for other in kept):
            repeats.append(sight.name)
        else:
            kept.append(sight)
    return kept, tuple(repeats)


def _same_view(a: Corners, b: Corners) -> bool:
    """Return whether the corners that two images share lie in the same places."""
    _, of_a, of_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    if 2 * len(of_a) < len(a):
        return False
    moved = np.linalg.norm(a.pixels[of_a] - b.pixels[of_b], axis=1)
    return bool(np.median(moved) < _SAME_PX)


def _without_bad(
    board: Board, sights: Sequence[BoardView], size: tuple[int, int], *, pinhole: bool
) -> tuple[CameraFit, list[int]]:
    """Return the fit to the images that agree, and their numbers."""
    used = list(range(len(sights)))
    bundle = Bundle(board, [sight.corners for sight in sights], pinhole)
    fits: list[CameraFit] = []
    for _, intrinsics, poses in bundle.start(size):
        fits.append(bundle.fit(intrinsics, poses, robust=True))
        if np.median(fits[-1].rms) < _CONVINCING_PX:
            break
    if not fits:
        raise InputError("the corners fit no central camera: is it the right board?")
    fit = min(fits, key=lambda f: float(np.median(f.rms)))
    if np.median(fit.rms) > _HOPELESS_PX:
        raise InputError(
            f"the corners fit no central camera (half of the images are off by "
            f"{np.median(fit.rms):.0f} px and more): is it the right board, and one camera?"
        )
    while True:
        limit = max(_BAD_PX, _BAD_SHARE * float(np.median(fit.rms)))
        good = np.flatnonzero(fit.rms <= limit)
        used = [used[i] for i in good]
        if len(used) < max(_LEAST_IMAGES, _LEAST_GOOD * len(sights)):
            raise InputError(
                f"only {len(used)} of {len(sights)} images fit one camera: check that all were "
                "taken by it, sharp, at one size and focus"
            )
        bundle = Bundle(board, [sights[i].corners for i in used], pinhole)
        before = len(good) == len(fit.rms)
        fit = bundle.fit(fit.intrinsics, fit.poses[good], robust=False)
        if before:
            return fit, used


def _without_wrong_corners(board: Board, images: Sequence[Corners], fit: CameraFit) -> CameraFit:
    """Return the fit without single corners that lie far off, as at the rim of a mirror."""
    pinhole = fit.sigmas[0] == 0.0
    for _ in range(_CORNER_ROUNDS):
        distances = [np.linalg.norm(r, axis=1) for r in fit.residuals]
        limit = max(_LEAST_GATE_PX, _CORNER_GATE * float(np.median(np.concatenate(distances))))
        right = [d <= limit for d in distances]
        if all(r.all() for r in right):
            break
        images = [Corners(c.ids[r], c.pixels[r]) for c, r in zip(images, right, strict=True)]
        fit = Bundle(board, images, pinhole).fit(fit.intrinsics, fit.poses, robust=False)
    return fit


def _chosen(
    omni: tuple[CameraFit, list[int]], pinhole: tuple[CameraFit, list[int]]
) -> tuple[CameraFit, list[int]]:
    """Return the simpler model unless the other explains the images better."""
    if len(pinhole[1]) < len(omni[1]):
        return omni
    squares = [float((np.concatenate(fit.residuals) ** 2).sum()) for fit, _ in (omni, pinhole)]
    variance = squares[0] / max(1, 2 * sum(map(len, omni[0].residuals)))
    return omni if squares[1] - squares[0] > _WORTH_XI * variance else pinhole


def _rms_of(board: Board, sight: BoardView, fit: CameraFit) -> float:
    """Return how far an image that was left out is off, its own pose fitted alone."""
    alone = Bundle(board, [sight.corners], pinhole=True)
    return alone.pose_only(fit.intrinsics)


def _polar(
    camera: CentralCamera, sights: Sequence[BoardView], used: Sequence[int]
) -> tuple[float, float]:
    pixels = np.concatenate([sights[i].corners.pixels for i in used])
    rays, _ = camera.unproject(pixels)
    angles = np.arccos(np.clip(rays[:, 2], -1.0, 1.0))
    return float(np.nanmin(angles)), float(np.nanmax(angles))
