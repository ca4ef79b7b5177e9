"""Commands that work on images without a robot: options and their help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.calibration import calibration
from visctrl.cli.options import OverwriteOption, SharedOption


def add_image_commands(app: typer.Typer) -> None:
    """Add ``replay`` and ``calibrate`` to the program."""
    app.command("replay")(replay_command)
    app.add_typer(calibration, name="calibrate")


def replay_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="A run directory recorded with --record-images, or a folder of images.",
        ),
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set a scenario key; may be repeated."),
    ] = None,
    scheme: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Use another scheme's plugins.", show_default=False),
    ] = None,
    perception: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="As --set perception.name=NAME.", show_default=False),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="As --set estimator.name=NAME.", show_default=False),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="As --set controller.name=NAME.", show_default=False),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A camera's name or calibration file. A recorded run knows its own.",
            show_default=False,
        ),
    ] = None,
    target: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Target image, or file of `visctrl teach`. Left out: the run's; of a folder, the "
            "last image. The first image is the initial view.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of the plugins.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Directory for the results; runs/DATE-... if left out."),
    ] = None,
    overwrite: OverwriteOption = False,
    shared: SharedOption = False,
    video: Annotated[
        bool,
        typer.Option(
            "--video",
            metavar="",
            help="Write an MP4 as well.",
        ),
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            metavar="",
            help="Print the summary on stdout, and only that.",
        ),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            metavar="",
            help="Show no progress.",
        ),
    ] = False,
) -> None:
    """Run the plugins again over recorded images, without a robot: what would be sent is recorded.

    Exit code: 0 done, 2 bad input, 3 plugin fault.
    """
    from visctrl.cli.replay import replay_images
    from visctrl.cli.run import Place
    from visctrl.runtime.config import Override
    from visctrl.runtime.overrides import flag_overrides

    # Options set with --set are those of the plugins named here, whatever the order.
    named = [
        Override((key, *name), value, f"--{key} {value}")
        for key, name, value in (
            ("scheme", (), scheme),
            ("perception", ("name",), perception),
            ("estimator", ("name",), estimator),
            ("controller", ("name",), controller),
        )
        if value is not None
    ]
    overrides = named + flag_overrides(settings=settings, camera=camera, seed=seed)
    place = Place(out, overwrite, shared)
    replay_images(source, overrides, target, place, video=video, as_json=as_json, quiet=quiet)
