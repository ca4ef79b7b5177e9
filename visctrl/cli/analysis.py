"""Commands that look at many runs, or once more at one: options and their help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from visctrl.cli.options import RecordOption, RunsOption, SharedOption, WorkersOption, finite

_INTERRUPTED = 130


def add_analysis_commands(app: typer.Typer) -> None:
    """Add ``report``, ``reproduce``, ``observability`` and ``study`` to the program."""
    app.command("report")(report_command)
    app.command("reproduce")(reproduce_command)
    app.command("observability")(observability_command)
    app.command("study")(study_command)


def _begin_workers() -> None:
    """Have worker processes begin to import what this one imports too, at the same time."""
    from visctrl.studies.workers import begin_early

    begin_early()


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


def reproduce_command(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Entries; all if left out.")
    ] = None,
    show_list: Annotated[
        bool,
        typer.Option(
            "--list",
            metavar="",
            help="Only list the entries.",
        ),
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            metavar="",
            help="Print the rows as JSON.",
        ),
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Results.")] = Path("runs/reproduce"),
    workers: WorkersOption = None,
    runs: RunsOption = None,
    record: RecordOption = None,
) -> None:
    """Run published tables and figures again; exit code 0 only if no judged row falls short."""
    if show_list:
        from visctrl.cli.reproduce import show_entries

        show_entries()
        return
    _begin_workers()
    from visctrl.cli.reproduce import reproduce

    raise typer.Exit(reproduce(names or [], out, workers, runs, as_json=as_json, record=record))


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
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            metavar="",
            help="Print the result as JSON.",
        ),
    ] = False,
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
