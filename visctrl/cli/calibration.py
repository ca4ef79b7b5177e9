"""``visctrl calibrate``: options and their help. The work is imported when it is asked for."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.options import CamOption


class Kind(StrEnum):
    """Kinds of boards."""

    CHECKERBOARD = "checkerboard"
    CHARUCO = "charuco"


class ModelChoice(StrEnum):
    """Camera models."""

    AUTO = "auto"
    OMNI = "omni"
    PINHOLE = "pinhole"


class AxisChoice(StrEnum):
    """Ways a camera is mounted."""

    FORWARD = "forward"
    DOWN = "down"
    UP = "up"


calibration = typer.Typer(
    no_args_is_help=True, help="Calibrate a camera from images; convert calibrations."
)

Images = Annotated[
    list[Path], typer.Argument(metavar="IMAGE", help="Image files, or folders of them.")
]
BoardOption = Annotated[Kind, typer.Option("--board", help="Kind of the board.")]
SizeOption = Annotated[
    str, typer.Option(metavar="COLSxROWS", help="Squares across and down, as 8x6.")
]
SquareOption = Annotated[float, typer.Option(metavar="M", help="Side of a square (m).")]
FormatOption = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="NAME",
        help="visctrl, kalibr, opencv, ros, camodocal, basalt, ocamcalib or colmap.",
    ),
]
OutOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="FILE", help="Calibration to write.")
]
PolarOption = Annotated[
    tuple[float, float] | None,
    typer.Option(
        metavar="LEAST GREATEST",
        help="Field of view: angles from the optical axis (deg).",
        show_default=False,
    ),
]
JsonOption = Annotated[
    bool,
    typer.Option(
        "--json",
        metavar="",
        help="Print JSON, and only that.",
    ),
]


@calibration.command("camera")
def camera_command(
    images: Images,
    size: SizeOption,
    square: SquareOption,
    board: BoardOption = Kind.CHECKERBOARD,
    model: Annotated[
        ModelChoice, typer.Option(help="pinhole: ξ is 0; auto: where that explains the images.")
    ] = ModelChoice.AUTO,
    axis: Annotated[
        AxisChoice, typer.Option(help="Optical axis; down: camera looking up into a mirror.")
    ] = AxisChoice.FORWARD,
    polar: PolarOption = None,
    mirrored: Annotated[
        bool,
        typer.Option(
            "--mirrored", metavar="", help="The picture is left-right reversed by a mirror."
        ),
    ] = False,
    out: OutOption = None,
    form: FormatOption = "visctrl",
    as_json: JsonOption = False,
) -> None:
    """Find (ξ, K) of a camera from images of a board, as Kalibr's omni and pinhole models."""
    from visctrl.calibration.boards import Board
    from visctrl.cli.calibrate import Mounting, calibrate_camera, parse_size

    plan = Board(board.value, *parse_size(size), square)
    mounting = Mounting(axis.value, polar, mirrored)
    calibrate_camera(images, plan, model.value, mounting, out, form, as_json=as_json)


@calibration.command("center")
def center_command(
    images: Images,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Camera or calibration to compare with.", show_default=False
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Write --camera with the centre found."),
    ] = None,
    form: FormatOption = "visctrl",
    as_json: JsonOption = False,
) -> None:
    """Find an omnidirectional camera's projection centre, where vertical lines' images meet."""
    from visctrl.cli.calibrate import calibrate_centre

    calibrate_centre(images, camera, out, form, as_json=as_json)


@calibration.command("convert")
def convert_command(
    source: Annotated[str, typer.Argument(metavar="CAMERA", help="Name or calibration file.")],
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Calibration to write.")],
    form: FormatOption = "visctrl",
    axis: Annotated[
        AxisChoice | None, typer.Option(help="Optical axis, where it is another.")
    ] = None,
    polar: PolarOption = None,
    name: Annotated[str | None, typer.Option(help="Another name for the camera.")] = None,
    cam: CamOption = None,
) -> None:
    """Write a calibration in another format (--format)."""
    from visctrl.cli.calibrate import convert

    changes: dict[str, object] = {}
    if axis is not None:
        changes["optical_axis"] = axis.value
    if polar is not None:
        changes["min_polar_deg"], changes["max_polar_deg"] = polar
    if name is not None:
        changes["name"] = name
    convert(source, cam, out, form, changes)


@calibration.command("board")
def board_command(
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Picture to write (.png).")],
    size: SizeOption,
    square: SquareOption,
    board: BoardOption = Kind.CHECKERBOARD,
    px: Annotated[int, typer.Option(min=20, max=1000, help="Pixels a square.")] = 200,
) -> None:
    """Draw a board to print."""
    from visctrl.calibration.boards import Board
    from visctrl.cli.calibrate import draw_board, parse_size

    draw_board(Board(board.value, *parse_size(size), square), out, px)
