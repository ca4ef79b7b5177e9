"""Displacement from the target: generalised least squares on a view that nearly is the target's.

With t the unit ray of a feature at the target, s its inverse distance there and (x, y, φ) the
pose of the camera in the target's frame, the feature is seen along

    a = (t_x − s x, t_y − s y, t_z),   β = atan2(a_x, a_y) + φ,   ε = atan2(a_z, |(a_x, a_y)|):

a part common to all bearings (the rotation) and one that grows with nearness. The depths are
integrated out, not estimated: what a feature's own depth leaves open widens the covariance of
its residual. Cauchy weights keep off what has moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visctrl.hal.types import Pose
from visctrl.robots.unicycle import wrap_angle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Inverse depth of a scene (1/m) of which nothing is known: its logarithm's mean and deviation,
#: and the spread of the features' about it, relative.
SCENE_LOG, SCENE_LOG_SD, SCENE_SPREAD = math.log(0.25), 1.0, 0.6
#: Below this elevation a feature is taken to be on the floor, whose height is known so well:
#: one by one and all together (relative; a wrong image centre tilts every elevation).
FLOOR_DEG, FLOOR_SD, FLOOR_SCALE_SD = -20.0, 0.25, 0.2
#: Cauchy's constant (standard deviations): 95 % efficient where there are no outliers.
CAUCHY = 2.385
_ROUNDS, _SETTLED = 30, 1e-7
#: What the pose is known to beforehand (m, m, rad): features that determine nothing give this.
_ANYWHERE = np.array([10.0, 10.0, math.pi])


@dataclass(frozen=True)
class Sighting:
    """One view of the target's N features.

    rays : (N, 3) unit rays (right, forward, up); NaN where a feature is not seen.
    whiten : (N, 2, 2), makes errors of (bearing · cos ε, elevation) (rad) unit noise.
    """

    rays: Array
    whiten: Array


@dataclass(frozen=True)
class Depths:
    """What is known of N features' inverse depths at the target (1/m).

    mean, sd : (N,). floor : (N,), whether they follow from the camera's height.
    scale_sd : what all others may be off by together (log).
    """

    mean: Array
    sd: Array
    floor: Mask
    scale_sd: float

    @classmethod
    def unknown(cls, count: int) -> Depths:
        """Return what is known beforehand of ``count`` features of any scene."""
        mean = np.full(count, math.exp(SCENE_LOG))
        return cls(mean, SCENE_SPREAD * mean, np.zeros(count, dtype=np.bool_), SCENE_LOG_SD)

    def with_floor(self, target: Array, height: float) -> Depths:
        """Return them with those of what lies low enough (N, 3) to be on the floor.

        height : the camera's over the floor (m).
        """
        elevation = np.arcsin(np.clip(target[:, 2], -1.0, 1.0))
        floor = elevation < math.radians(FLOOR_DEG)
        mean = np.where(floor, np.sin(-elevation) / height, self.mean)
        return replace(self, mean=mean, sd=np.where(floor, FLOOR_SD * mean, self.sd), floor=floor)


@dataclass(frozen=True)
class Displacement:
    """The remaining pose error: the camera's pose in the target's frame.

    pose : (x, y, φ) (m, m, rad).
    by_noise : (3, 3) covariance for depths of known scale, scaled by the residuals where they
        are larger than the noise that was told.
    scale_log_sd : standard deviation of the logarithm of the scale, which multiplies (x, y).
    residuals : (N,) length of the whitened residuals; NaN where a feature is not seen.
    excess : mean square of the residuals over what the noise explains.
    nearness : the features' inverse depth (1/m), their median.
    """

    pose: Pose
    by_noise: Array
    scale_log_sd: float
    residuals: Array
    excess: float
    nearness: float

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of the pose, the scale's doubt included.

        Two standard deviations reach as far as the scale does, which is off by a factor.
        """
        way = np.array([self.pose.x, self.pose.y, 0.0]) * math.expm1(2.0 * self.scale_log_sd) / 2.0
        return np.asarray(self.by_noise + np.outer(way, way))

    @property
    def distance(self) -> float:
        """Distance from the target (m)."""
        return math.hypot(self.pose.x, self.pose.y)

    @property
    def distance_sd(self) -> float:
        """Standard deviation of the position in its worst direction (m)."""
        return _worst(self.covariance)

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the position in its worst direction, were the scale known (m)."""
        return _worst(self.by_noise)

    def least_distance(self, sigmas: float) -> float:
        """Return what the distance (m) is at least, so many standard deviations off.

        The scale of the depths multiplies a distance, however uncertain, and makes none.
        """
        shrunk = self.distance * math.exp(-sigmas * self.scale_log_sd)
        return shrunk - sigmas * self.noise_sd

    @property
    def heading_sd(self) -> float:
        """Standard deviation of the heading (rad)."""
        return math.sqrt(max(0.0, float(self.covariance[2, 2])))


def _worst(covariance: Array) -> float:
    """Return the standard deviation of the position in its worst direction (m)."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))


