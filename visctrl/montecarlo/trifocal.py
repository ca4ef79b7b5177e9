"""The main stage of many trifocal runs: estimator ``tensor`` and controller ``trifocal-smc``."""

from __future__ import annotations

import numpy as np

from visctrl.montecarlo.bases import Reckonings
from visctrl.montecarlo.control import Laws
from visctrl.montecarlo.estimation import Tensors
from visctrl.montecarlo.eyes import View
from visctrl.montecarlo.fleet import Fleet, Stage
from visctrl.montecarlo.initial_views import InitialViews
from visctrl.montecarlo.planar import identical, search
from visctrl.montecarlo.robots import Array, Mask, Velocities
from visctrl.runtime.plan import Plan
from visctrl.schemes.trifocal.law_smc import TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions


class Trifocal(Stage):
    """The stage, from the initial views on: see `Stage`."""

    def __init__(self, fleet: Fleet, plan: Plan) -> None:
        super().__init__(fleet, plan)
        options, law = plan.main.estimator.options, plan.main.controller.options
        assert isinstance(options, TensorOptions)
        assert isinstance(law, TrifocalSmcOptions)
        views = fleet.against_target(fleet.initial)
        motions = search(views, fleet.seed.tolist(), options.threshold_sigmas, options.hypotheses)
        self._shared = views.shared
        self._known = motions.sound & ~identical(views)
        # The target's heading seen from the initial view is −φ1.
        prior = np.stack([-motions.phi, motions.direction], axis=1)
        sign = np.array([[1.0, -1.0], [-1.0, 1.0]])
        initial = InitialViews(prior, motions.covariance * sign)
        self._tensors = Tensors(
            fleet.initial, fleet.target, fleet.sigma, initial, options, fleet.seed
        )
        self._laws = Laws(len(fleet), law, plan.limits)
        self._reckonings = Reckonings(len(fleet), plan.limits)
        self.enough = max(self.enough, options.min_features)

    def decide(self, view: View, dt: Array, *, first: bool) -> tuple[Velocities, Mask, Mask]:
        """See `Stage`."""
        seen = view.seen * self._shared
        features = seen.sum(axis=1)
        regular = self._known & (features >= self.enough)
        self.fleet.fewest = np.minimum(self.fleet.fewest, features.astype(np.int64))
        # Whoever leaves for want of features still goes through this tick with the others.
        if not regular.all():
            seen = np.where(regular[:, None], seen, 1.0)
        motion = self._reckonings.motion(self.sent, dt)
        situation = self._tensors.update(view, seen, motion, dt, regular & ~self.gone)
        wanted = self._laws.update(situation, dt)
        return wanted, self._laws.finished, ~(regular & situation.regular)
