"""Schemes: which perception, estimator and controller make up a way of driving to the target."""

from __future__ import annotations

from dataclasses import dataclass

from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError
from visctrl.runtime.registry import Registries


@dataclass(frozen=True)
class Scheme:
    """A preset of plugins by name.

    perception : for cameras that deliver images.
    identified : for backends that deliver identified features (the mock).
    mount : where the camera sits if the scenario does not say.
    approach : whether the robot first turns to the target when it does not head there.
    """

    title: str
    estimator: str
    controller: str
    perception: str = "klt"
    identified: str = "features"
    mount: str = "centre"
    approach: bool = True


SCHEMES = {
    "epipolar": Scheme(
        "epipolar control from three views", "epipoles", "epipolar-smooth", approach=False
    ),
    "trifocal": Scheme("1D trifocal tensor control", "tensor", "trifocal-smc"),
    "trifocal2d": Scheme(
        "2D trifocal tensor and pseudo-inverse control", "tensor2d", "trifocal2d", approach=False
    ),
    "pose": Scheme(
        "pose estimation and Cartesian control",
        "transfer",
        "pose-tracking",
        mount="front",
        approach=False,
    ),
}

#: Turning towards the target before the main stage.
APPROACH_ESTIMATOR = "planar-motion"
APPROACH_CONTROLLER = "face-target"


def scheme_named(name: str) -> Scheme:
    """Return a scheme by name.

    Raises
    ------
    InputError
        No such scheme; the message lists those there are.
    """
    if name not in SCHEMES:
        raise InputError(f"unknown scheme '{name}'; {suggestion(name, SCHEMES)}")
    return SCHEMES[name]


def missing_plugins(scheme: Scheme, registries: Registries) -> list[str]:
    """Return what a scheme still lacks here, as ``controller 'name'`` and the like."""
    wanted = (
        (registries.perception, scheme.perception),
        (registries.estimators, scheme.estimator),
        (registries.controllers, scheme.controller),
    )
    return [
        f"{registry.kind} '{name}'" for registry, name in wanted if name not in registry.names()
    ]
