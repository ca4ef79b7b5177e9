"""What can be set about a simulated run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from visctrl.hal.actuation import ActuationOptions, Scatter
from visctrl.hal.faults import Faults
from visctrl.hal.interfaces import BackendOptions
from visctrl.robots.documents import StrictModel
from visctrl.sim.world.light import Light
from visctrl.sim.world.scene_files import check_scene_name

RendererName = Literal["tiny", "gl"]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


class Box(StrictModel):
    """A box on the floor, for example an obstacle: centre and yaw in the target's frame."""

    x_m: float
    y_m: float
    width_m: Annotated[float, Field(gt=0.0)] = 0.4
    depth_m: Annotated[float, Field(gt=0.0)] = 0.4
    height_m: Annotated[float, Field(gt=0.0)] = 0.5
    yaw_deg: float = 0.0


class Changes(StrictModel):
    """How a scene differs from what it was when the target's image was taken.

    removed, replaced, moved : shares of the things, drawn in this order; no thing is drawn twice.
        What is replaced looks other at the same place. What is moved stands on the floor and
        ends ``moved_m`` away, never on the floor that is free to drive on.
    scatter_m : standard deviation of a shift, in x and in y, of every other thing on the floor.
    light : in place of the scene's.
    gain, gamma : of the camera's exposure: a share s of full scale is now shown as (gain s)^gamma.
    seed : of all that is drawn.
    """

    removed: Share = 0.0
    replaced: Share = 0.0
    moved: Share = 0.0
    moved_m: Annotated[float, Field(gt=0.0, le=5.0)] = 0.5
    scatter_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    light: Light | None = None
    gain: Annotated[float, Field(gt=0.0, le=5.0)] = 1.0
    gamma: Annotated[float, Field(gt=0.0, le=5.0)] = 1.0
    seed: Annotated[int, Field(ge=0)] = 0


class MountError(StrictModel):
    """By how much the camera's true place on the robot differs from the mount's (m).

    How it is turned there is a matter of the camera: see ``camera_error``.
    """

    forward_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    left_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    height_m: Annotated[float, Field(ge=-0.3, le=0.5)] = 0.0


class SimOptions(BackendOptions):
    """Options of the simulated backend.

    scene : name of a scene of this package, the path of a scene file, or ``random:7``, a scene
        made from that seed (see `visctrl.sim.world.random_scene`).
    boxes : what stands there besides.
    renderer : ``tiny`` draws in software everywhere, with the same bits; ``gl`` casts rays in an
        OpenGL shader, several times as fast, and needs moderngl and a driver. If left out,
        ``tiny``, or ``gl`` where PyBullet was built without NumPy and a picture of ``tiny`` would
        cost seven times as much.
    image_noise : standard deviation of the pixel noise (grey levels).
    blur_px : Gaussian blur of the optics (px).
    exposure : amplitude of slow, smooth changes of the image's gain (0.2: between 0.8 and 1.2).
    veil : stray light: this share of every pixel is the mean of its wide surroundings.
    latency_s : from the exposure of a frame to its delivery; its stamp is that of the delivery.
    shutter_s : exposure time; what moves meanwhile is blurred.
    shake_deg : standard deviation of the camera's roll and of its pitch in each frame of a moving
        robot.
    mount_error : where the camera really sits.
    scatter : of the executed motion; the wheels do not notice it.
    people : how many walk to and fro along the floor that is free to drive on.
    changes : what is other than when the target's image was taken.
    detail : rendered pixels per image pixel, along a line; more costs time quadratically. Whole
        numbers for ``gl``, which rounds it, to 1 at least.
    show_floor : draw the textures of floor and ceiling; without, each is one shade.
    gui : show PyBullet's own window.
    """

    flags: ClassVar[Mapping[str, str]] = {"--gui": "gui"}

    scene: str = "hall"
    boxes: tuple[Box, ...] = ()
    renderer: RendererName | None = None
    image_noise: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0
    blur_px: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    exposure: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    veil: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    latency_s: Annotated[float, Field(ge=0.0, le=2.0)] = 0.0
    shutter_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    shake_deg: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    mount_error: MountError = MountError()
    scatter: Scatter = Scatter()
    people: Annotated[int, Field(ge=0, le=8)] = 0
    changes: Changes = Changes()
    detail: Annotated[float, Field(ge=0.25, le=4.0)] = 1.0
    show_floor: bool = True
    gui: bool = False
    actuation: ActuationOptions = ActuationOptions()
    faults: Faults = Faults()

    @field_validator("scene")
    @classmethod
    def _known(cls, name: str) -> str:
        return check_scene_name(name)
