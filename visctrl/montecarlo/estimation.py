"""The tensor of many robots: `visctrl.schemes.trifocal.estimator` with the constrained fit, in arrays.

With t_1, φ1 and z = (cos φ2, sin φ2, t_x2, t_y2) n known, (3.2) makes everything that the law
reads off the tensor a quotient of few products: T121 = t_y1 z_1 + sin φ1 z_4' and so on, so that
the tensor itself is not needed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visctrl.contracts import Views
from visctrl.montecarlo.eyes import View
from visctrl.montecarlo.fit import Couplings, Fits, couple, refine
from visctrl.montecarlo.initial_views import InitialViews
from visctrl.montecarlo.relation import FixedViews
from visctrl.montecarlo.robots import Array, Mask, Numbers, Robots, taken
from visctrl.schemes.path_scale import ALIKE, DELAY_SD_S
from visctrl.schemes.trifocal.constrained_fit import CONTRADICTION, DOUBTFUL, DRIFT, RECONSIDER
from visctrl.schemes.trifocal.initial_from_bearings import InitialFromBearings
from visctrl.schemes.trifocal.initial_view import InitialView
from visctrl.schemes.trifocal.tensor_method import TensorOptions

Pair = tuple[Array, Array]


class Situations(NamedTuple):
    """What the law reads off the tensors of R robots: see `trifocal_law.Situation`.

    right, forward : the target in units of T_N; lateral_sd : sd of the former. scale, scale_sd :
    T_N and its sd (m). heading, phi_1 : of the robot and of the initial view (rad).
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


