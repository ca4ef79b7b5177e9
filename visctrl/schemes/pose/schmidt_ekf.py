"""A pose filter that stays consistent although nobody knows where the robot started.

The source's filter takes the initial pose C1 for exact and the noise of the two fixed views for
white, though it is the same at every step; both make it sure of a wrong pose. Here both are
part of the state,

    [x, y, φ, β, φ1, q, e1 (N), e3 (N)],        C1 = (sin β, −cos β, φ1),

positions in units of |C1|, metric pose (x/q, y/q, φ), e1 and e3 the errors of every feature's
bearing in the initial and the target view. Only odometry knows metres and it enters linearly
in q, so a wrong scale does not spoil the geometry that the images tell. Each bearing in the
current view is one measurement, predicted by exact transfer from the other two views.

What the filter is told of the noise may be wrong, and bearings contradict each other when the
camera is not as calibrated. All variances are therefore known up to a common factor only, which
is 1 until innovations turn out larger than predicted. It changes no estimate, but what counts as
an outlier, and how sure the filter says it is.

The algebra is that of an extended Kalman filter; it uses that the motion touches three numbers
and each bearing eight, which a general filter would multiply by zeros ten times as long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dtrtrs

from visctrl.geometry.trifocal.transfer import Transfer, transfer_bearing, wrap_half_turn
from visctrl.hal.types import Pose
from visctrl.robots.unicycle import arc
from visctrl.schemes.pose.leg_start import MINIMUM_PARALLAX

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Numbers that all features share.
CORE = 6
#: The place of a feature is as uncertain, relative to its range, as φ1 is relative to the
#: feature's parallax. Beyond one part in this many the transfer is no longer linear in the
#: state, and a feature that the camera comes near would make the filter sure of a wrong pose.
_PARALLAX_SIGMAS = 6.0
#: A predicted bearing less certain than this (rad) is beyond what one linear step can use.
_MAX_PREDICTED_SD = 0.1
#: Innovations beyond this many standard deviations are errors, not noise.
_GATE = 4.0
#: Weight of the newest picture in the mean of squared innovations (1 where the filter is
#: consistent), and by what factor that mean must differ from 1 before all variances follow it.
_NEWEST, _EXCESS = 0.2, 1.5
#: A square counts for at most this; the mean of such squares of standard normal variables.
_CAPPED, _CAPPED_MEAN = 9.0, 0.9950


@dataclass(frozen=True)
class Innovation:
    """One measurement update.

    nis : normalised innovation squared.
    used : positions, among the bearings given, of those that were used.
    """

    nis: float
    used: Index

    @property
    def dof(self) -> int:
        """Dimension of the innovation."""
        return len(self.used)


@dataclass(frozen=True)
class _Slopes:
    """The measurements' Jacobian H (M, 6 + 2N), of which eight numbers in a row are not zero.

    core : (6, M) by what all features share. own : (2, M) by the feature's own two errors, whose
    columns are first and third : (M,).
    """

    core: Array
    own: Array
    first: Index
    third: Index

    def times(self, right: Array) -> Array:
        """Return H right (M, K), for ``right`` (6 + 2N, K)."""
        product = self.core.T.dot(right[:CORE])
        for own, column in zip(self.own, (self.first, self.third), strict=True):
            part = right.take(column, axis=0)
            part *= own[:, None]
            product += part
        return np.asarray(product, dtype=np.float64)

    def after(self, left: Array) -> Array:
        """Return left Hᵀ (M, M), for ``left`` (M, 6 + 2N)."""
        product = left[:, :CORE].dot(self.core)
        for own, column in zip(self.own, (self.first, self.third), strict=True):
            part = left.take(column, axis=1)
            part *= own
            product += part
        return np.asarray(product, dtype=np.float64)


class SchmidtEkf:
    """Extended Kalman filter on the scale-free geometry of three views.

    Parameters
    ----------
    x : (6 + 2N,) array
        State in the order above.
    P : (6 + 2N, 6 + 2N) array
        Its covariance.
    theta1, theta3 : (N,) arrays
        Measured bearings of the features in the initial and the target view (rad).

    Attributes
    ----------
    factor : float
        By which all variances are greater than was said, at least 1.
    """

    def __init__(self, x: Array, P: Array, theta1: Array, theta3: Array) -> None:
        self.x, self.P = x.copy(), P.copy()
        self.theta1, self.theta3 = theta1.copy(), theta3.copy()
        self.factor, self._excess = 1.0, 1.0

    @property
    def count(self) -> int:
        """Number of features in the state."""
        return len(self.theta1)

    # --- prediction ------------------------------------------------------------------------

    def advance(self, v: float, omega: float, dt: float, offset: float, noise: Array) -> None:
        """Predict along the exact arc of a velocity.

        Parameters
        ----------
        v, omega : float
            Velocity during the step (m/s, rad/s).
        dt : float
            Its duration (s).
        offset : float
            Camera ahead of the axle (m).
        noise : (2, 2) array
            Covariance M of what was executed about (v, ω).
        """
        F, Q, motion = self.transition(v, omega, dt, offset, noise)
        self.x[:3] += motion
        # F is the identity but for its first two rows, in what they say of φ and of q.
        turning = F[:2, 2::3]
        self.P[:2] += turning.dot(self.P[2:CORE:3])
        self.P[:, :2] += self.P[:, 2:CORE:3].dot(turning.T)
        self.P[:3, :3] += Q

    def transition(
        self, v: float, omega: float, dt: float, offset: float, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Return ∂(x, y, φ)⁺/∂ core (3, 6), the noise (3, 3) and the change (3,) of (x, y, φ)."""
        q = float(self.x[5])
        dx, dy, turn, (xv, xw, yv, yw) = arc(float(self.x[2]), v, omega, dt, offset)
        F = np.array(
            [
                [1.0, 0.0, -q * dy, 0.0, 0.0, dx],
                [0.0, 1.0, q * dx, 0.0, 0.0, dy],
                [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            ]
        )
        by_velocity = np.array([[q * xv, q * xw], [q * yv, q * yw], [0.0, dt]])
        return F, by_velocity.dot(noise).dot(by_velocity.T), np.array([q * dx, q * dy, turn])

    # --- measurement -----------------------------------------------------------------------

    def transfer(self, index: Index) -> Transfer:
        """Return the predicted bearings of some features and their derivatives."""
        x, beta = self.x, float(self.x[3])
        initial = np.array([math.sin(beta), -math.cos(beta), x[4]])
        return transfer_bearing(initial, x[:3], *self._fixed(index))

    def _fixed(self, index: Index) -> tuple[Array, Array]:
        """Return the estimated bearings of some features in the initial and the target view."""
        theta1 = self.theta1 - self.x[CORE : CORE + self.count]
        theta3 = self.theta3 - self.x[CORE + self.count :]
        return theta1.take(index), theta3.take(index)

    def _parallax(self, index: Index) -> Array:
        """Return the sine of the angle between features' rays in the fixed views."""
        theta1, theta3 = self._fixed(index)
        return np.asarray(np.sin(theta3 - theta1 + self.x[4]))

    def core_jacobian(self, transfer: Transfer) -> Array:
        """Return ∂ bearing/∂ core (6, M); those by the errors are −``transfer.by_bearings``."""
        H = np.zeros((CORE, len(transfer.bearing)))
        beta, by_initial = float(self.x[3]), transfer.by_initial
        H[:3] = transfer.by_current
        H[3] = by_initial[0] * math.cos(beta) + by_initial[1] * math.sin(beta)
        H[4] = by_initial[2]
        return H

    def correct(
        self, index: Index, theta2: Array, sigma2: Array, *, refine: bool = True
    ) -> Innovation:
        """Use the bearings in the current view of some features.

        Parameters
        ----------
        index : (M,) int array
            Which features.
        theta2, sigma2 : (M,) arrays
            Their bearings and standard deviations (rad).
        refine : bool
            Whether the errors of the fixed views' bearings are estimated better, too. If not,
            they count with the covariance that they have (Schmidt's filter): as consistent, and
            at half the cost.

        Returns
        -------
        Innovation
            Bearings that are badly conditioned or contradict the state are left out.
        """
        least = max(MINIMUM_PARALLAX, _PARALLAX_SIGMAS * math.sqrt(self.P[4, 4]))
        used = np.flatnonzero(np.abs(self._parallax(index)) > least)
        if not len(used):
            return Innovation(0.0, used)
        index = index[used]
        transfer = self.transfer(index)
        core, own = self.core_jacobian(transfer), -transfer.by_bearings
        H = _Slopes(core, own, CORE + index, CORE + self.count + index)
        innovation = wrap_half_turn(theta2[used] - transfer.bearing)
        HP = H.times(self.P)
        S = H.after(HP)
        diagonal = S.reshape(-1)[:: len(used) + 1]
        usable = diagonal < _MAX_PREDICTED_SD**2
        noise = sigma2[used] ** 2
        noise *= self.factor
        diagonal += noise
        square = innovation**2 / diagonal
        growth = self._growth(square[usable])
        if growth != 1.0:
            HP *= growth
            S *= growth
        good = usable & (square < growth * _GATE**2)
        if not good.all():
            kept = np.flatnonzero(good)
            used, HP, S, innovation = used[kept], HP[kept], S[kept][:, kept], innovation[kept]
        if not len(used):
            return Innovation(0.0, used)
        update = self._update if refine else self._update_core
        return Innovation(update(HP, S, innovation), used)

    def _growth(self, square: Array) -> float:
        """Let all variances follow normalised innovations squared; return by what factor."""
        if not len(square):
            return 1.0
        mean = float(np.minimum(square, _CAPPED).mean()) / _CAPPED_MEAN
        self._excess += _NEWEST * (mean - self._excess)
        if 1.0 / _EXCESS < self._excess < _EXCESS:
            return 1.0
        growth, self._excess = max(self._excess, 1.0 / self.factor), 1.0
        self.factor *= growth
        self.P *= growth
        return growth

    def _update(self, HP: Array, S: Array, innovation: Array) -> float:
        """Update by an innovation and its covariance; return its normalised square.

        With S = L Lᵀ and W = L⁻¹ H P the gain is Wᵀ L⁻¹ and the covariance falls by Wᵀ W.
        ``HP`` and ``S`` are used up: transposed they are what LAPACK works on in place.
        """
        L, y = _whitened(S, innovation)
        W = dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
        self.x += y @ W
        self.P -= W.T @ W
        return float(y @ y)

    def _update_core(self, HP: Array, S: Array, innovation: Array) -> float:
        """As `_update`, without a gain on the errors of the fixed views' bearings."""
        L, y = _whitened(S, innovation)
        W = dtrsm(1.0, L, HP[:, :CORE].T, side=1, lower=1, trans_a=1)
        self.x[:CORE] += W.dot(y)
        gain = dtrsm(1.0, L, W, side=1, lower=1)
        self.P[:CORE] -= gain.dot(HP)
        self.P[CORE:, :CORE] = self.P[:CORE, CORE:].T
        return float(y @ y)

    def exchange(
        self, slot: int, theta1: float, theta3: float, sigma1: float, sigma3: float
    ) -> None:
        """Forget the feature in a slot and put another one in its place."""
        for row, sigma in ((CORE + slot, sigma1), (CORE + self.count + slot, sigma3)):
            self.x[row] = 0.0
            self.P[row, :] = self.P[:, row] = 0.0
            self.P[row, row] = self.factor * sigma**2
        self.theta1[slot], self.theta3[slot] = theta1, theta3

    # --- result ----------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """Camera pose in the target's frame (m, m, rad)."""
        x, y, phi, _, _, q = self.x[:CORE].tolist()
        return Pose(x / q, y / q, math.remainder(phi, math.tau))

    @property
    def initial(self) -> Pose:
        """Pose of the initial view in the target's frame (m, m, rad)."""
        beta, phi, q = self.x[3:CORE].tolist()
        return Pose(math.sin(beta) / q, -math.cos(beta) / q, math.remainder(phi, math.tau))

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) of `pose`, to first order."""
        x, y, _, _, _, q = self.x[:CORE].tolist()
        J = np.zeros((3, CORE))
        J[0, 0] = J[1, 1] = 1.0 / q
        J[0, 5], J[1, 5], J[2, 2] = -x / q**2, -y / q**2, 1.0
        return np.asarray(J @ self.P[:CORE, :CORE] @ J.T, dtype=np.float64)


def _whitened(S: Array, innovation: Array) -> tuple[Array, Array]:
    """Return the lower factor L of S = L Lᵀ, and L⁻¹ innovation; ``S`` is used up."""
    L, failed = dpotrf(S.T, lower=True, overwrite_a=True)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the innovation is not definite")
    y, _ = dtrtrs(L, innovation, lower=True)
    return L, y
