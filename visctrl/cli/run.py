"""``visctrl run``: from options to an exit code."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from visctrl.cli.overrides import load_for_backend
from visctrl.cli.progress import Progress
from visctrl.cli.watching import Watching, watchers
from visctrl.runtime.config import Override
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.session import Outcome, run_session

RUNS = Path("runs")
NOBODY = Watching()


def run(
    scenario: str,
    overrides: Sequence[Override],
    flags: Mapping[str, Any],
    out: Path | None,
    *,
    video: bool,
    as_json: bool,
    quiet: bool,
    watching: Watching = NOBODY,
) -> int:
    """Run a scenario and report; return the exit code.

    ``flags`` are the options that belong to a backend (see `load_for_backend`).

    Raises
    ------
    InputError
        Something cannot be used; nothing has been started.
    """
    plan = make_plan(load_for_backend(scenario, overrides, flags))
    directory = out if out is not None else _fresh_directory(plan)
    console = Console(stderr=True)
    with (
        _stdout_as_stderr(),
        watchers(plan, watching) as outside,
        Progress(console, plan, enabled=not quiet) as progress,
    ):
        observers = [progress, *outside.observers]
        outcome = run_session(
            plan, directory, video=video, mcap=watching.mcap, observers=observers, stop=outside.stop
        )
        outside.finish(outcome)
    for note in outcome.notes:
        print(f"visctrl: {note}", file=sys.stderr)
    if as_json:
        print(json.dumps(outcome.summary, indent=2, allow_nan=False))
    elif not quiet:
        _show(outcome)
    if outcome.exit_code and (quiet or as_json):
        print(f"visctrl: {outcome.summary['status']}: {outcome.summary['reason']}", file=sys.stderr)
    return outcome.exit_code


@contextmanager
def _stdout_as_stderr() -> Iterator[None]:
    """Send what libraries print to stderr, that of C code included: stdout is for results."""
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:
        yield
        return
    try:
        os.dup2(2, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _fresh_directory(plan: Plan) -> Path:
    """Return a new name under ``runs/`` that says when and what."""
    scenario = plan.scenario
    stem = f"{datetime.now():%Y%m%d-%H%M%S}-{scenario.backend}-{scenario.scheme}"
    candidates = (RUNS / (stem if n == 1 else f"{stem}-{n}") for n in range(1, 1000))
    return next(path for path in candidates if not path.exists())


def _show(outcome: Outcome) -> None:
    """Print the short table at the end of a run."""
    summary = outcome.summary
    rows = [("status", f"{summary['status']}: {summary['reason']}")]
    if (error := summary["final_error"]) is not None:
        x, y, phi = 100.0 * error["x_m"], 100.0 * error["y_m"], error["phi_deg"]
        rows.append(("final error", f"x {x:+.2f} cm, y {y:+.2f} cm, phi {phi:+.2f} deg"))
    rows.append(("path", f"{summary['path_length_m']:.2f} m in {summary['duration_s']:.1f} s"))
    rows += _tick_rows(summary) if summary["ticks"] else []
    rows.append(("files", str(outcome.directory)))
    for name, text in rows:
        print(f"{name:<12} {text}")


def _tick_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the lines about a run that has ticked."""
    compute, late, features = (summary[key] for key in ("compute_ms", "lateness_ms", "features"))
    period = 1000.0 * summary["period_s"]
    rows = [
        (
            "ticks",
            f"{summary['ticks']} of {period:g} ms, {summary['missed_ticks']} missed, "
            f"lateness p99 {late['p99']:.1f} ms",
        ),
        ("compute", f"median {compute['median']:.1f} ms, p99 {compute['p99']:.1f} ms a tick"),
        ("speed", f"{summary['real_time_factor']:.1f} x real time"),
    ]
    if features["median"] is not None:
        rows.insert(2, ("features", f"median {features['median']:g}, least {features['min']}"))
    return rows
