"""Options that several commands have."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer


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
    bool, typer.Option("--overwrite", help="Replace the files of an earlier run in --out.")
]
SharedOption = Annotated[
    bool, typer.Option("--shared", help="Let other users of this machine read the files.")
]
RecordOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write all that was run into --out as one page.")
]
WorkersOption = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Processes; one a core if left out.")
]
