"""The contract of a camera: every central camera, whatever its projection model.

A central camera sees along rays through one point, so a projection model is a map between rays
and pixels, one model a file in `visctrl.hal.cameras.models`. What is above sees rays and asks a
camera what it needs to know (is the picture rectilinear, how many pixels are a radian, how far
does the field go); no code outside of a model reads its parameters.

Camera axes: z is the optical axis. *Robot rays* are unit vectors (right, forward, up) in the
robot's frame, whatever the mounting.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, model_validator

from visctrl.robots.documents import StrictModel
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Degrees = Annotated[float, Field(ge=0, le=180)]

#: Pixels along a side that a calibration may claim.
MOST_PIXELS = 32_768


def _not_zero(focal: float) -> float:
    if focal == 0.0:
        raise ValueError("a focal length cannot be 0")
    return focal


Focal = Annotated[float, AfterValidator(_not_zero)]

_OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])
# Columns are the camera's x, y, z axes in robot coordinates (right, forward, up).
_MOUNTINGS: dict[str, Array] = {
    "forward": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}
#: Rounding of a field's bound (cosine), and distance kept from a model's own limit.
_MARGIN, _LIMIT_MARGIN = 1e-12, 1e-9


class CentralCamera(StrictModel, ABC):
    """A central camera: projection model, image size, field of view, orientation on the robot.

    Pixels are (u, v), the centre of the first pixel at (0, 0); (cx, cy) is the image of the
    optical axis. A catadioptric camera looks up into its mirror, and its model's z axis points
    down: ``optical_axis`` is ``down``, the image centre shows the robot, and elevation grows
    outwards.

    A model derives from this class, names
    itself in ``model`` and fills in what is abstract.
    """

    model: str
    name: str
    width: Annotated[int, Field(gt=0, le=MOST_PIXELS)]
    height: Annotated[int, Field(gt=0, le=MOST_PIXELS)]
    cx: float
    cy: float
    optical_axis: Literal["forward", "down", "up"] = "forward"
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    min_polar_deg: Degrees = 0.0
    max_polar_deg: Degrees = 90.0

    @model_validator(mode="after")
    def _field_not_empty(self) -> Self:
        if self.min_polar_deg >= self.max_polar_deg:
            raise ValueError("min_polar_deg must be less than max_polar_deg")
        return self

    def __eq__(self, other: object) -> bool:
        # What has been computed and kept beside the fields is arrays, which do not compare.
        return type(self) is type(other) and self._values == other._values

    def __hash__(self) -> int:
        return hash((type(self), self._values))

    @property
    def _values(self) -> tuple[object, ...]:
        """What the fields hold."""
        return tuple(getattr(self, key) for key in type(self).model_fields)

    # --- the projection model ----------------------------------------------------------------

    @abstractmethod
    def project(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """Project rays in camera axes to pixels.

        Parameters
        ----------
        rays : (..., 3) array
            Directions or points, not necessarily of unit length.

        Returns
        -------
        pixels : (..., 2) array
            NaN where the ray has no image.
        valid : (...) bool array
            The ray is in the field of view and falls into the image.
        """

    @abstractmethod
    def unproject(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Return the unit rays (..., 3) in camera axes of pixels (..., 2), and their validity.

        A ray is valid when the pixel lies in the image of the field of view; elsewhere it is
        NaN where the model has none (outside of its image circle).
        """

    @abstractmethod
    def jacobian(self, rays: ArrayLike) -> Array:
        """Return ∂pixel/∂ray (..., 2, 3) at the unit vectors along ``rays`` (..., 3).

        It is the derivative of `project` for points on the unit sphere; its null direction is
        the ray itself.
        """

    @property
    @abstractmethod
    def limit(self) -> float:
        """Optical-axis component of a unit ray down to which the model is one to one.

        −1 for a model that images every ray.
        """

    @property
    def rectilinear(self) -> bool:
        """Whether straight lines in space have straight images."""
        return False

    @property
    def pixels_per_radian(self) -> float:
        """Pixels per radian at the optical axis, along the image's rows."""
        return float(abs(self.jacobian(_OPTICAL_AXIS)[0, 0]))

    @property
    @abstractmethod
    def K(self) -> Array:
        """(3, 3) affine part of the model: from its normalised plane to pixels."""

    @property
    @abstractmethod
    def coefficients(self) -> dict[str, float]:
        """Parameters of the model besides `K`, by name, in their usual order."""

    @abstractmethod
    def stretched(self, across: float, down: float) -> Self:
        """Return the camera whose picture is this one's, stretched about its principal point.

        Parameters
        ----------
        across, down : float
            Factors of the picture's two axes; a negative one reverses it.
        """

    @cached_property
    def field(self) -> tuple[float, float]:
        """Least and greatest optical-axis component of a unit ray in the field of view."""
        low = math.cos(math.radians(self.max_polar_deg))
        high = math.cos(math.radians(self.min_polar_deg))
        limit = math.nextafter(self.limit + _LIMIT_MARGIN, math.inf)
        return max(low - _MARGIN, limit), high + _MARGIN

    @property
    def widest_polar_deg(self) -> float:
        """Greatest angle from the optical axis (deg) that the model sees within the picture."""
        whole = self.altered(min_polar_deg=0.0, max_polar_deg=180.0)
        u, v = np.arange(self.width), np.arange(self.height)
        sides = [
            *(np.stack([u, np.full(u.shape, y)], axis=-1) for y in (0, self.height - 1)),
            *(np.stack([np.full(v.shape, x), v], axis=-1) for x in (0, self.width - 1)),
        ]
        rays, valid = whole.unproject(np.concatenate(sides))
        if not valid.all():  # the rim of the model's image circle lies within the picture
            return math.degrees(math.acos(max(-1.0, self.limit)))
        return float(np.degrees(np.arccos(rays[:, 2].min())))

    def contains(self, pixels: ArrayLike) -> Mask:
        """Return whether pixels (..., 2) lie in the image, to the outer edge of its pixels."""
        pixels = np.asarray(pixels, dtype=np.float64)
        inside = (pixels >= -0.5) & (pixels <= self._corner)
        return np.asarray(inside[..., 0] & inside[..., 1])

    # --- the camera on its robot -------------------------------------------------------------

    @cached_property
    def rotation(self) -> Array:
        """(3, 3): columns are the camera's axes in robot coordinates (right, forward, up)."""
        yaw, pitch, roll = np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg])
        return _about(2, yaw) @ _about(0, pitch) @ _about(1, roll) @ _MOUNTINGS[self.optical_axis]

    def robot_rays(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Return unit rays (..., 3) as (right, forward, up) of pixels (..., 2), and validity."""
        rays, valid = self.unproject(pixels)
        return rays @ self.rotation.T, valid

    def robot_pixels(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """Return pixels (..., 2) of robot rays (..., 3), and their validity (see `project`)."""
        return self.project(np.asarray(rays, dtype=np.float64) @ self.rotation)

    def bearing_per_pixel(self, rays: ArrayLike) -> Array:
        """Return how far (rad) one pixel's noise turns the bearings of robot rays (..., 3).

        The standard deviation (...) of the bearing atan2(right, forward) for unit standard
        deviation of either image coordinate. Infinite straight up and down.
        """
        ray = np.asarray(rays, dtype=np.float64) @ self.rotation
        up = self.rotation[2]
        # The ray turns by one radian of bearing along up × ray; up, less its part along the ray,
        # leaves the bearing alone. A pixel's noise in any direction counts by its part across
        # the latter's image.
        J = self.jacobian(ray)
        length = np.linalg.norm(ray, axis=-1, keepdims=True)
        a = (J @ (np.cross(up, ray) / length)[..., None])[..., 0]
        b = (J @ np.broadcast_to(up, ray.shape)[..., None])[..., 0]
        across = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        turn = np.full(across.shape, np.inf)
        np.divide(np.hypot(b[..., 0], b[..., 1]), across, out=turn, where=across > 0.0)
        return turn

    @property
    def panoramic(self) -> bool:
        """Whether the optical axis is vertical: every bearing is seen."""
        return self.optical_axis != "forward"

    # --- the same camera, altered ------------------------------------------------------------

    def resized(self, width: int, height: int) -> Self:
        """Return the same camera with another image size, the field of view kept.

        Raises
        ------
        InputError
            The aspect ratio differs: the field of view could not be kept.
        """
        scale = width / self.width
        if abs(height / self.height - scale) > 1e-6 * scale:
            raise InputError(
                f"camera '{self.name}' is {self.width}x{self.height}; {width}x{height} has another "
                "aspect ratio: choose a size of the same shape"
            )
        return self.stretched(scale, scale).altered(
            width=width,
            height=height,
            cx=(self.cx + 0.5) * scale - 0.5,
            cy=(self.cy + 0.5) * scale - 0.5,
        )

    def altered(self, **changes: float | str) -> Self:
        """Return a copy with some fields changed and everything checked again."""
        return type(self).model_validate({**self.model_dump(), **changes})

    @cached_property
    def _corner(self) -> Array:
        """Outer edge (2,) of the last pixel."""
        return np.array([self.width - 0.5, self.height - 0.5])


def normalised(rays: ArrayLike) -> Array:
    """Return vectors (..., 3) at unit length."""
    rays = np.asarray(rays, dtype=np.float64)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype=np.float64)


def _about(axis: int, angle: float) -> Array:
    """Return the rotation by ``angle`` (rad) about robot axis 0 right, 1 forward or 2 up."""
    s, c = math.sin(angle), math.cos(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R
