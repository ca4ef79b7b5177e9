"""The target image as arrival is judged by: corners found again where the target has them.

Pictures are normalised locally, within the field of view only: the rim of a mirror's field
stays where it is whatever the robot does, and would pass for a coincidence. Corners are found
again by pyramidal Lucas–Kanade from no displacement at all, forward and backward: neither the
tracks nor the pose estimate that brought the robot here have a say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from visctrl.hal.cameras.central import CentralCamera
from visctrl.schemes.arrival.comparison import Comparison, whitening
from visctrl.schemes.arrival.displacement import Array, Sighting

Grey = NDArray[np.uint8]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

#: The width (px) of the images that lengths below are meant for; they grow with the image.
_WIDTH = 400
#: Half a patch (px), and the radius over which a picture is normalised.
_HALF_PX, _NORMAL_PX = 5, 8.0
#: Contrast that is not taken for texture (grey levels), and the grey levels of one deviation.
_FAINT, _SPREAD = 4.0, 40.0
#: Corners that are prepared at most, in sectors of bearing and bands of elevation, and how far
#: they are apart.
_CORNERS, _SECTORS, _BANDS, _APART_PX = 320, 16, 5, 5.0
#: A corner of one taught frame is there in another within this (px).
_REPEAT_PX = 1.0
#: A corner is used if its sharper direction is known so well (px); an edge has one such.
_SHARP_PX = 0.06
#: What noise adds to the squared gradients is taken off so many times; what is left at least.
_NOISE_GRADIENTS, _LEAST_STRUCTURE = 1.5, 0.1
#: Agreement forward and backward (px), and of the patches' looks.
_ROUND_TRIP_PX, _ALIKE = 0.5, 0.75
#: What alignment is off by besides noise (px).
_SYSTEMATIC_PX = 0.02
#: A corner coincides within this (px).
COINCIDES_PX = 0.35
_LEVELS = 2
#: A picture is from elsewhere if a smaller share of the corners coincides.
_ELSEWHERE = 0.3
#: Grey level below which what borders on pixels without a ray shows nothing, and by how much the
#: field of view then ends earlier (of the picture's width).
_UNLIT, _RIM = 12.0, 1.0 / 60.0
#: Immerkær's estimate: what this mask leaves of a picture is six times the noise.
_NOISE_MASK = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)


class ImageTarget:
    """The target's corners.

    Parameters
    ----------
    images : sequence of (height, width) uint8
        One or several pictures from the target pose.
    camera : CentralCamera
        The calibration that the robot believes in.
    """

    def __init__(self, images: Sequence[Grey], camera: CentralCamera) -> None:
        self._camera = camera
        self._unit = camera.width / _WIDTH
        self._half = round(_HALF_PX * self._unit)
        row, column = np.mgrid[0 : camera.height, 0 : camera.width]
        rays, seen = camera.robot_rays(np.stack([column, row], axis=-1).astype(np.float64))
        mean = np.asarray(np.mean(np.stack(images), axis=0), dtype=np.float32)
        seen = seen & ~_unlit(mean, seen)
        self._field = seen.astype(np.float32)
        self._weight = self._blurred(self._field)
        self._image = self._normalised(mean)
        noise = [_noise(image, seen) for image in images]
        self._noise = max(0.5, float(np.median(noise)))
        self._target_noise = self._noise / math.sqrt(len(images))
        self._structure = self._structures(mean)
        white = np.random.default_rng(0).standard_normal((128, 128), dtype=np.float32)
        inside = self._structures(white)[32:-32, 32:-32, ::2]
        self._noise_energy = float(inside.mean()) * self._target_noise**2
        usable = cv2.erode(seen.astype(np.uint8), np.ones((2 * self._half + 5,) * 2, np.uint8)) > 0
        corners = self._corners(self._image, usable)
        for image in images[:3] if len(images) > 1 else ():
            corners = self._repeated(corners, self._corners(self._normalised(image), usable))
        self._keep(self._spread(corners, rays))

    def __len__(self) -> int:
        return len(self.points)

    def _keep(self, points: Array) -> None:
        self.points = points
        self.rays = self._camera.robot_rays(points)[0]
        self._patches = self._patches_of(self._image, points)

    def leave_out_own(self, image: Grey) -> None:
        """Forget the corners that a picture from elsewhere has at the same place.

        They are on the robot itself, or on what holds the camera: they are there wherever it
        is. A picture from near the target, where all are, tells nothing of that.
        """
        if len(self) and (seen := self.compare(image)).share < _ELSEWHERE:
            self._keep(self.points[~seen.coincides])

    def compare(self, image: Grey) -> Comparison:
        """Find the corners again in a picture (height, width) uint8 of the same camera."""
        if len(self) == 0:
            return Comparison.nothing()
        normal = self._normalised(image.astype(np.float32))
        points, found = self._track(normal)
        target, current = self.rays, self._camera.robot_rays(points)[0]
        noise = math.hypot(self._target_noise, self._noise)
        covariance = np.asarray(noise**2 * np.linalg.inv(self._structure_at(self.points)), float)
        covariance += np.eye(2) * (_SYSTEMATIC_PX * self._unit) ** 2
        away = np.linalg.norm(points - self.points, axis=-1)
        coincides = found & (away < COINCIDES_PX * self._unit)
        return Comparison(
            ids=np.arange(len(self), dtype=np.int64),
            target=target,
            current=Sighting(
                np.where(found[:, None], current, np.nan),
                whitening(self._camera, self.points, covariance),
            ),
            coincides=coincides,
            contrast=self._contrast(),
        )

    def _track(self, normal: Grey) -> tuple[Array, Mask]:
        """Return where the corners are in a normalised picture, and whether they are there."""
        window = (2 * self._half + 1,) * 2
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 0.003)
        start = self.points.astype(np.float32).reshape(-1, 1, 2)
        there, ahead, _ = cv2.calcOpticalFlowPyrLK(
            self._image, normal, start, start.copy(), None, None, window, _LEVELS, ends,
            cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        back, behind, _ = cv2.calcOpticalFlowPyrLK(
            normal, self._image, there, there.copy(), None, None, window, _LEVELS, ends,
            cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        points = there.reshape(-1, 2).astype(np.float64)
        trip = np.linalg.norm((back - start).reshape(-1, 2), axis=-1)
        found = (ahead.ravel() > 0) & (behind.ravel() > 0) & (trip < _ROUND_TRIP_PX * self._unit)
        found &= self._camera.robot_rays(points)[1]
        alike = np.einsum("nij,nij->n", self._patches, self._patches_of(normal, points))
        return points, found & (alike > _ALIKE)

    def _blurred(self, image: Floats) -> Floats:
        radius = _NORMAL_PX * self._unit
        return np.asarray(cv2.GaussianBlur(image, (0, 0), radius), dtype=np.float32)

    def _normalised(self, image: Floats | Grey) -> Grey:
        """Return a picture of zero mean and unit contrast everywhere, as grey levels."""
        weight = np.maximum(self._weight, 1e-3)
        grey = image.astype(np.float32)
        deviation = np.asarray(
            (grey - self._blurred(grey * self._field) / weight) * self._field, np.float32
        )
        contrast = np.sqrt(self._blurred(deviation**2) / weight)
        normal = 128.0 + _SPREAD * deviation / np.hypot(contrast, _FAINT)
        return np.asarray(np.clip(np.rint(normal), 0, 255), dtype=np.uint8)

    def _corners(self, normal: Grey, usable: Mask) -> Array:
        """Return corner points (N, 2), the clearest first."""
        strength = cv2.cornerMinEigenVal(normal, 2 * self._half + 1)
        peak = strength == cv2.dilate(strength, np.ones((round(_APART_PX * self._unit),) * 2))
        row, column = np.nonzero(peak & usable & (strength > 0))
        order = np.argsort(-strength[row, column])
        points = np.stack([column, row], axis=-1)[order].astype(np.float64)
        spread = np.linalg.eigvalsh(np.linalg.inv(self._structure_at(points)))
        sharpest = self._noise * np.sqrt(spread[:, 0]) / self._unit
        return np.asarray(points[sharpest < _SHARP_PX])

    def _repeated(self, corners: Array, others: Array) -> Array:
        """Return the corners that another picture of the same pose has, too."""
        if not len(corners) or not len(others):
            return corners[:0]
        near = np.linalg.norm(corners[:, None] - others[None], axis=-1).min(axis=1)
        return np.asarray(corners[near < _REPEAT_PX * self._unit])

    def _spread(self, corners: Array, rays: Array) -> Array:
        """Return corners spread over bearing and elevation, so many from each cell."""
        right, forward, up = rays[corners[:, 1].astype(int), corners[:, 0].astype(int)].T
        bearing, elevation = np.arctan2(right, forward), np.arctan2(up, np.hypot(right, forward))
        sector = np.floor((bearing + math.pi) / (2 * math.pi) * _SECTORS).astype(int)
        band = np.digitize(elevation, np.radians([-40.0, -20.0, -5.0, 15.0]))
        cell = sector * _BANDS + band
        rank = np.zeros(len(corners), dtype=int)
        for each in np.unique(cell):
            inside = np.flatnonzero(cell == each)
            rank[inside] = np.arange(len(inside))
        kept = np.sort(np.argsort(rank, kind="stable")[:_CORNERS])
        return corners[kept]

    def _structures(self, image: Floats) -> Floats:
        """Return sums of products of gradients over a patch (height, width, 3): xx, xy, yy."""
        smooth = cv2.GaussianBlur(image, (0, 0), 0.7)
        gx, gy = (cv2.Scharr(smooth, cv2.CV_32F, *by, scale=1.0 / 32.0) for by in ((1, 0), (0, 1)))
        side = (2 * self._half + 1,) * 2
        parts = [cv2.boxFilter(p, -1, side, normalize=False) for p in (gx * gx, gx * gy, gy * gy)]
        return np.stack(parts, axis=-1)

    def _structure_at(self, points: Array) -> Array:
        """Return the structure matrices (N, 2, 2) at points."""
        column, row = np.rint(points).astype(int).T
        xx, xy, yy = self._structure[row, column].astype(np.float64).T
        whole = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], axis=-2)
        values, vectors = np.linalg.eigh(whole)
        # Noise alone has gradients, too: along an edge there is nothing else.
        values = np.maximum(values - _NOISE_GRADIENTS * self._noise_energy, _LEAST_STRUCTURE)
        return np.asarray((vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1))

    def _patches_of(self, normal: Grey, points: Array) -> Array:
        """Return patches (N, side, side) of zero mean and unit norm."""
        side = 2 * self._half + 1
        if not len(points):
            return np.empty((0, side, side))
        offset = np.arange(-self._half, self._half + 1, dtype=np.float32)
        x = (points[:, 0, None, None] + offset[None, None, :]).astype(np.float32)
        y = (points[:, 1, None, None] + offset[None, :, None]).astype(np.float32)
        shape = np.broadcast_shapes(x.shape, y.shape)
        x, y = (np.broadcast_to(each, shape).reshape(shape[0], side**2) for each in (x, y))
        patches = cv2.remap(
            normal.astype(np.float32), x.copy(), y.copy(), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        patches = patches.reshape(shape).astype(np.float64)
        patches -= patches.mean(axis=(1, 2), keepdims=True)
        norm = np.sqrt((patches**2).sum(axis=(1, 2), keepdims=True))
        return np.asarray(patches / np.maximum(norm, 1e-9), dtype=np.float64)

    def _contrast(self) -> Array:
        """Return how strong the corners' patches are (N,) (grey levels)."""
        structure = self._structure_at(self.points)
        strength = np.trace(structure, axis1=1, axis2=2)
        return np.asarray(np.sqrt(strength) / (2 * self._half + 1), dtype=np.float64)


def _unlit(image: Floats, seen: Mask) -> Mask:
    """Return the pixels that show nothing but darkness, where that borders on no scene.

    A mirror's or a lens's field ends there, whatever the calibration believes, towards the
    picture's edge and about the hole in its middle. Its rim stays where it is wherever the
    robot goes.

    seen : (height, width), where the calibration believes to see something.
    """
    dark = (cv2.blur(image, (5, 5)) < _UNLIT).astype(np.uint8)
    _, blobs = cv2.connectedComponents(dark)
    beyond = np.isin(blobs, np.unique(blobs[~seen & (dark > 0)])) & (dark > 0)
    side = 2 * round(image.shape[1] * _RIM) + 1
    return np.asarray(cv2.dilate(beyond.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _noise(image: Grey | Floats, seen: Mask) -> float:
    """Return the standard deviation of a picture's noise (grey levels; Immerkær, 1996)."""
    if not seen.any():
        return 0.0
    left = np.abs(cv2.filter2D(image.astype(np.float32), -1, _NOISE_MASK))[seen]
    return 1.4826 * float(np.median(left)) / 6.0
