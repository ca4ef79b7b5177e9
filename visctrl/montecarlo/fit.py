"""The constrained tensor fit of many robots at once: `visctrl.estimation.constrained` in arrays.

R robots, N features; the robots come first in every array. The equations and the constants are
those of the single fit, which is also what these functions are tested against.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.estimation.initial_view import AGREEMENT, ALIKE, AT_MOST, CONDITION
from visctrl.geometry.trifocal import current_view_basis, directions, initial_view_basis
from visctrl.geometry.trifocal_fit import CONVERGED, LONGEST_STEP, PACE, TINY, WIDTH

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Fits(NamedTuple):
    """R fits: see `visctrl.geometry.trifocal_fit.Fit`.

    z (R, 4), covariance (R, 4, 4), residuals (R, N), slopes (R, 4, N), jacobian (R, 4, N),
    weights (R, N), spread (R,).
    """

    z: Array
    covariance: Array
    residuals: Array
    slopes: Array
    jacobian: Array
    weights: Array
    spread: Array


class Couplings(NamedTuple):
    """R couplings: see `visctrl.geometry.trifocal_fit.Coupling`."""

    by_initial: Array
    sensitivity: Array
    information: Array
    gradient: Array


class Relations:
    """The trilinear relations of R drives with their fixed views.

    Parameters
    ----------
    initial, target : (R, N, 3) arrays
        Unit rays of the fixed views.
    """

    def __init__(self, initial: Array, target: Array) -> None:
        (u, du), (w, dw) = directions(initial), directions(target)
        pairs = [a[:, None] * b for a, b in ((u, w), (du, w), (u, dw))]
        # (R, 2, 2, 3, N): u ⊗ w and its derivatives.
        self._pairs = np.ascontiguousarray(np.moveaxis(np.stack(pairs), (0, 3), (3, 0)))

    def forms(self, current: Array) -> Array:
        """Return the forms (R, 8, 4, N) of the relations with the current rays (R, N, 3)."""
        v, dv = (np.moveaxis(d, 1, 0) for d in directions(current))
        pairs = self._pairs
        count, features = len(pairs), pairs.shape[-1]
        forms = np.empty((count, 2, 2, 2, 4, features))
        for j in (0, 1):
            along, across = v[:, j, None, None, None], dv[:, j, None, None]
            np.multiply(pairs, along, out=forms[:, :, j, :, :3])
            np.multiply(pairs[..., 0, :], across, out=forms[:, :, j, :, 3])
        return forms.reshape(count, 8, 4, features)


def refine(forms: Array, start: Array, sigma: Array, *, iterations: int = 20) -> Fits:
    """Refine z (R, 4) from ``start`` within forms (R, 4, 4, N): see `trifocal_fit.refine`.

    Every robot stops where it would stop alone.
    """
    found = _first_step(forms, start / np.linalg.norm(start, axis=1)[:, None], sigma)
    fits, far = found
    for _ in range(iterations - 1):
        if not far.any():
            break
        index = np.flatnonzero(far)
        again, still = _first_step(forms[index], fits.z[index], sigma[index])
        for whole, part in zip(fits, again, strict=True):
            whole[index] = part
        far[index] = still
    return fits


def _first_step(forms: Array, z: Array, sigma: Array) -> tuple[Fits, Mask]:
    """Do one Gauss–Newton step; return the fits, and which robots have to go on."""
    count, _, _, features = forms.shape
    values = (z[:, None] @ forms.reshape(count, 4, -1)).reshape(count, 4, features)
    square = values * values
    inverse = 1.0 / np.sqrt(np.maximum(square[:, 1] + square[:, 2] + square[:, 3], 1e-24))
    residual = values[:, 0] * inverse
    slopes = values * (-residual * inverse * inverse)[:, None]
    slopes[:, 0] = inverse
    jacobian = weighted_sum(forms, slopes)
    middle = features // 2
    spread = 1.4826 * np.partition(np.abs(residual), middle, axis=1)[:, middle]
    spread = np.maximum(spread, sigma)
    root = 1.0 / (1.0 + np.square(residual * (1.0 / (WIDTH * spread))[:, None]))
    weights = root * root
    total = weights.sum(axis=1)
    curvature = 4.0 * (weights * root).sum(axis=1) - 3.0 * total
    pace = np.where(curvature > 0.0, total / np.where(curvature > 0.0, curvature, 1.0), PACE)
    weighted = jacobian * weights[:, None]
    information = weighted @ jacobian.swapaxes(1, 2)
    across = _inverse_across(information, z)
    step = times(across, times(weighted, residual))
    longest = LONGEST_STEP / np.maximum(np.linalg.norm(step, axis=1), 1e-300)
    step *= -np.minimum(np.minimum(pace, PACE), longest)[:, None]
    z = z + step
    z /= np.linalg.norm(z, axis=1)[:, None]
    length = np.sqrt(np.maximum((step * times(information, step)).sum(axis=1), 0.0))
    residual = residual + (step[:, None] @ jacobian)[:, 0]
    covariance = (spread**2)[:, None, None] * across
    fits = Fits(z, covariance, residual, slopes, jacobian, weights, spread)
    return fits, length >= CONVERGED * spread


def weighted_sum(forms: Array, slopes: Array) -> Array:
    """Return Σ_i slopes[:, i] forms[:, :, i], (R, k, N)."""
    total = forms[:, :, 0] * slopes[:, None, 0]
    for i in (1, 2, 3):
        total += forms[:, :, i] * slopes[:, None, i]
    return np.asarray(total)


def couple(forms: Array, fits: Fits, jacobian: Array) -> Couplings:
    """Return the couplings to the initial views; forms (R, 8, 4, N), jacobian (R, 4, 2)."""
    by_initial = initial_view_basis(fits.z) @ jacobian
    count = len(forms)
    within = by_initial.swapaxes(1, 2) @ forms.reshape(count, 8, -1)
    by_q = weighted_sum(within.reshape(count, 2, 4, -1), fits.slopes)
    weighted = by_q * (fits.weights / fits.spread[:, None] ** 2)[:, None]
    mixed = fits.jacobian @ weighted.swapaxes(1, 2)
    shift = -fits.covariance @ mixed
    information = by_q @ weighted.swapaxes(1, 2) + mixed.swapaxes(1, 2) @ shift
    return Couplings(by_initial, shift, information, -times(weighted, fits.residuals))


class InitialViews:
    """The initial views of R drives and their filters: see `InitialViewFilter`.

    Parameters
    ----------
    prior : (R, 2) array
        Heading of the initial view, and the bearing at which it sees the target (rad).
    covariance : (R, 2, 2) array
        Of the prior, finite.

    Attributes
    ----------
    state, covariance : (R, 2), (R, 2, 2) arrays
        The best ones so far.
    """

    def __init__(self, prior: Array, covariance: Array) -> None:
        self.prior, self.state, self.covariance = prior, prior.copy(), covariance
        self._prior_information = np.linalg.inv(covariance)
        self._information = np.zeros_like(covariance)
        self._weighted = np.zeros_like(prior)
        self._best = np.zeros(len(prior))

    @property
    def target(self) -> Array:
        """The target's positions (R, 2) as (right, forward), of unit length."""
        bearing = self.state[:, 1]
        return np.stack([np.sin(bearing), np.cos(bearing)], axis=1)

    @property
    def basis(self) -> Array:
        """(R, 8, 4): the tensors that have these initial views."""
        phi = self.state[:, 0]
        view = np.concatenate([np.stack([np.cos(phi), np.sin(phi)], axis=1), self.target], axis=1)
        return current_view_basis(view)

    @property
    def jacobian(self) -> Array:
        """(R, 4, 2): derivatives of the view parameters by (phi, bearing)."""
        (phi, bearing), J = self.state.T, np.zeros((len(self.state), 4, 2))
        J[:, 0, 0], J[:, 1, 0] = -np.sin(phi), np.cos(phi)
        J[:, 2, 1], J[:, 3, 1] = np.cos(bearing), -np.sin(bearing)
        return J

    def update(self, known: Couplings) -> None:
        """Take in what one tick's fits say."""
        information = 0.5 * (known.information + known.information.swapaxes(1, 2))
        first = ~self._information.any(axis=(1, 2))
        weight = np.where(first, 1.0, 1.0 / ALIKE)
        pull = times(information, self.state - self.prior) + known.gradient
        self._information += weight[:, None, None] * information
        self._weighted += weight[:, None] * pull
        self._best = np.maximum(self._best, _trace(information))
        excess = _trace(self._information) / np.maximum(AT_MOST * self._best, 1e-300)
        excess = np.maximum(excess, 1.0)
        self._information /= excess[:, None, None]
        self._weighted /= excess[:, None]
        self._fuse()

    def _fuse(self) -> None:
        total = self._prior_information + self._information
        values = np.linalg.eigvalsh(total)
        sound = (values[:, 0] * CONDITION >= values[:, 1]) & (values[:, 1] > 0.0)
        alone = times(
            np.asarray(np.linalg.pinv(self._information, hermitian=True), np.float64),
            self._weighted,
        )
        together = times(np.asarray(np.linalg.inv(total), np.float64), self._weighted)
        distance2 = (self._weighted * (alone - together)).sum(axis=1)
        doubt = np.maximum(1.0, 1.0 + distance2 - AGREEMENT)
        prior = self._prior_information / doubt[:, None, None]
        covariance = np.asarray(np.linalg.inv(prior + self._information), np.float64)
        state = self.prior + times(covariance, self._weighted)
        self.covariance = np.where(sound[:, None, None], covariance, self.covariance)
        self.state = np.where(sound[:, None], state, self.state)


def _inverse_across(information: Array, z: Array) -> Array:
    """Return the pseudo-inverses (R, 4, 4) of informations whose null directions are z (R, 4)."""
    along = z[:, :, None] * z[:, None]
    size = (_trace(information) + 1e-300)[:, None, None]
    completed = information + size * (along + TINY * np.eye(z.shape[1]))
    return np.asarray(np.linalg.inv(completed) - along / size)


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrices (R, m, n) times vectors (R, n)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
