"""What the epipolar scheme estimates: the epipoles of view pairs, as bearings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import Estimate, Health
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion
from visctrl.robots.unicycle import wrapped

Array = NDArray[np.float64]


class EpipolePair(NamedTuple):
    """The two epipoles of a pair of views (a, b), as bearings (rad, clockwise from forward).

    bearing_a : of b's centre, seen in view a; bearing_b : of a's centre, seen in view b.
    sd_a, sd_b : their first-order standard deviations (rad).
    turn, turn_sd : heading of b in a's frame (rad, counter-clockwise); it stays known when the
        baseline is too short for the epipoles.
    degeneracy : what is not determined, if anything; health and reason follow from it.
    """

    bearing_a: float
    bearing_b: float
    sd_a: float
    sd_b: float
    turn: float
    turn_sd: float
    health: Health = Health.OK
    reason: str = ""
    degeneracy: Degeneracy | None = None

    @staticmethod
    def of(motion: PlanarMotion) -> EpipolePair:
        """Return the epipoles of a planar motion of b seen from a."""
        (turn, both), (_, direction) = motion.covariance.tolist()
        # α + π = θ + φ + π; an infinite variance stays one.
        sum_b = turn + 2.0 * both + direction
        return EpipolePair(
            motion.direction,
            wrapped(motion.direction + motion.phi + math.pi),
            math.sqrt(direction),
            math.sqrt(max(sum_b, 0.0)),
            motion.phi,
            math.sqrt(turn),
            _health(motion),
            motion.reason,
            motion.degeneracy,
        )

    def swapped(self) -> EpipolePair:
        """Return the same pair as (b, a)."""
        return EpipolePair(
            self.bearing_b,
            self.bearing_a,
            self.sd_b,
            self.sd_a,
            wrapped(-self.turn),
            self.turn_sd,
            self.health,
            self.reason,
            self.degeneracy,
        )

    @property
    def epipole_a(self) -> float:
        """x-coordinate of the epipole in view a for a unit focal length, e_ab/αx (1.8)."""
        return math.tan(self.bearing_a)

    @property
    def epipole_b(self) -> float:
        """x-coordinate of the epipole in view b for a unit focal length, e_ba/αx (1.8)."""
        return math.tan(self.bearing_b)

    def usable(self, sd_limit: float) -> bool:
        """Whether both bearings were measured to within ``sd_limit`` (rad)."""
        return self.health is not Health.LOST and max(self.sd_a, self.sd_b) <= sd_limit


class Location(NamedTuple):
    """Planar pose of the current view in the target's frame, in units of a baseline.

    x, y : position (right, forward) in units of the distance from the reference view (the
        initial one, or a later one in its place) to the target.
    phi : heading (rad).
    inverse_distance : that unit's inverse (1/m), from the velocities sent to the base.
    covariance : (4, 4), of (x, y, phi, inverse_distance).
    """

    x: float
    y: float
    phi: float
    inverse_distance: float
    covariance: Array


@dataclass(frozen=True)
class EpipoleEstimate(Estimate):
    """Epipoles of the pairs among the initial (1), current (2) and target (3) view.

    current_target : pair (2, 3): e23 in the current, e32 in the target view.
    initial_current : pair (1, 2): e12 and e21.
    initial_target : pair (1, 3): e13 and e31, constants of the run.
    aligned_current : the stored "aligned robot" view and the current one: e_2ar2 and e_22ar;
        None until that view has been stored.
    location : what the lines through the epipoles say of the pose, filtered over time.
    """

    current_target: EpipolePair | None = None
    initial_current: EpipolePair | None = None
    initial_target: EpipolePair | None = None
    aligned_current: EpipolePair | None = None
    location: Location | None = None


def _health(motion: PlanarMotion) -> Health:
    if motion.determined:
        return Health.OK
    return Health.DEGENERATE if motion.found else Health.LOST
