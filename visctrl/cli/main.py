"""The command ``visctrl``: options and their help. The work is imported when it is asked for."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.analysis import add_analysis_commands
from visctrl.cli.ending import Program, run_program
from visctrl.cli.hardware import add_hardware_commands
from visctrl.cli.images import add_image_commands
from visctrl.cli.options import (
    BackendOption,
    CameraOption,
    CameraUrlOption,
    CamOption,
    DurationOption,
    LogLevel,
    NoiseOption,
    OverwriteOption,
    RealtimeOption,
    RobotOption,
    RobotPortOption,
    ScenarioArgument,
    SchemeOption,
    SeedOption,
    SetOption,
    SharedOption,
    StartOption,
    TargetOption,
    ToleranceOption,
)
from visctrl.threads import limit_linear_algebra

_INTERRUPTED = 130

app = typer.Typer(
    name="visctrl",
    cls=Program,
    help="Drive a wheeled robot to the pose from which a target image was taken.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; errors meant for the user become one message and an exit code."""
    limit_linear_algebra()
    sys.exit(run_program(app))


def _show_version(wanted: bool) -> None:
    if wanted:
        from visctrl import __version__

        print(f"visctrl {__version__}")
        raise typer.Exit


@app.callback()
def root(
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            "-v",
            metavar="",
            help="As --log-level info.",
        ),
    ] = False,
    log_level: Annotated[
        LogLevel, typer.Option(metavar="NAME", help=f"Log to stderr: {', '.join(LogLevel)}.")
    ] = LogLevel.WARNING,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, metavar="", help="Show the version."
        ),
    ] = False,
) -> None:
    """Drive a wheeled robot to the pose from which a target image was taken."""
    level = LogLevel.INFO if verbose and log_level is LogLevel.WARNING else log_level
    logging.basicConfig(
        level=level.upper(), format="visctrl: %(levelname)s: %(name)s: %(message)s", force=True
    )


@app.command("run")
def run_command(
    scenario: ScenarioArgument = "default",
    backend: BackendOption = None,
    scheme: SchemeOption = None,
    robot: RobotOption = None,
    camera: CameraOption = None,
    cam: CamOption = None,
    start: StartOption = None,
    duration: DurationOption = None,
    seed: SeedOption = None,
    noise_px: NoiseOption = None,
    tolerance: ToleranceOption = None,
    realtime: RealtimeOption = None,
    target: TargetOption = None,
    port: RobotPortOption = None,
    camera_url: CameraUrlOption = None,
    settings: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Run directory; runs/DATE-... if left out."),
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
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            metavar="",
            help="Serve a page to watch and stop the robot.",
        ),
    ] = False,
    web_address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="Where: 127.0.0.1:8050 if left out; elsewhere the page asks for a token.",
            show_default=False,
        ),
    ] = None,
    mcap: Annotated[
        bool,
        typer.Option(
            "--mcap",
            metavar="",
            help="Write run.mcap for the Foxglove app (extra viz).",
        ),
    ] = False,
    live: Annotated[
        bool,
        typer.Option(
            "--live", metavar="", help="Serve the Foxglove app during the run (extra viz)."
        ),
    ] = False,
    live_address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Where: 127.0.0.1:8765 if left out.", show_default=False
        ),
    ] = None,
    record_images: Annotated[
        bool,
        typer.Option(
            "--record-images",
            metavar="",
            help="Keep every frame, for visctrl replay.",
        ),
    ] = False,
    gui: Annotated[
        bool,
        typer.Option(
            "--gui",
            metavar="",
            help="Show PyBullet's window (sim).",
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
    """Drive to the target view.

    Exit code: 0 reached, 1 missed or lost, 2 bad input, 3 device or plugin fault, 130 Ctrl-C.
    """
    from visctrl.cli.run import Place, run
    from visctrl.cli.watching import Watching
    from visctrl.runtime.overrides import flag_overrides

    overrides = flag_overrides(
        settings=settings,
        backend=backend,
        scheme=scheme,
        robot=robot,
        camera=camera,
        cam=cam,
        start=start,
        duration=duration,
        seed=seed,
        tolerance=tolerance,
        realtime=realtime,
        target=target,
        record_images=record_images,
    )
    flags = {
        "--port": port,
        "--camera-url": camera_url,
        "--noise-px": noise_px,
        "--gui": gui or None,
    }
    try:
        watching = Watching(
            web=web_address or "" if web or web_address is not None else None,
            live=live_address or "" if live or live_address is not None else None,
            mcap=mcap,
        )
        code = run(
            scenario,
            overrides,
            flags,
            Place(out, overwrite, shared),
            video=video,
            as_json=as_json,
            quiet=quiet,
            watching=watching,
        )
    except KeyboardInterrupt:
        # Before or after the session, which handles its own.
        code = _INTERRUPTED
    raise typer.Exit(code)


@app.command("list")
def list_command() -> None:
    """Show what there is: scenarios, robots, cameras, backends, schemes, plugins."""
    from visctrl.cli.listing import show_everything

    show_everything()


@app.command("config")
def config_command(
    scenario: ScenarioArgument = "default",
    resolve: Annotated[
        bool,
        typer.Option(
            "--resolve",
            metavar="",
            help="Fill in every default, the plugins' included.",
        ),
    ] = False,
    settings: SetOption = None,
) -> None:
    """Check a scenario and print it as YAML."""
    from visctrl.cli.listing import show_scenario
    from visctrl.runtime.overrides import flag_overrides

    show_scenario(scenario, flag_overrides(settings=settings), resolve=resolve)


add_analysis_commands(app)
add_hardware_commands(app)
add_image_commands(app)
