"""Options that several commands have."""

from __future__ import annotations

import math
from typing import Annotated

import typer


def finite(value: float) -> float:
    """Refuse an option's value that is no number, or beyond all bounds."""
    if not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the files of an earlier run in --out.")
]
SharedOption = Annotated[
    bool, typer.Option("--shared", help="Let other users of this machine read the files.")
]
