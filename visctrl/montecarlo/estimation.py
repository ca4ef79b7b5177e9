"""The tensor of many robots: `visctrl.estimation.tensor` with the constrained fit, in arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.estimation.constrained import CONTRADICTION, DOUBTFUL, DRIFT
from visctrl.estimation.scale import ALIKE, DELAY_SD_S
from visctrl.estimation.tensor_method import TensorOptions
from visctrl.geometry.trifocal import T111, T112, T121, T122, T212, T221
from visctrl.montecarlo.fit import Couplings, Fits, InitialViews, Relations, couple, refine, times

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Seen(NamedTuple):
    """What the law reads off the tensors of R robots: see `trifocal_law.Situation`.

    phi_1 : heading of the initial view (rad).
    regular : the fit is sound; the others need what only the single run has.
    """

    right: Array
    forward: Array
    lateral_sd: Array
    scale: Array
    scale_sd: Array
    heading: Array
    phi_1: Array
    regular: Mask


class Tensors:
    """Tensors of R robots that see the same number of features.

    Parameters
    ----------
    initial, target : (R, N, 3) arrays
        Rays of the fixed views.
    sigma : (R,) array
        Standard deviations of a bearing (rad).
    views : InitialViews
    options : TensorOptions
    """

    def __init__(
        self,
        initial: Array,
        target: Array,
        sigma: Array,
        views: InitialViews,
        options: TensorOptions,
    ) -> None:
        count = len(initial)
        self.relations, self.views = Relations(initial, target), views
        self._sigma, self._options = sigma, options
        self._driven, self._velocity = np.zeros((2, count)), np.zeros((2, count))
        self._driven, self._velocity = self._driven.T, self._velocity.T
        self._turned, self._moved = np.zeros(count), np.zeros((count, 3))
        self._heading, self._target = views.state[:, 0].copy(), views.target
        # Normal equations of the scale: n11, n12, n22, r1, r2.
        self._normal = np.zeros((count, 5))

    def update(self, current: Array, motion: Array, dt: float) -> Seen:
        """Return the situations seen along rays (R, N, 3) after the motion (R, 3) of ``dt``."""
        self._predict(motion, dt)
        forms = self.relations.forms(current)
        count, _, _, features = forms.shape
        views, sigma = self.views, self._sigma
        basis, phi_1 = views.basis, views.state[:, 0].copy()
        within = (basis.swapaxes(1, 2) @ forms.reshape(count, 8, -1)).reshape(count, 4, 4, -1)
        fits = refine(within, self._predicted(), sigma)
        limit = self._options.threshold_sigmas * np.minimum(fits.spread, DRIFT * sigma)
        agreeing = (np.abs(fits.residuals) < limit[:, None]).sum(axis=1)
        share = max(DOUBTFUL, self._options.min_inliers)
        regular = (fits.spread <= CONTRADICTION * sigma) & (agreeing >= share * features)
        self._follow(fits, phi_1)
        known = couple(forms, fits, views.jacobian)
        views.update(known)
        return self._seen(basis, phi_1, fits, known, regular)

    def _predict(self, motion: Array, dt: float) -> None:
        step = _rotated(motion[:, :2], self._turned)
        self._driven = self._driven + step
        self._velocity = step / dt
        self._moved[:, :2] += _rotated(motion[:, :2], self._moved[:, 2])
        self._moved[:, 2] += motion[:, 2]
        self._turned = self._turned + motion[:, 2]

    def _predicted(self) -> Array:
        scale, _ = self._metric()
        unit = np.where(np.isnan(scale), 0.0, 1.0 / np.where(np.isnan(scale), 1.0, scale))
        turn = self._moved[:, 2]
        ahead = _rotated(self._target - self._moved[:, :2] * unit[:, None], -turn)
        heading = self._heading + turn
        return np.concatenate([np.stack([np.cos(heading), np.sin(heading)], axis=1), ahead], axis=1)

    def _follow(self, fits: Fits, phi_1: Array) -> None:
        cosine, sine, right, forward = fits.z.T
        square = cosine**2 + sine**2
        norm = np.sqrt(square)
        self._heading = np.arctan2(sine, cosine)
        self._target = np.stack([right / norm, forward / norm], axis=1)
        self._moved = np.zeros_like(self._moved)
        self._turned = self._heading - phi_1
        seen = self.views.target - _rotated(self._target, self._turned)
        J = np.zeros((len(norm), 2, 4))
        J[:, 0, 2] = J[:, 1, 3] = 1.0 / norm
        J[:, :, 0] = -self._target * (cosine / square)[:, None]
        J[:, :, 1] = -self._target * (sine / square)[:, None]
        sd = np.sqrt(((J @ fits.covariance) * J).sum(axis=(1, 2)) / 2.0)
        weight = 1.0 / (ALIKE * np.maximum(sd, 1e-9) ** 2)
        o, v = self._driven, self._velocity
        sums = ((o * o), -(o * v), (v * v), (o * seen), -(v * seen))
        self._normal = self._normal + weight[:, None] * np.stack(
            [each.sum(axis=1) for each in sums], axis=1
        )

    def _metric(self) -> tuple[Array, Array]:
        """Return the scale (R,) in m per unit and its sd, nan and inf where unknown."""
        n11, n12, n22, r1, r2 = self._normal.T
        known = (n11 > 0.0) & (r1 > 0.0)
        n11, r1 = np.where(known, n11, 1.0), np.where(known, r1, 1.0)
        n22 = n22 + (n11 / (DELAY_SD_S * r1)) ** 2
        determinant = n11 * n22 - n12 * n12
        kappa = (n22 * r1 - n12 * r2) / determinant
        known &= kappa > 0.0
        kappa = np.where(known, kappa, 1.0)
        sd = np.sqrt(n22 / determinant) / kappa**2
        return np.where(known, 1.0 / kappa, np.nan), np.where(known, sd, np.inf)

    def _seen(
        self, basis: Array, phi_1: Array, fits: Fits, known: Couplings, regular: Mask
    ) -> Seen:
        tensor = times(basis, fits.z)
        by_initial = basis @ known.sensitivity + known.by_initial
        covariance = basis @ fits.covariance @ basis.swapaxes(1, 2)
        covariance += by_initial @ self.views.covariance @ by_initial.swapaxes(1, 2)
        first = tensor[:, T121]
        T = tensor / first[:, None]
        # Derivatives of the outputs by the tensor.
        J = np.zeros((len(T), 2, 8))
        J[:, 0, [T112, T121]] = J[:, 1, [T212, T221]] = 1.0
        xi = times(J, T)
        J[:, :, T121] -= xi
        spread = (J @ covariance @ J.swapaxes(1, 2)) / (first**2)[:, None, None]
        distance, distance_sd = self._metric()
        unit = first / np.hypot(fits.z[:, 0], fits.z[:, 1])
        sure = np.isfinite(distance_sd)
        scale = np.where(sure, distance * unit, self._options.scale_m)
        scale_sd = np.where(sure, distance_sd * np.abs(unit), np.inf)
        s, c = np.sin(phi_1), np.cos(phi_1)
        right, forward = c * xi[:, 1] + s * xi[:, 0], c * xi[:, 0] - s * xi[:, 1]
        sine = T[:, T111] + forward * s + T[:, T122] + right * c
        cosine = T[:, T121] - right * s - T[:, T112] + forward * c
        sign = np.copysign(1.0, scale)
        variance = s * s * spread[:, 0, 0] + 2 * s * c * spread[:, 0, 1] + c * c * spread[:, 1, 1]
        return Seen(
            sign * right,
            sign * forward,
            np.sqrt(np.maximum(variance, 0.0)),
            np.abs(scale),
            scale_sd,
            np.arctan2(sign * sine, sign * cosine),
            phi_1,
            regular,
        )


def _rotated(vectors: Array, angle: Array) -> Array:
    """Return vectors (R, 2) of frames turned by angles (R,) in the unturned frames."""
    s, c = np.sin(angle), np.cos(angle)
    x, y = vectors.T
    return np.stack([c * x - s * y, s * x + c * y], axis=1)
