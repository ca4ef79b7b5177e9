"""Calibration boards: checkerboard and ChArUco, as points, as a picture, found in images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

_DICTIONARY = cv2.aruco.DICT_5X5_250
#: Side of a marker over the side of its square.
_MARKER_SHARE = 0.6
#: White rim of a printed board, in squares.
_RIM = 0.5
_LEAST_CORNERS = 8
#: Neither search finds all that the other does.
_SEARCHES = (
    cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY,
    cv2.CALIB_CB_NORMALIZE_IMAGE,
)
#: Half side of the window in which a corner is refined: a share of the squares' side, bounded
#: (px). Markers must stay outside of it.
_WINDOW_SHARE = {"checkerboard": 0.35, "charuco": 0.2}
_LEAST_WINDOW_PX, _MOST_WINDOW_PX = 2, 6
#: Small markers are read in an image enlarged by this factor.
_ENLARGED = 2


@dataclass(frozen=True)
class Corners:
    """Corners of a board found in an image.

    ids : (N,) numbers of the board's corners; pixels : (N, 2).
    """

    ids: NDArray[np.intp]
    pixels: Array

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Board:
    """A plane of squares.

    kind : ``checkerboard``, or ``charuco`` with markers in its white squares (5×5 bits), which
        is found also where a part of it is hidden or outside the picture.
    columns, rows : squares across and down.
    square_m : side of a square (m).
    """

    kind: Literal["checkerboard", "charuco"]
    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 4 or max(self.columns, self.rows) > 40:
            raise InputError(
                f"a board of {self.columns}x{self.rows} squares: expected 4 to 40 each way"
            )
        if not self.square_m > 0.0:
            raise InputError(f"squares of {self.square_m} m: expected a positive length")
        if self.kind == "charuco" and self.columns * self.rows // 2 > 250:
            raise InputError("a ChArUco board has at most 250 markers: choose fewer squares")

    @cached_property
    def points(self) -> Array:
        """Inner corners (N, 3) in the board's plane z = 0 (m), row by row."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
        return np.asarray(self.square_m * flat, dtype=np.float64)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the squares together (m)."""
        return self.columns * self.square_m, self.rows * self.square_m

    def picture(self, px_per_square: int) -> tuple[Grey, float]:
        """Return the board with its white rim, and the rim's width (m)."""
        rim = round(_RIM * px_per_square)
        if self.kind == "charuco":
            size = (self.columns * px_per_square, self.rows * px_per_square)
            inner = np.asarray(self._charuco.generateImage(size), dtype=np.uint8)
        else:
            row, column = np.mgrid[0 : self.rows, 0 : self.columns]
            squares = (255 * ((row + column) % 2)).astype(np.uint8)
            inner = np.kron(squares, np.ones((px_per_square, px_per_square), np.uint8))
        picture = np.pad(inner, rim, constant_values=255)
        return picture, rim / px_per_square * self.square_m

    def find(self, image: Grey) -> Corners | None:
        """Return the corners in a grey image; None where the board is not seen."""
        found = self._find_charuco(image) if self.kind == "charuco" else self._find_plain(image)
        if found is None or len(found) < _LEAST_CORNERS:
            return None
        window = _WINDOW_SHARE[self.kind] * self._side_px(found)
        return Corners(found.ids, _refined(image, found.pixels, window))

    def _find_plain(self, image: Grey) -> Corners | None:
        size = (self.columns - 1, self.rows - 1)
        for flags in _SEARCHES:
            found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
            if found:
                pixels = np.asarray(corners, np.float64).reshape(-1, 2)
                return Corners(np.arange(len(pixels)), pixels)
        return None

    def _find_charuco(self, image: Grey) -> Corners | None:
        parameters = cv2.aruco.CharucoParameters()
        parameters.minMarkers = 1
        parameters.tryRefineMarkers = True
        detector = cv2.aruco.CharucoDetector(self._charuco, parameters)
        size = (image.shape[1] * _ENLARGED, image.shape[0] * _ENLARGED)
        enlarged = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
        corners, ids, _, _ = detector.detectBoard(enlarged)
        if ids is None or len(ids) == 0:
            return None
        pixels = np.asarray(corners, np.float64).reshape(-1, 2)
        # The centre of the first pixel is at (0, 0) in both images.
        pixels = (pixels + 0.5) / _ENLARGED - 0.5
        return Corners(np.asarray(ids, np.intp).ravel(), pixels)

    @cached_property
    def _charuco(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        size = (self.columns, self.rows)
        marker = _MARKER_SHARE * self.square_m
        return cv2.aruco.CharucoBoard(size, self.square_m, marker, dictionary)

    def _side_px(self, found: Corners) -> float:
        """Return the shortest distance between neighbouring corners (px)."""
        place = np.full(len(self.points), -1)
        place[found.ids] = np.arange(len(found))
        grid = place.reshape(self.rows - 1, self.columns - 1)
        pairs = [(grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])]
        lengths = [
            np.linalg.norm(found.pixels[a[both]] - found.pixels[b[both]], axis=-1)
            for a, b in pairs
            for both in [(a >= 0) & (b >= 0)]
        ]
        every = np.concatenate(lengths)
        return float(np.quantile(every, 0.1)) if every.size else 2.0 * _LEAST_WINDOW_PX


def _refined(image: Grey, pixels: Array, window_px: float) -> Array:
    """Return corners moved to where the grey values put them."""
    window = int(np.clip(window_px, _LEAST_WINDOW_PX, _MOST_WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    start = np.ascontiguousarray(pixels[:, None], dtype=np.float32)
    moved = cv2.cornerSubPix(image, start, (window, window), (-1, -1), criteria)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)
