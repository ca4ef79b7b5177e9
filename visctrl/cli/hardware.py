"""Commands around the real robot: its emulator, teaching, driving by hand, and the doctor.

Options and their help only; the work is imported when it is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.options import CameraOption, SharedOption


def add_hardware_commands(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("emulate-pioneer")(emulate_command)
    app.command("teach")(teach_command)
    app.command("drive")(drive_command)
    app.command("doctor")(doctor_command)


FaultOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND[=VALUE][@START[+LENGTH]]",
        help="What goes wrong, when (s after the first motion), for how long; may be repeated. "
        "Kinds: lost, corrupt, delay, silent, deaf, rubbish, reset, stall, bumper, estop, "
        "charging, low-battery, camera-frozen, camera-dropped.",
    ),
]


PortOption = Annotated[
    str | None,
    typer.Option(metavar="PORT", help="The robot's device or URL (pioneer).", show_default=False),
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        metavar="SOURCE",
        help="The robot's camera (pioneer): device, file or URL.",
        show_default=False,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set a scenario key; may be repeated."),
]
RobotOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="A robot's name, or the path of its robot.yaml.")
]


def teach_command(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="The target view.")
    ] = Path("target.npz"),
    scenario: Annotated[
        str, typer.Argument(metavar="[SCENARIO]", help="Name of a scenario, or a YAML file.")
    ] = "default",
    backend: Annotated[str, typer.Option(metavar="NAME", help="pioneer or sim.")] = "pioneer",
    robot: RobotOption = None,
    camera: CameraOption = None,
    port: PortOption = None,
    camera_url: SourceOption = None,
    frames: Annotated[
        int, typer.Option(metavar="N", min=1, max=100, help="Pictures to average.")
    ] = 5,
    preview: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Picture with the features; FILE.png if left out."),
    ] = None,
    settings: SetOption = None,
    shared: SharedOption = False,
) -> None:
    """Take the target view where the robot stands, and say how well it will serve.

    A simulated robot visits the target for it.
    """
    from visctrl.cli.teach import teach
    from visctrl.runtime.overrides import flag_overrides

    overrides = flag_overrides(
        settings=settings,
        backend=backend,
        robot=robot,
        camera=camera,
    )
    flags = {"--port": port, "--camera-url": camera_url}
    _finish(lambda: teach(scenario, overrides, flags, out, frames, preview, shared=shared))


def emulate_command(
    port: Annotated[
        str, typer.Option(metavar="KIND", help="pty, socket or socket:PORT (0 takes a free one).")
    ] = "pty",
    robot: Annotated[
        str,
        typer.Option(metavar="NAME", help="A controller, as p3dx-sh, or a robot's name or path."),
    ] = "p3dx-sh",
    personality: Annotated[
        str, typer.Option(metavar="NAME", help="arcos, or simulator for the habits of that.")
    ] = "arcos",
    camera: Annotated[
        str, typer.Option(metavar="NAME", help="A camera's name, a calibration file, or none.")
    ] = "hypercatadioptric",
    width: Annotated[
        int | None,
        typer.Option(
            metavar="PX", min=1, max=10_000, help="Image width; the camera's own if left out."
        ),
    ] = None,
    mount: Annotated[str, typer.Option(metavar="NAME", help="Where the camera sits.")] = "centre",
    scene: Annotated[str, typer.Option(metavar="NAME", help="Name of a scene, or its file.")] = (
        "hall"
    ),
    start: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y PHI_DEG", help="Start of the camera, as in `visctrl run`."),
    ] = (-0.55, -1.35, -35.0),
    fps: Annotated[float, typer.Option(metavar="N", help="Pictures per second.")] = 10.0,
    stream_port: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=65_535,
            help="TCP port of the camera's stream; 0 takes a free one.",
        ),
    ] = 0,
    fault: FaultOption = None,
    slip: Annotated[
        tuple[float, float],
        typer.Option(metavar="V OMEGA", help="Shares of motion that the odometry does not notice."),
    ] = (0.0, 0.0),
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of noise and faults.")] = 0,
    hang_up: Annotated[
        str,
        typer.Option(
            metavar="WHO",
            help="Who stops the robot when a TCP client hangs up: its watchdog, as behind a "
            "serial device server, or itself at once (stop).",
        ),
    ] = "watchdog",
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write every packet received, and the true pose."),
    ] = None,
) -> None:
    """Emulate a Pioneer with its camera, for drivers of any make.

    Prints the robot's port and the stream's URL, a line each, and runs until Ctrl-C.
    """
    from visctrl.cli.emulate import Emulation, camera_model, emulate, start_pose

    wanted = Emulation(
        port=port,
        robot=robot,
        personality=personality,
        start=start_pose(start),
        scene=scene,
        camera=camera_model(camera, width),
        mount=mount,
        fps=fps,
        stream_port=stream_port,
        faults=fault or (),
        slip=slip,
        seed=seed,
        hang_up=hang_up,
        log=log,
    )
    raise typer.Exit(emulate(wanted))


def drive_command(
    port: Annotated[str, typer.Option(metavar="PORT", help="The robot's device or URL.")] = (
        "/dev/ttyUSB0"
    ),
    robot: Annotated[
        str, typer.Option(metavar="NAME", help="A robot's name, or its robot.yaml.")
    ] = "p3dx",
    speed: Annotated[float, typer.Option(metavar="M/S", help="Speed while a key is held.")] = 0.2,
    turn: Annotated[
        float, typer.Option(metavar="DEG/S", help="Turning rate while a key is held.")
    ] = 20.0,
) -> None:
    """Drive the robot from the keyboard; it moves only while a key is held."""
    from visctrl.cli.drive import drive

    _finish(lambda: drive(port, robot, speed, turn))


def doctor_command(
    port: PortOption = None,
    camera_url: SourceOption = None,
    robot: Annotated[
        str, typer.Option(metavar="NAME", help="The robot's name, or its robot.yaml.")
    ] = "p3dx",
    camera: CameraOption = None,
    width: Annotated[
        int | None,
        typer.Option(
            metavar="PX", min=1, max=10_000, help="Image width; the camera's own if left out."
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", metavar="", help="Leave out what takes seconds: rendering, tick budget."
        ),
    ] = False,
) -> None:
    """Check this machine, and the devices that are named, line by line.

    The robot does not move. Exit code 3 if a check fails.
    """
    from visctrl.cli.doctor import examine
    from visctrl.runtime.config import CameraChoice

    chosen = CameraChoice(name=camera or "hypercatadioptric", width=width)
    _finish(lambda: examine(port, camera_url, chosen, robot, quick=quick))


def _finish(work: Callable[[], int]) -> None:
    """Exit with what ``work`` returns, or as a signal that interrupts it asks for."""
    from visctrl.runtime.interrupts import Interrupted

    try:
        code = work()
    except Interrupted as stop:
        print(f"visctrl: {stop}", file=sys.stderr)
        code = stop.exit_code
    raise typer.Exit(code)
