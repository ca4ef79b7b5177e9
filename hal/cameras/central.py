"""The central camera: one model for perspective, catadioptric and fisheye cameras.

Unified sphere model (1.6), (1.7): a ray goes to the unit sphere, from there to the normalised
plane seen from a centre ξ above the sphere's centre, then to pixels by K. ξ = 0 is a
perspective camera, 0 < ξ < 1 hyper-catadioptric, ξ = 1 para-catadioptric, ξ > 1 a fisheye lens.

Camera axes: the model's z axis is the optical axis. *Robot rays* are unit vectors
(right, forward, up) in the robot's frame, whatever the mounting.
"""

from __future__ import annotations

import math
from functools import cache, cached_property
from importlib import resources
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, model_validator

from visctrl.robots.documents import StrictModel, load, suggestion
from visctrl.robots.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Degrees = Annotated[float, Field(ge=0, le=180)]


def _not_zero(focal: float) -> float:
    if focal == 0.0:
        raise ValueError("a focal length cannot be 0")
    return focal


Focal = Annotated[float, AfterValidator(_not_zero)]

_ONES = np.ones(3)
_OPTICAL_AXIS = np.array([[0.0], [0.0], [1.0]])
# Columns are the camera's x, y, z axes in robot coordinates (right, forward, up).
_MOUNTINGS: dict[str, Array] = {
    "forward": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


class CentralCamera(StrictModel):
    """A central camera: intrinsics, field of view and orientation on the robot.

    Pixels are (u, v), the centre of the first pixel at (0, 0). A catadioptric camera looks up
    into its mirror, and its model's z axis points down: ``optical_axis`` is ``down``, the image
    centre shows the robot, and elevation grows outwards. A negative ``fx`` is the left–right
    reversal of a real mirror.
    """

    name: str
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    xi: Annotated[float, Field(ge=0)]
    fx: Focal
    fy: Focal
    cx: float
    cy: float
    skew: float = 0.0
    optical_axis: Literal["forward", "down", "up"] = "forward"
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    min_polar_deg: Degrees = 0.0
    max_polar_deg: Degrees = 90.0

    @model_validator(mode="after")
    def _field_not_empty(self) -> CentralCamera:
        if self.min_polar_deg >= self.max_polar_deg:
            raise ValueError("min_polar_deg must be less than max_polar_deg")
        return self

    # --- geometry in the camera's own axes -------------------------------------------------

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
        return self._image(rays, self._forms)

    def unproject(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Return the unit rays (..., 3) in camera axes of pixels (..., 2), and their validity.

        A ray is valid when the pixel lies in the image of the field of view; elsewhere it is
        NaN where the model has none (ξ > 1 outside its image circle).
        """
        return self._rays(pixels, self._inverse, _OPTICAL_AXIS)

    def jacobian(self, rays: ArrayLike) -> Array:
        """Return ∂pixel/∂ray (..., 2, 3) at the unit vectors along ``rays`` (..., 3).

        It is the derivative of `project` for points on the unit sphere; its null direction is
        the ray itself.
        """
        unit = _normalised(rays)
        sx, sy, sz = unit[..., 0], unit[..., 1], unit[..., 2]
        depth = sz + self.xi
        # d(x, y)/d(ray) before normalisation to the sphere is removed by the tangent projector.
        plane = np.zeros((*unit.shape[:-1], 2, 3))
        plane[..., 0, 0] = plane[..., 1, 1] = 1.0 / depth
        plane[..., 0, 2] = -sx / depth**2
        plane[..., 1, 2] = -sy / depth**2
        tangent = np.eye(3) - unit[..., :, None] * unit[..., None, :]
        K = np.array([[self.fx, self.skew], [0.0, self.fy]])
        return np.asarray(K @ plane @ tangent, dtype=np.float64)

    def contains(self, pixels: ArrayLike) -> Mask:
        """Return whether pixels (..., 2) lie in the image, to the outer edge of its pixels."""
        pixels = np.asarray(pixels, dtype=np.float64)
        inside = (pixels >= -0.5) & (pixels <= self._corner)
        return np.asarray(inside[..., 0] & inside[..., 1])

    # --- geometry in the robot's axes ------------------------------------------------------

    @cached_property
    def rotation(self) -> Array:
        """(3, 3): columns are the camera's axes in robot coordinates (right, forward, up)."""
        yaw, pitch, roll = np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg])
        return _about(2, yaw) @ _about(0, pitch) @ _about(1, roll) @ _MOUNTINGS[self.optical_axis]

    def robot_rays(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Return unit rays (..., 3) as (right, forward, up) of pixels (..., 2), and validity."""
        return self._rays(pixels, self._robot_inverse, self.rotation[:, 2:])

    def robot_pixels(self, rays: ArrayLike) -> tuple[Array, Mask]:
        """Return pixels (..., 2) of robot rays (..., 3), and their validity (see `project`)."""
        return self._image(rays, self._robot_forms)

    def bearing_per_pixel(self, rays: ArrayLike) -> Array:
        """Return how far (rad) one pixel's noise turns the bearings of robot rays (..., 3).

        The standard deviation (...) of the bearing atan2(right, forward) for unit standard
        deviation of either image coordinate. Infinite straight up and down.
        """
        rays = np.asarray(rays, dtype=np.float64)
        if self._upright is not None:
            # About an upright axis the bearing is the angle about the image's centre.
            depth = rays[..., 2] * self._upright + self.xi
            level = np.hypot(rays[..., 0], rays[..., 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(np.abs(depth / (self.fx * level)), dtype=np.float64)
        ray = rays @ self.rotation
        up = self.rotation[2].tolist()
        x, y, z = ray[..., 0], ray[..., 1], ray[..., 2]
        # The ray turns by one radian of bearing along ray × up; up, less its part along the ray,
        # leaves the bearing alone. A pixel's noise in any direction counts by its part across
        # the latter's image.
        sideways = (y * up[2] - z * up[1], z * up[0] - x * up[2], x * up[1] - y * up[0])
        height = x * up[0] + y * up[1] + z * up[2]
        upwards = (up[0] - height * x, up[1] - height * y, up[2] - height * z)
        depth = z + self.xi
        a, b = ((dx * depth - x * dz, dy * depth - y * dz) for dx, dy, dz in (sideways, upwards))
        across = np.abs((self.fx * self.fy) * (a[0] * b[1] - a[1] * b[0]))
        length = np.hypot(self.fx * b[0] + self.skew * b[1], self.fy * b[1])
        turn = np.full(across.shape, np.inf)
        np.divide(length * depth * depth, across, out=turn, where=across > 0.0)
        return turn

    @cached_property
    def _upright(self) -> float | None:
        """Which way the optical axis points if it is exactly vertical and pixels are square.

        1 is up, −1 down, None is any other camera.
        """
        square = abs(self.fx) == abs(self.fy) and self.skew == 0.0
        if self.panoramic and square and self.pitch_deg == 0.0 and self.roll_deg == 0.0:
            return float(self.rotation[2, 2])
        return None

    @property
    def panoramic(self) -> bool:
        """Whether the optical axis is vertical: every bearing is seen."""
        return self.optical_axis != "forward"

    def resized(self, width: int, height: int) -> CentralCamera:
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
        return self.altered(
            width=width,
            height=height,
            fx=self.fx * scale,
            fy=self.fy * scale,
            skew=self.skew * scale,
            cx=(self.cx + 0.5) * scale - 0.5,
            cy=(self.cy + 0.5) * scale - 0.5,
        )

    def altered(self, **changes: float | str) -> CentralCamera:
        """Return a copy with some fields changed and everything checked again."""
        return CentralCamera.model_validate({**self.model_dump(), **changes})

    def _image(self, rays: ArrayLike, forms: Array) -> tuple[Array, Mask]:
        """Return what `project` returns, by the forms (see `_forms`) of the rays' axes."""
        rays = np.asarray(rays, dtype=np.float64)
        ray = np.empty((4, math.prod(rays.shape[:-1])))
        ray[:3] = rays.reshape(-1, 3).T
        np.sqrt(_ONES.dot(ray[:3] * ray[:3]), out=ray[3])
        found = forms.dot(ray)
        inside = found[3:] > 0.0
        valid = np.logical_and.reduce(inside)
        depth = found[2]
        if not valid.all():
            depth = np.where(inside[-1] & inside[-2], depth, np.nan)
        pixels = found[:2] / depth
        return pixels.T.reshape(*rays.shape[:-1], 2), valid.reshape(rays.shape[:-1])

    def _rays(self, pixels: ArrayLike, inverse: Array, axis: Array) -> tuple[Array, Mask]:
        """Return what `unproject` returns, in any axes.

        inverse : `_inverse` in these axes; axis : (3, 1), the optical axis.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        image = np.empty((3, math.prod(pixels.shape[:-1])))
        image[:2], image[2] = pixels.reshape(-1, 2).T, 1.0
        found = inverse.dot(image)
        ray = found[:3]
        square, xi = _ONES.dot(ray * ray), self.xi
        root = (1.0 - xi**2) * square + xi**2
        if xi > 1.0:
            root = np.where(root >= 0.0, root, np.nan)
        factor = (np.sqrt(root) + xi) / square
        ray *= factor
        ray -= xi * axis
        low, high = self.field
        valid = np.logical_and.reduce(found[3:] >= 0.0) & (factor >= low + xi)
        if high < 1.0:
            valid &= factor <= high + xi
        return ray.T.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])

    @cached_property
    def _forms(self) -> Array:
        """(9, 4): what is linear in a ray and its length, (x, y, z, ρ).

        The image (u, v, 1) times the depth z + ξρ, how far inside the image's four edges that
        is, and how far inside the bounds of the field of view: a ray is seen where all of the
        last six are positive.
        """
        image = np.array(
            [
                [self.fx, self.skew, self.cx, self.cx * self.xi],
                [0.0, self.fy, self.cy, self.cy * self.xi],
                [0.0, 0.0, 1.0, self.xi],
            ]
        )
        low, high = self.field
        field = np.array([[0.0, 0.0, -1.0, high], [0.0, 0.0, 1.0, -low]])
        return np.concatenate([image, self._edges.dot(image), field])

    @cached_property
    def _robot_forms(self) -> Array:
        """(9, 4): `_forms` of robot rays."""
        return np.concatenate([self._forms[:, :3].dot(self.rotation.T), self._forms[:, 3:]], axis=1)

    @cached_property
    def _inverse(self) -> Array:
        """(7, 3): takes (u, v, 1) to (x, y, 1) on the normalised plane, and to `_edges`."""
        K = np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        return np.concatenate([np.linalg.inv(K), self._edges])

    @cached_property
    def _robot_inverse(self) -> Array:
        """(7, 3): `_inverse` with the plane's points in robot axes."""
        return np.concatenate([self.rotation.dot(self._inverse[:3]), self._edges])

    @cached_property
    def _edges(self) -> Array:
        """(4, 3): takes (u, v, 1) to its distances from the outer edges of the image (px)."""
        right, bottom = self.width - 0.5, self.height - 0.5
        return np.array([[1.0, 0.0, 0.5], [-1.0, 0.0, right], [0.0, 1.0, 0.5], [0.0, -1.0, bottom]])

    @cached_property
    def field(self) -> tuple[float, float]:
        """Least and greatest optical-axis component of a unit ray in the field of view."""
        low = math.cos(math.radians(self.max_polar_deg))
        high = math.cos(math.radians(self.min_polar_deg))
        # Beyond z = −1/ξ the sphere's far side projects onto the same pixels (ξ > 1); for ξ ≤ 1
        # the limit is the plane z = −ξ through the upper centre.
        limit = -1.0 / self.xi if self.xi > 1.0 else -self.xi
        margin = 1e-12
        return max(low - margin, math.nextafter(limit + 1e-9, math.inf)), high + margin

    @cached_property
    def _corner(self) -> Array:
        """Outer edge (2,) of the last pixel."""
        return np.array([self.width - 0.5, self.height - 0.5])


@cache
def camera_names() -> tuple[str, ...]:
    """Return the names of the cameras that this package describes."""
    files = (resources.files("visctrl.hal") / "cameras").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


@cache
def load_camera(name: str) -> CentralCamera:
    """Return a camera by name.

    Raises
    ------
    InputError
        No such camera; the message lists those there are.
    """
    if name not in camera_names():
        raise InputError(f"unknown camera '{name}'; {suggestion(name, camera_names())}")
    return load(resources.files("visctrl.hal") / "cameras" / f"{name}.yaml", CentralCamera)


def _normalised(rays: ArrayLike) -> Array:
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