class Linearised:
    """Errors (..., N, 2) of (bearing · cos ε, elevation) at V poses, and their derivatives.

    by_pose : (..., N, 2, 3). by_depth : (..., N, 2).
    """

    def __init__(self, target: Array, seen: Array, poses: Array, depths: Array) -> None:
        x, y, phi = poses.T[..., None]
        t = target.T
        ax, ay, az = t[0] - depths * x, t[1] - depths * y, t[2]
        flat2 = np.maximum(ax**2 + ay**2, 1e-9)
        flat, cosine = np.sqrt(flat2), np.hypot(t[0], t[1])
        bearing = np.arctan2(seen[..., 0], seen[..., 1])
        elevation = np.arctan2(seen[..., 2], np.hypot(seen[..., 0], seen[..., 1]))
        self.error = np.stack(
            [
                wrap_angle(bearing - np.arctan2(ax, ay) - phi) * cosine,
                elevation - np.arctan2(az, flat),
            ],
            axis=-1,
        )
        across = np.stack([ay, -ax], axis=-1) * (cosine / flat2)[..., None]
        along = np.stack([-az * ax, -az * ay], axis=-1) / (flat * (flat2 + az**2))[..., None]
        by_a = np.stack([across, along], axis=-2)
        turning = np.zeros((*by_a.shape[:-1], 1))
        turning[..., 0, 0] = cosine
        self.by_pose = np.concatenate([-depths[:, None, None] * by_a, turning], axis=-1)
        self.by_depth = -(by_a @ poses[..., None, :2, None])[..., 0]


def displacement(
    target: Array, current: Sighting, depths: Depths | None = None, first: Pose | None = None
) -> Displacement:
    """Fit the camera's pose in the target's frame.

    Parameters
    ----------
    target : (N, 3)
        Unit rays at the target.
    current : Sighting
        The view that is judged; at least three features must be seen.
    depths : Depths, optional
        By default nothing is known.
    first : Pose, optional
        Where to begin; at the target by default.
    """
    depths = depths or Depths.unknown(len(target))
    seen = np.isfinite(current.rays).all(axis=-1)
    fit = _Fit(
        target[seen],
        Sighting(current.rays[seen], current.whiten[seen]),
        replace(depths, mean=depths.mean[seen], sd=depths.sd[seen], floor=depths.floor[seen]),
    )
    residuals = np.full(len(target), np.nan)
    fitted = fit.solve(first or Pose(0.0, 0.0, 0.0))
    residuals[seen] = fitted.residuals
    return replace(fitted, residuals=residuals)


class _Fit:
    """Iterated generalised least squares over (x, y, φ, log scales of depths and of the floor)."""

    def __init__(self, target: Array, current: Sighting, depths: Depths) -> None:
        self._target, self._current = target, current
        self._depths = depths
        self._prior_sd = np.array([depths.scale_sd, FLOOR_SCALE_SD])
        noise = np.linalg.inv(current.whiten)
        self._noise = noise @ noise.transpose(0, 2, 1)

    def solve(self, first: Pose) -> Displacement:
        pose, scale = np.array(first), np.zeros(2)
        for _ in range(_ROUNDS):
            weight, jacobian, residual = self._whitened(pose, scale)
            information, rhs = self._normal(weight, jacobian, residual, scale)
            step = np.linalg.solve(information, rhs)
            # The model is good for a part of the depth; a longer step is taken in parts.
            step *= min(1.0, 0.3 / max(1e-12, math.hypot(*step[:2])))
            pose, scale = pose + step[:3], np.clip(scale + step[3:], -2.0, 2.0)
            if np.abs(step).max() < _SETTLED:
                break
        weight, jacobian, residual = self._whitened(pose, scale)
        information, _ = self._normal(weight, jacobian, residual, scale)
        squared = (residual**2).sum(axis=-1)
        freedom = max(1.0, 2.0 * float(weight.sum()) - 3.0)
        excess = float((weight * squared).sum()) / freedom
        by_noise = np.linalg.inv(information[:3, :3])
        by_scale = np.linalg.inv(information)[:2, :2] - by_noise[:2, :2]
        away = pose[:2] / max(1e-9, math.hypot(*pose[:2]) ** 2)
        scale_log_sd = math.sqrt(max(0.0, float(away @ by_scale @ away)))
        x, y, phi = pose.tolist()
        return Displacement(
            Pose(x, y, float(wrap_angle(phi))),
            np.asarray(by_noise * max(1.0, excess)),
            min(scale_log_sd, float(self._prior_sd.max())),
            np.sqrt(squared),
            excess,
            float(np.median(self._depths.mean)) * math.exp(scale[0]),
        )

    def _whitened(self, pose: Array, scale: Array) -> tuple[Array, Array, Array]:
        """Return weights (N,), whitened Jacobian (N, 2, 5) and residuals (N, 2)."""
        floor = self._depths.floor
        depths = self._depths.mean * np.exp(np.where(floor, scale[1], scale[0]))
        at = Linearised(self._target, self._current.rays, pose[None], depths)
        error, by_pose, by_log = at.error[0], at.by_pose[0], at.by_depth[0] * depths[:, None]
        open_ = by_log * (self._depths.sd / self._depths.mean)[:, None]
        covariance = self._noise + open_[:, :, None] * open_[:, None, :]
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        shared = np.stack(
            [np.where(floor[:, None], 0.0, by_log), np.where(floor[:, None], by_log, 0.0)],
            axis=-1,
        )
        jacobian = whiten @ np.concatenate([by_pose, shared], axis=-1)
        residual = (whiten @ error[..., None])[..., 0]
        weight = 1.0 / (1.0 + (residual**2).sum(axis=-1) / CAUCHY**2)
        return weight, jacobian, residual

    def _normal(
        self, weight: Array, jacobian: Array, residual: Array, scale: Array
    ) -> tuple[Array, Array]:
        weighted = weight[:, None, None] * jacobian
        information = np.einsum("nri,nrj->ij", weighted, jacobian)
        rhs = np.einsum("nri,nr->i", weighted, residual)
        information[range(3), range(3)] += 1.0 / _ANYWHERE**2
        information[[3, 4], [3, 4]] += 1.0 / self._prior_sd**2
        rhs[3:] -= scale / self._prior_sd**2
        return information, rhs
