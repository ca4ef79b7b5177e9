"""The image centre from turns on the spot: Gauss–Newton over the centre and every view's turn.

A turn on the spot shifts all bearings alike. Where the image's centre is not where the calibration
has it, by a, the shift varies over the field as a times the difference of two harmonics of the
bearing: two numbers that every turn of some 20 deg determines, whatever the depths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visctrl.contracts import Health, Views
from visctrl.hal.cameras.central import CentralCamera
from visctrl.robots.unicycle import wrap_angle
from visctrl.schemes.arrival.displacement import CAUCHY, Array

_ROUNDS, _SETTLED_PX = 10, 1e-4
#: What the centre is expected to be off by (px of an image 800 px wide), and what motion of the
#: camera during a turn, and the depths, leave in a bearing (rad).
_PRIOR_PX, _WIDTH = 15.0, 800.0
_MOTION_RAD = 2e-3
#: Turns that are used: views so far apart, over so much in all (rad), while the robot drives no
#: farther than this; a camera farther than this from the turning centre shows parallax (m).
_EVERY_RAD, _LEAST_TURN_RAD, _DRIVEN_M, _LEVER_M = math.radians(8.0), math.radians(22.0), 0.01, 0.01
#: So many standard deviations make a centre certainly another one.
_CERTAIN = 5.0
#: So many times what is expected is more than a centre can be off by.
_FAR_OFF = 2.5


@dataclass(frozen=True)
class Centre:
    """Where the image centre seems to be.

    camera : whose calibration is wrong.
    offset : (2,), the true centre minus the calibration's (px). sd : (2,).
    turns : (V,) of the views (rad).
    """

    camera: CentralCamera
    offset: Array
    sd: Array
    turns: Array

    @property
    def off(self) -> bool:
        """Whether the calibration's centre is certainly another one."""
        return bool((np.abs(self.offset) > _CERTAIN * self.sd).any())

    @property
    def far_off(self) -> bool:
        """Whether it is farther off than a centre can be: the robot has not just turned."""
        return bool(np.hypot(*self.offset) > _FAR_OFF * _PRIOR_PX * self.camera.width / _WIDTH)

    def corrected(self, views: Views) -> Views:
        """Return views as a camera with this centre would give them."""
        target, current = (
            centred(self.camera, rays, self.offset) for rays in (views.target, views.current)
        )
        return replace(views, target=target, current=current)

    def __str__(self) -> str:
        (right, down), (right_sd, down_sd) = self.offset, self.sd
        sideways, upright = "right" if right > 0 else "left", "lower" if down > 0 else "higher"
        return (
            f"the image centre seems to be {abs(right):.1f} ± {right_sd:.1f} px to the {sideways} "
            f"and {abs(down):.1f} ± {down_sd:.1f} px {upright} than calibrated"
        )


def centred(camera: CentralCamera, rays: Array, offset: Array) -> Array:
    """Return the true rays of rays (N, 3) that were seen with a centre off by (2,) pixels."""
    pixels = camera.robot_pixels(rays)[0]
    found = camera.robot_rays(pixels - offset)[0]
    return np.where(np.isfinite(found), found, rays)


