"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

import typer

OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the files of an earlier run in --out.")
]
SharedOption = Annotated[
    bool, typer.Option("--shared", help="Let other users of this machine read the files.")
]
