"""Which runs can be driven in array operations, and which of them together."""

from __future__ import annotations

from dataclasses import fields, replace

from visctrl.hal.actuation import ActuationOptions
from visctrl.hal.cameras.central import CentralCamera
from visctrl.hal.faults import Faults
from visctrl.hal.mock.backend import MockBackend, MockOptions, Scatter
from visctrl.perception.features import IdentifiedFeatures
from visctrl.runtime.config import Start
from visctrl.runtime.plan import Plan, StagePlan
from visctrl.schemes.approach.estimator import PlanarMotionEstimator
from visctrl.schemes.approach.law import FaceTarget
from visctrl.schemes.trifocal.estimator import Tensor
from visctrl.schemes.trifocal.law_smc import TrifocalSmc, TrifocalSmcOptions
from visctrl.schemes.trifocal.tensor_method import TensorOptions


def batchable(plan: Plan) -> bool:
    """Whether a plan is one of the mock with the practical trifocal law."""
    return (
        plan.perception.cls is IdentifiedFeatures
        and (plan.approach is None or _faces(plan.approach))
        and _is_trifocal(plan.main)
        and _is_simple_mock(plan)
        # With another mount, what the law moves is not the camera.
        and plan.mount.forward_m == 0.0
        and plan.target is None
        and not plan.scenario.realtime
        # Else the guard would stop the robot between two ticks.
        and plan.period_s < plan.scenario.safety.max_command_age_s
    )


def started_at(plan: Plan, start: Start, seed: int) -> Plan:
    """Return the same plan with another start and seed."""
    changed = plan.scenario.model_copy(update={"start": start, "seed": seed})
    return replace(plan, scenario=changed)


def kind_of(plan: Plan) -> str:
    """Return what the scenarios of plans that differ in start and seed only have in common."""
    return started_at(plan, Start(), 0).scenario.model_dump_json()


def alike(one: Plan, other: Plan) -> bool:
    """Whether two plans differ in start and seed only."""
    mine, its = (started_at(plan, Start(), 0) for plan in (one, other))
    pairs = ((getattr(mine, field.name), getattr(its, field.name)) for field in fields(Plan))
    return all(a is b or _equal(a, b) for a, b in pairs)


def _equal(one: object, other: object) -> bool:
    if isinstance(one, CentralCamera) and isinstance(other, CentralCamera):
        # A camera keeps arrays beside its fields, which == would stumble on.
        return one.model_dump() == other.model_dump()
    return one == other


def _faces(stage: StagePlan) -> bool:
    return stage.estimator.cls is PlanarMotionEstimator and stage.controller.cls is FaceTarget


def _is_trifocal(stage: StagePlan) -> bool:
    tensor, law = stage.estimator.options, stage.controller.options
    return (
        stage.estimator.cls is Tensor
        and stage.controller.cls is TrifocalSmc
        and isinstance(tensor, TensorOptions)
        and (tensor.method, tensor.phi_1, tensor.scale) == ("constrained", "estimated", "odometry")
        and tensor.elevations
        and isinstance(law, TrifocalSmcOptions)
        and (law.law, law.finish) == ("practical", "threshold")
        and law.gains().threshold == 0.0
    )


def _is_simple_mock(plan: Plan) -> bool:
    """Whether nothing spoils the runs but noise in the images and whole units."""
    options = plan.backend_options
    return (
        plan.backend is MockBackend
        and isinstance(options, MockOptions)
        and options.faults == Faults()
        and options.scatter == Scatter()
        and options.actuation == ActuationOptions(quantise=options.actuation.quantise)
    )