def centre_of_turns(
    camera: CentralCamera, target: Array, turned: Sequence[Array], sigma: float
) -> Centre:
    """Fit the image centre to views that differ by turns on the spot.

    Parameters
    ----------
    camera : CentralCamera
        The calibration that the rays come from.
    target : (N, 3)
        Unit rays of the first view.
    turned : sequence of (N, 3)
        Of the others; NaN where a feature is not seen.
    sigma : float
        Standard deviation of one bearing (rad).
    """
    offset, noise = np.zeros(2), math.hypot(math.sqrt(2.0) * sigma, _MOTION_RAD)
    prior = _PRIOR_PX * camera.width / _WIDTH
    turns = np.zeros(len(turned))
    for _ in range(_ROUNDS):
        information, rhs = np.eye(2) / prior**2, -offset / prior**2
        excess: list[Array] = []
        for k, rays in enumerate(turned):
            shift = _shifts(camera, target, rays, offset)
            middle = np.angle(np.nanmean(np.exp(1j * shift[0])))
            turns[k] = middle + np.nanmedian(wrap_angle(shift[0] - middle))
            error = wrap_angle(shift[0] - turns[k])
            known = np.isfinite(shift).all(axis=0)
            residual, slope = error[known] / noise, shift[1:, known].T / noise
            weight = 1.0 / (1.0 + (residual / CAUCHY) ** 2)
            # The turn itself takes what all bearings have in common.
            slope = slope - (weight[:, None] * slope).sum(axis=0) / weight.sum()
            residual = residual - (weight * residual).sum() / weight.sum()
            information = information + (weight[:, None] * slope).T @ slope
            rhs = rhs - (weight[:, None] * slope).T @ residual
            excess.append(weight * residual**2)
        step = np.linalg.solve(information, rhs)
        offset = offset + step
        if np.abs(step).max() < _SETTLED_PX:
            break
    spread = max(1.0, float(np.concatenate(excess).mean()))
    sd = np.sqrt(np.diag(np.linalg.inv(information)) * spread)
    return Centre(camera, offset, np.asarray(sd), turns)


class TurnWatch:
    """Collects the views of a turn on the spot, and learns the image centre from them.

    Parameters
    ----------
    camera : CentralCamera
        The calibration that the rays come from.
    lever : float
        The camera's distance from the turning centre (m): one that is carried round sees
        parallax, and nothing is learnt.
    """

    def __init__(self, camera: CentralCamera, lever: float) -> None:
        self._camera = camera
        self._still = abs(lever) < _LEVER_M
        self._views: list[Views] = []
        self._headings: list[float] = []
        self._driven = 0.0
        #: What the turns so far have shown, the one that was best determined.
        self.centre: Centre | None = None

    def add(self, views: Views, heading: float, driven: float) -> bool:
        """Take a view; return whether the centre is known better now.

        heading : of the robot by its wheels (rad). driven : how far it drove since the last (m).
        """
        self._driven += abs(driven)
        if self._driven > _DRIVEN_M:
            self._views.clear()
            self._headings.clear()
            self._driven = 0.0
        if not self._still or views.health is Health.LOST:
            return False
        if self._headings and abs(heading - self._headings[-1]) < _EVERY_RAD:
            return False
        self._views.append(views)
        self._headings.append(heading)
        if abs(heading - self._headings[0]) < _LEAST_TURN_RAD:
            return False
        found = self._learn()
        better = self.centre is None or found.sd.max() < self.centre.sd.max()
        self.centre = found if better else self.centre
        return better

    def corrected(self, views: Views) -> Views:
        """Return views as they would be with the centre that was learnt, if it is off at all."""
        if self.centre is None or not self.centre.off:
            return views
        return self.centre.corrected(views)

    def _learn(self) -> Centre:
        first, *others = self._views
        turned = []
        for views in others:
            rays = np.full((len(first), 3), np.nan)
            _, here, there = np.intersect1d(
                first.ids, views.ids, assume_unique=True, return_indices=True
            )
            rays[here] = views.current[there]
            turned.append(rays)
        return centre_of_turns(self._camera, first.current, turned, first.sigma)


def _shifts(camera: CentralCamera, target: Array, rays: Array, offset: Array) -> Array:
    """Return the bearings' shifts (N,) and their derivatives by the centre: (3, N)."""
    step = 0.5

    def shift(at: Array) -> Array:
        now, then = (centred(camera, each, at) for each in (rays, target))
        bearing = np.arctan2(now[:, 0], now[:, 1]) - np.arctan2(then[:, 0], then[:, 1])
        return np.asarray(wrap_angle(bearing))

    columns = [shift(offset)]
    for axis in (np.array([step, 0.0]), np.array([0.0, step])):
        ahead, behind = shift(offset + axis), shift(offset - axis)
        columns.append(np.asarray(wrap_angle(ahead - behind)) / (2.0 * step))
    return np.stack(columns)
