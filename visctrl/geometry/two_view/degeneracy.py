"""Why the relative motion of two views is not determined."""

from __future__ import annotations

from enum import StrEnum


class Degeneracy(StrEnum):
    """What two views do not tell; the value says so to a reader.

    With the first two nothing was found at all, with the others a motion that is in part unknown
    (or none, where features are clustered).
    """

    TOO_FEW = "too few features"
    NO_AGREEMENT = "no agreement"
    #: Nothing but the turn: the baseline does not stand out of the noise.
    IDENTICAL = "views identical: the direction of the baseline is not determined"
    SHORT_BASELINE = "short baseline: the direction of the epipoles is not determined"
    #: A homography explains the views, and with it two planar motions.
    ONE_PLANE = (
        "all features lie in one plane, and two motions explain them: let the camera see things at "
        "different distances"
    )
    MANY_SOLUTIONS = "planar scene or identical views: many matrices fit"
    CLUSTERED = "features clustered: they do not separate turning from moving"
    CLUSTERED_OR_LEVEL = "features clustered, or level with the camera"
    NARROW = "features clustered: they do not spread over the image"

    @property
    def found(self) -> bool:
        """Whether there is a motion, if one that is not determined in all."""
        return self not in (Degeneracy.TOO_FEW, Degeneracy.NO_AGREEMENT)
