"""Options that several commands have."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

#: Named here for their help, as nothing is imported for it; a test compares.
SCHEMES = ("epipolar", "pose", "trifocal", "trifocal2d")


class LogLevel(StrEnum):
    """How much is logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


def finite(value: float) -> float:
    """Refuse an option's value that is no number, or beyond all bounds."""
    if not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


CameraOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="A camera's name, or a calibration file.")
]
CamOption = Annotated[
    int | None, typer.Option(metavar="N", min=0, help="Which camera of a file with several.")
]
OverwriteOption = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        metavar="",
        help="Replace the files of an earlier run in --out.",
    ),
]
SharedOption = Annotated[
    bool,
    typer.Option(
        "--shared",
        metavar="",
        help="Let other users of this machine read the files.",
    ),
]
ScenarioArgument = Annotated[
    str, typer.Argument(metavar="[SCENARIO]", help="Name of a scenario, or a YAML file.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a scenario key; may be repeated."),
]
BackendOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="sim, mock or pioneer.", show_default=False)
]
SchemeOption = Annotated[
    str | None, typer.Option(metavar="NAME", help=f"{', '.join(SCHEMES)}.", show_default=False)
]
RobotOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="A robot's name, or the path of its robot.yaml.")
]
StartOption = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        metavar="X Y PHI_DEG",
        help="Start in the target's frame: right, forward (m), heading (deg, counter-clockwise).",
        show_default=False,
    ),
]
DurationOption = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        help="Longest time of the main stage (s); by the way and the speed limit if left out.",
    ),
]
SeedOption = Annotated[int | None, typer.Option(metavar="N", help="Seed of everything random.")]
NoiseOption = Annotated[
    float | None,
    typer.Option("--noise-px", metavar="S", help="Noise of feature positions (px, mock only)."),
]
ToleranceOption = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="M DEG", help="What counts as reached: distance and heading.", show_default=False
    ),
]
TargetOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Target view made by `visctrl teach`.", show_default=False),
]
RobotPortOption = Annotated[
    str | None,
    typer.Option(
        metavar="PORT",
        help="The robot's serial device or URL (pioneer), as /dev/ttyUSB0 or socket://host:8101.",
        show_default=False,
    ),
]
CameraUrlOption = Annotated[
    str | None,
    typer.Option(
        metavar="SOURCE",
        help="The robot's camera (pioneer): device number or path, video file, or stream's URL.",
        show_default=False,
    ),
]
RealtimeOption = Annotated[
    bool | None,
    typer.Option(
        "--realtime/--lockstep",
        metavar="",
        help="Simulate on the wall clock.",
    ),
]
RunsOption = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, help="Runs of every cell, of entries that have cells."),
]
RecordOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write all that was run into --out as one page.")
]
WorkersOption = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Processes; one a core if left out.")
]
