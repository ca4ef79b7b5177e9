"""φ1 from the tensor's own change on a straight leg, for a law that is not told it (or wrongly)."""

from __future__ import annotations

import math
from dataclasses import replace

from visctrl.schemes.trifocal.estimate import TensorEstimate

#: Share of the initial distance that the leg must have: φ1 is then as sure as the outputs' own
#: noise over a tenth of them, 2 to 6 degrees with a pixel of noise.
_LEG = 0.1


class InitialHeading:
    """Heading φ1 of the initial view, from ξ1' = −v cos φ1/T_N and ξ2' = v sin φ1/T_N (3.5).

    T121 does not change on a straight leg, so that the normalised outputs can be compared.
    """

    def __init__(self) -> None:
        self._start: tuple[float, float] | None = None
        self._found: tuple[float, float] | None = None

    def known(self, estimate: TensorEstimate) -> TensorEstimate | None:
        """Return the estimate with φ1 and its deviation; None until the leg is long enough.

        An estimate that knows its own φ1 is returned as it is.
        """
        if math.isfinite(estimate.phi_1_sd):
            return estimate
        if self._found is None:
            xi_1, xi_2 = (float(xi) for xi in estimate.outputs)
            self._start = self._start or (xi_1, xi_2)
            fallen, grown = self._start[0] - xi_1, xi_2 - self._start[1]
            length = math.hypot(fallen, grown)
            if length < _LEG * math.hypot(*self._start):
                return None
            if length == 0.0:
                return estimate  # on the target already: there is no way to read it from
            # Both ends are as uncertain as this one.
            deviation = math.sqrt(2.0 * max(estimate.outputs_covariance.trace, 0.0)) / length
            self._found = math.atan2(grown, fallen), deviation
        return replace(estimate, phi_1=self._found[0], phi_1_sd=self._found[1])
