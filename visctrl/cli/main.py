"""The command ``visctrl``: options and their help. The work is imported when it is asked for."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.ending import Program, run_program
from visctrl.cli.hardware import add_hardware_commands
from visctrl.cli.images import add_image_commands
from visctrl.cli.options import (
    CameraOption,
    CamOption,
    OverwriteOption,
    RecordOption,
    SharedOption,
    WorkersOption,
    finite,
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


def _begin_workers() -> None:
    """Have worker processes begin to import what this one imports too, at the same time."""
    from visctrl.study.workers import begin_early

    begin_early()


def _show_version(wanted: bool) -> None:
    if wanted:
        from visctrl import __version__

        print(f"visctrl {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Drive a wheeled robot to the pose from which a target image was taken."""


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
    str | None, typer.Option(metavar="NAME", help="trifocal, epipolar or pose.", show_default=False)
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
    float | None, typer.Option(metavar="S", help="Longest time of the main stage (s).")
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
    bool | None, typer.Option("--realtime/--lockstep", help="Simulate on the wall clock.")
]


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
    video: Annotated[bool, typer.Option("--video", help="Write an MP4 as well.")] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve a page to watch and stop the robot.")
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
        bool, typer.Option("--mcap", help="Write run.mcap for the Foxglove app (extra viz).")
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Serve the Foxglove app during the run (extra viz).")
    ] = False,
    live_address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Where: 127.0.0.1:8765 if left out.", show_default=False
        ),
    ] = None,
    record_images: Annotated[
        bool, typer.Option("--record-images", help="Keep every frame, for visctrl replay.")
    ] = False,
    gui: Annotated[bool, typer.Option("--gui", help="Show PyBullet's window (sim).")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the summary on stdout, and only that.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Drive to the target view.

    Exit code: 0 reached, 1 missed or lost, 2 bad input, 3 device or plugin fault, 130 Ctrl-C.
    """
    from visctrl.cli.overrides import flag_overrides
    from visctrl.cli.run import Place, run
    from visctrl.cli.watching import Watching

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
        bool, typer.Option("--resolve", help="Fill in every default, the plugins' included.")
    ] = False,
    settings: SetOption = None,
) -> None:
    """Check a scenario and print it as YAML."""
    from visctrl.cli.listing import show_scenario
    from visctrl.cli.overrides import flag_overrides

    show_scenario(scenario, flag_overrides(settings=settings), resolve=resolve)


@app.command("report")
def report_command(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="The page; RUN/report.html or, for several runs, comparison.html if left out.",
        ),
    ] = None,
) -> None:
    """Make a run's report.html again, or compare several runs on one page."""
    from visctrl.cli.report import report

    raise typer.Exit(report(runs, out))


@app.command("reproduce")
def reproduce_command(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Entries; all if left out.")
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="Only list the entries.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Results.")] = Path("runs/reproduce"),
    workers: WorkersOption = None,
    record: RecordOption = None,
) -> None:
    """Run published tables and figures again; exit code 0 only if no judged row falls short."""
    if show_list:
        from visctrl.cli.reproduce import show_entries

        show_entries()
        return
    _begin_workers()
    from visctrl.cli.reproduce import reproduce

    raise typer.Exit(reproduce(names or [], out, workers, as_json=as_json, record=record))


@app.command("observability")
def observability_command(
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="Directory of a recorded, simulated run.")
    ] = None,
    start: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y PHI_DEG", help="Plan the pose scheme's path from here instead."),
    ] = None,
    output: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="What is measured: epipoles, target-epipole, or a tensor element over T121 "
            "(T111, ...); may be repeated.",
        ),
    ] = None,
    tau: Annotated[
        float,
        typer.Option(metavar="S", min=1.0, callback=finite, help="Time of a planned path."),
    ] = 100,
    period: Annotated[
        float,
        typer.Option(metavar="S", min=0.01, callback=finite, help="Tick of a planned path."),
    ] = 0.5,
    window: Annotated[int, typer.Option(metavar="N", min=1, help="Ticks judged together.")] = 10,
    offset: Annotated[
        float,
        typer.Option(
            metavar="M", min=0.01, max=10.0, callback=finite, help="Camera ahead of the axle."
        ),
    ] = 0.08,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write every window to a CSV file.")
    ] = None,
) -> None:
    """Tell which directions of the pose a motion makes observable, and when they are lost."""
    from visctrl.cli.observability import observability

    code = observability(
        run,
        start,
        output or [],
        tau_s=tau,
        period_s=period,
        window=window,
        offset_m=offset,
        as_json=as_json,
        out=out,
    )
    raise typer.Exit(code)


@app.command("study")
def study_command(
    study: Annotated[
        str, typer.Argument(metavar="FILE", help="A study's YAML file, or the name of one.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the table; runs/study-NAME if left out."),
    ] = None,
    workers: WorkersOption = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on a Dask cluster, as tcp://host:8786. It runs code that is sent to it, and "
            "what it answers is trusted as code is: use one that is yours alone.",
        ),
    ] = None,
    shared: SharedOption = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the summary on stdout, and only that.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Run a scenario many times: over a grid, with random values, starts and seeds.

    Stopped in any way, the same command goes on with the runs that are missing. Exit code: 0 if
    every run has ended (whether or not it arrived), 1 if some could not be run, 2 bad input.
    """
    if cluster is None:
        _begin_workers()
    from visctrl.cli.study import study as run_study

    try:
        code = run_study(study, out, workers, cluster, as_json=as_json, quiet=quiet, shared=shared)
    except KeyboardInterrupt:
        code = _INTERRUPTED
    raise typer.Exit(code)


add_hardware_commands(app)
add_image_commands(app)