class Tensors(Robots):
    """Tensors of R robots in scenes with the same number of features.

    Parameters
    ----------
    initial, target : View
        The fixed views.
    sigma : (R,) array
        Standard deviations of a bearing (rad).
    views : InitialViews
    options : TensorOptions
    seeds : (R,) array
        For random choices.
    """

    def __init__(
        self,
        initial: View,
        target: View,
        sigma: Array,
        views: InitialViews,
        options: TensorOptions,
        seeds: Numbers,
    ) -> None:
        nothing = np.zeros(len(sigma))
        self._initial, self._target_view, self._seeds = initial, target, seeds
        self._doubts = np.zeros(len(sigma), dtype=np.int64)
        self.fixed, self.views = FixedViews(initial.parts, target.parts), views
        self._sigma, self._options = sigma, options
        # Position and heading in the initial view's frame: as driven, and since last seen.
        self._driven = self._velocity = nothing, nothing
        self._turned, self._moved = nothing, (nothing, nothing, nothing)
        phi, bearing = views.state.T
        self._heading, self._target = phi, (np.sin(bearing), np.cos(bearing))
        # Normal equations of the scale: n11, n12, n22, r1, r2.
        self._normal = nothing, nothing, nothing, nothing, nothing
        # Units of the initial distance to the metre, 0 while that is not known, and their sd.
        self._units = nothing, nothing

    def update(
        self, current: View, seen: Array, motion: Array, dt: Array, present: Mask
    ) -> Situations:
        """Return the situations.

        Parameters
        ----------
        current : View
        seen : (R, N) array
            1 where a feature is seen in all views, else 0.
        motion, dt : (R, 3), (R,) arrays
            What the robot was told to drive since the last tick, in its own frame, and in what
            time (s).
        present : (R,) array
            Whose situations matter; about the others nobody thinks twice.
        """
        self._predict(motion, dt)
        views, view = self.views, self.views.state
        relation, start = self.fixed.relation(view, current.parts), self._predicted()
        fits = refine(relation, start, self._sigma, seen)
        agreeing = self._agreeing(fits, seen)
        share = max(DOUBTFUL, self._options.min_inliers)
        regular = agreeing >= share * seen.sum(axis=1)
        doubtful = fits.spread > CONTRADICTION * self._sigma
        self._doubts = self._doubts + doubtful
        asked = present & regular & doubtful & (self._doubts % RECONSIDER == 1)
        for robot in np.flatnonzero(asked).tolist():
            one = np.array([robot])
            fit = fits.take(one), agreeing[one]
            some = View(*taken(tuple(current), one)), seen[one], start[one]
            regular[robot] &= self.take(one)._keeps(*some, *fit)
        self._follow(fits, view)
        known = couple(relation, fits)
        views.update(known)
        return self._seen(view, fits, known, regular)

    def _agreeing(self, fits: Fits, seen: Array) -> Array:
        """Return how many features (R,) agree with the fits."""
        limit = self._options.threshold_sigmas * np.minimum(fits.spread, DRIFT * self._sigma)
        return np.asarray(((np.abs(fits.residuals) < limit[:, None]) * seen).sum(axis=1))

    def _keeps(self, current: View, seen: Array, start: Array, fits: Fits, agreeing: Array) -> bool:
        """Return whether a single doubtful robot keeps its initial view.

        See `ConstrainedFit._reconsidered`; one that may have found a better view does not.
        """
        shown = seen[0] > 0.0
        views = Views(
            ids=np.flatnonzero(shown),
            target=self._target_view.rays[0, shown],
            initial=self._initial.rays[0, shown],
            current=current.rays[0, shown],
            pixels=np.empty((0, 2)),
            sigma=float(self._sigma[0]),
            stamp=0.0,
        )
        driven = float(self._driven[0][0]), float(self._driven[1][0])
        phi, bearing = self.views.prior[0].tolist()
        prior = InitialView(phi, bearing, np.diag([np.inf, np.inf]))
        search = InitialFromBearings(self._options, int(self._seeds[0]))
        try:
            found = search.find(views, driven, float(self._turned[0]), prior)
        except np.linalg.LinAlgError:
            # What comes of that is the ordinary session's to say.
            return False
        if not isinstance(found, InitialView):
            return True
        other = self.fixed.relation(np.array([[found.phi, found.bearing]]), current.parts)
        others = refine(other, start, self._sigma, seen)
        number = self._agreeing(others, seen)
        sound = number >= DOUBTFUL * seen.sum()
        return bool(sound & ((others.spread > fits.spread / 2.0) | (number < agreeing)))

    def _predict(self, motion: Array, dt: Array) -> None:
        x, y, turn = motion.T
        right, forward = _rotated((x, y), self._turned)
        self._driven = self._driven[0] + right, self._driven[1] + forward
        self._velocity = right / dt, forward / dt
        before_x, before_y, before_turn = self._moved
        right, forward = _rotated((x, y), before_turn)
        self._moved = before_x + right, before_y + forward, before_turn + turn
        self._turned = self._turned + turn

    def _predicted(self) -> Array:
        """Return the view coordinates (R, 4) that the driven motion leads to."""
        unit, _ = self._units
        dx, dy, turn = self._moved
        right, forward = self._target
        ahead = _rotated((right - dx * unit, forward - dy * unit), -turn)
        heading = self._heading + turn
        return np.stack([np.cos(heading), np.sin(heading), *ahead], axis=1)

    def _follow(self, fits: Fits, view: Array) -> None:
        """Keep the poses for the next prediction, and compare the paths seen and driven."""
        cosine, sine, right, forward = fits.z.T
        square = cosine * cosine + sine * sine
        unit = 1.0 / np.sqrt(square)
        nothing = np.zeros_like(unit)
        x, y = right * unit, forward * unit
        self._heading, self._target = np.arctan2(sine, cosine), (x, y)
        self._moved = nothing, nothing, nothing
        self._turned = self._heading - view[:, 0]
        right, forward = _rotated((x, y), self._turned)
        seen = np.sin(view[:, 1]) - right, np.cos(view[:, 1]) - forward
        # By z, the target moves with (−x cos, −x sin, n, 0)/n² and (−y cos, −y sin, 0, n)/n².
        C, share = fits.covariance, 1.0 / square
        c, s = cosine * share, sine * share
        along = c * c * C[:, 0, 0] + 2.0 * c * s * C[:, 0, 1] + s * s * C[:, 1, 1]
        across = x * (c * C[:, 0, 2] + s * C[:, 1, 2]) + y * (c * C[:, 0, 3] + s * C[:, 1, 3])
        variance = (x * x + y * y) * along + share * (C[:, 2, 2] + C[:, 3, 3])
        variance -= 2.0 * unit * across
        self._regress(seen, np.sqrt(np.maximum(variance, 0.0) / 2.0))

    def _regress(self, seen: Pair, seen_sd: Array) -> None:
        """Add a moment to the regression of the paths: see `visctrl.schemes.path_scale`."""
        (x, y), (vx, vy), (sx, sy) = self._driven, self._velocity, seen
        weight = 1.0 / (ALIKE * np.maximum(seen_sd, 1e-9) ** 2)
        n11, n12, n22, r1, r2 = self._normal
        self._normal = (
            n11 + weight * (x * x + y * y),
            n12 - weight * (x * vx + y * vy),
            n22 + weight * (vx * vx + vy * vy),
            r1 + weight * (x * sx + y * sy),
            r2 - weight * (vx * sx + vy * sy),
        )
        self._units = _slopes(*self._normal)

    def _seen(self, view: Array, fits: Fits, coupled: Couplings, regular: Mask) -> Situations:
        """Return what the law reads off the tensors (R, 8) of the fits.

        With the initial view (φ1, t_1) they have T121 = t_y1 z_1 + sin φ1 z_3, and the outputs,
        turned by φ1, are (z_3, z_4)/T121. Its T111 + T122 and T121 − T112, less their shares of
        the outputs, are 2 t_y1 times z_2 and z_1, whence the heading.
        """
        phi_1, bearing = view.T
        cosine, sine, x, y = fits.z.T
        s, c, level = np.sin(phi_1), np.cos(phi_1), np.cos(bearing)
        first = level * cosine + s * x
        inverse = 1.0 / first
        right = x * inverse
        # Derivatives of the target's lateral position by z_1 and z_3, and by the initial view,
        # φ1 as the law uses it being given.
        by_1, by_3 = -right * level * inverse, (1.0 - right * s) * inverse
        by_phi = -(y + right * c * x) * inverse
        by_bearing = right * np.sin(bearing) * cosine * inverse
        J = coupled.sensitivity
        by_phi = by_phi + by_1 * J[:, 0, 0] + by_3 * J[:, 2, 0]
        by_bearing = by_bearing + by_1 * J[:, 0, 1] + by_3 * J[:, 2, 1]
        C, doubt = fits.covariance, self.views.covariance.apply(by_phi, by_bearing)
        variance = by_1 * by_1 * C[:, 0, 0] + 2.0 * by_1 * by_3 * C[:, 0, 2]
        variance += by_3 * by_3 * C[:, 2, 2] + by_phi * doubt[0] + by_bearing * doubt[1]
        units, units_sd = self._units
        known = units > 0.0
        units = np.where(known, units, 1.0)
        scale = np.abs(first) / (units * np.sqrt(cosine * cosine + sine * sine))
        towards = np.copysign(1.0, first)
        return Situations(
            towards * right,
            towards * y * inverse,
            np.sqrt(np.maximum(variance, 0.0)),
            np.where(known, scale, self._options.scale_m),
            np.where(known, scale * units_sd / units, np.inf),
            np.arctan2(level * sine, level * cosine),
            phi_1,
            regular,
        )


def _rotated(vector: Pair, angle: Array) -> Pair:
    """Return vectors of frames turned by angles (R,) in the unturned frames."""
    s, c = np.sin(angle), np.cos(angle)
    x, y = vector
    return c * x - s * y, s * x + c * y


def _slopes(n11: Array, n12: Array, n22: Array, r1: Array, r2: Array) -> Pair:
    """Return κ of the normal equations and its standard deviation, 0 where it is not known.

    See `visctrl.schemes.path_scale.PathScale`.
    """
    known = (n11 > 0.0) & (r1 > 0.0)
    n11, r1 = np.where(known, n11, 1.0), np.where(known, r1, 1.0)
    n22 = n22 + (n11 / (DELAY_SD_S * r1)) ** 2
    inverse = 1.0 / (n11 * n22 - n12 * n12)
    kappa = (n22 * r1 - n12 * r2) * inverse
    known &= kappa > 0.0
    return np.where(known, kappa, 0.0), np.where(known, np.sqrt(n22 * inverse), 0.0)
