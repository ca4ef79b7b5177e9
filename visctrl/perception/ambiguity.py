"""Is a first match the only one? Evidence for and against the motion that was found.

Three things make a match wrong that agrees with itself: a room that repeats itself, a plane, which
two motions explain alike, and things that were moved. Number, spread and residual of the inliers
do not tell: a false motion along a row of pillars has more of all than the truth. What tells is

- a *rival*: another motion that distinctive features agree with (`rival_views`);
- the *plane's alias*: another motion with which the same pairs agree (`rival_motion`);
- the *agreement*: the residuals against what the patches' own noise explains, never against
  their own median. Where a wrong calibration explains them (`calibration_doubt`), the motion is
  off, but the place is the right one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visctrl.contracts import MatchedMotion
from visctrl.geometry.robust.scale import mad_sd
from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.planar import PlanarMotion, sampson_residuals
from visctrl.geometry.two_view.rivals import rival_motion
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.errors import InputError
from visctrl.perception.calibration_doubt import explained_by_calibration
from visctrl.perception.matching import Described
from visctrl.perception.patch_alignment import Source
from visctrl.perception.patch_noise import position_deviations
from visctrl.perception.pictures import Picture
from visctrl.perception.rival_views import agreeing, distinctive, doubles, find_rival
from visctrl.perception.unwrap import Canvas

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Residuals this many times their own deviations, in the median, are not noise.
MOST_DISAGREEMENT = 3.3
#: A rival has at least so many distinctive features, and this share of the found motion's.
FEWEST_RIVALS, RIVAL_SHARE = 6, 0.08
#: Fewer distinctive features than this prove nothing where the room repeats itself.
FEWEST_DISTINCTIVE, REPEATED = 12, 0.28
#: What surfaces that are not quite flat add to a position's deviation (px).
_UNEVEN_PX = 0.04
_SIGMA_PX = 0.2
#: Features that say something.
_FEWEST = 12


class AmbiguousMatchError(InputError):
    """A target was recognised, but from more than one place; ``motion`` is what was found."""

    def __init__(self, message: str, motion: MatchedMotion) -> None:
        super().__init__(message)
        self.motion = motion


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a motion.

    motion : what was found.
    distinctive, repeated : features that agree and have no double in the target view; the share
        of those that have one.
    rivals : distinctive features that agree with another motion. alias : whether a plane has one.
    disagreement : median residual in its own standard deviations. calibration : whether it is
    a wrong calibration that explains the disagreement.
    """

    motion: PlanarMotion
    distinctive: int
    repeated: float
    rivals: int
    alias: bool
    disagreement: float
    calibration: bool = False

    @property
    def matched(self) -> MatchedMotion:
        """The motion, as matching reports it."""
        motion = self.motion
        return MatchedMotion(motion.phi, motion.direction, motion.phi_sd, motion.direction_sd)

    @property
    def objection(self) -> str:
        """Why the motion must not be trusted, and what would help; empty if it may be."""
        if self.distinctive < FEWEST_DISTINCTIVE and self.repeated > REPEATED:
            return (
                f"only {self.distinctive} features are unlike all others in the target image: "
                "this place repeats itself; put up something that it has only once"
            )
        if self.calibration:
            return ""
        if self.rivals >= max(FEWEST_RIVALS, RIVAL_SHARE * self.distinctive):
            return (
                f"another place explains {self.rivals} features as well ({self.distinctive} agree "
                "with this one): the scene repeats itself, or much of it was moved; start "
                "elsewhere, or put up something that it has only once"
            )
        if self.alias:
            return (
                "all features lie in one plane, which two places explain alike: choose a target "
                "that sees depth, or start elsewhere"
            )
        if self.disagreement > MOST_DISAGREEMENT:
            return (
                f"the features disagree by {self.disagreement:.1f} times their noise (at most "
                f"{MOST_DISAGREEMENT:g}): things were moved since the target was taken, the camera "
                "is badly calibrated, or the match is wrong; take the target again, or start nearer"
            )
        return ""


def weigh(
    target: tuple[Picture, Described],
    initial: tuple[Picture, Described],
    mutual: tuple[Indices, Indices],
    pairs: tuple[Indices, Indices],
    points: Array,
    aligned: Mask,
    motion: PlanarMotion,
    canvas: Canvas,
    camera: CentralCamera,
    seed: int,
) -> Evidence:
    """Weigh a first match.

    Parameters
    ----------
    target, initial : (Picture, Described)
        All features of both views.
    mutual : two (M,) arrays
        Numbers of the features that are each other's best match, in the target and initial view.
    pairs : two (N,) arrays
        Numbers of the features that agree with the motion, in the target and the initial view.
    points : (N, 2)
        Their positions in the initial view after alignment (canvas points).
    aligned : (N,)
        Which of them were aligned.
    motion : PlanarMotion
        What was found.
    canvas, camera
        On which the pictures are drawn, and which took them.
    seed : int
        Of the random samples.
    """
    (seen, a), (here, b) = target, initial
    first, second = pairs
    rays_a, rays_b = a.rays[first], canvas.rays(points)
    own = position_deviations(seen.frame, canvas, a.points)
    there = position_deviations(here.frame, canvas, points)
    both = np.hypot(own[first], there)
    sigma = np.hypot(both, _UNEVEN_PX) / canvas.scale
    double = doubles(a)
    distance = np.linalg.norm(a.descriptors[first] - b.descriptors[second], axis=1)
    unlike = distinctive(double[first], distance)
    sure = aligned & agreeing(rays_a, rays_b, motion, both, canvas)
    rival = find_rival(
        (Source(seen.frame, canvas.pixels), a),
        (Source(here.frame, canvas.pixels), b),
        motion,
        canvas,
        own,
        double,
        seed,
    )
    disagree = disagreement(rays_a[aligned], rays_b[aligned], motion, sigma[aligned])
    excused = disagree > MOST_DISAGREEMENT and explained_by_calibration(
        a.rays[mutual[0]], b.rays[mutual[1]], canvas, camera, seed
    )
    return Evidence(
        motion=motion,
        # A wrong calibration leaves few that are sure, though many are right.
        distinctive=int(np.count_nonzero(unlike & (aligned if excused else sure))),
        repeated=float(np.mean(~unlike)) if len(unlike) else 1.0,
        rivals=0 if rival is None else len(rival.features),
        alias=_has_alias(rays_a, rays_b, motion, canvas, seed),
        disagreement=disagree,
        calibration=excused,
    )


def disagreement(rays_a: Array, rays_b: Array, motion: PlanarMotion, sigma: Array) -> float:
    """Return the median residual of features over their own deviations ``sigma`` (N,) (rad).

    1 is noise; 0 where there are too few to tell.
    """
    if len(rays_a) < _FEWEST:
        return 0.0
    residual, _ = sampson_residuals(rays_a, rays_b, motion.phi, motion.direction)
    return mad_sd(residual / sigma)


def _has_alias(
    rays_a: Array, rays_b: Array, motion: PlanarMotion, canvas: Canvas, seed: int
) -> bool:
    """Return whether another motion explains the same pairs, as it does those of a plane.

    Two views of one place have no alias: their baseline is not determined, and nothing is wrong
    with that.
    """
    if motion.degeneracy is Degeneracy.IDENTICAL:
        return False
    if not motion.determined:
        # Its deviation, infinite, would hide every alias.
        motion = replace(motion, covariance=np.zeros((2, 2)))
    motion = replace(motion, inliers=np.ones(len(rays_a), dtype=np.bool_))
    return rival_motion(rays_a, rays_b, motion, _SIGMA_PX / canvas.scale, seed=seed) is not None
