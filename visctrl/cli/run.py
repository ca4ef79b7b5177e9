"""``visctrl run``: from options to an exit code."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from visctrl.cli.progress import Progress
from visctrl.cli.watching import Watching, watchers
from visctrl.runtime.config import Override
from visctrl.runtime.overrides import load_for_backend
from visctrl.runtime.plan import make_plan
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.session import Outcome
from visctrl.viewers.run_pictures import run_with_pictures

RUNS = Path("runs")
NOBODY = Watching()


@dataclass(frozen=True)
class Place:
    """Where files go.

    out : directory, None for a new one below ``runs/``.
    overwrite : an earlier run's files there may be replaced.
    shared : other users may read them.
    """

    out: Path | None = None
    overwrite: bool = False
    shared: bool = False

    def claim(self, stem: str) -> RunDirectory:
        """Return the directory ``out``, or a new one named ``stem`` below ``runs/``.

        Raises
        ------
        InputError, DiskError
            It cannot be used.
        """
        if self.out is None:
            return RunDirectory.numbered(RUNS, stem, shared=self.shared)
        return RunDirectory(self.out, overwrite=self.overwrite, shared=self.shared)


def run(
    scenario: str,
    overrides: Sequence[Override],
    flags: Mapping[str, Any],
    place: Place,
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
    InputError, DiskError
        Something cannot be used; nothing has been started.
    """
    plan = make_plan(load_for_backend(scenario, overrides, flags))
    console = Console(stderr=True)
    for note in plan.notes:
        print(f"visctrl: {note}", file=sys.stderr)
    with (
        _stdout_as_stderr(),
        watchers(plan, watching) as outside,
        Progress(console, plan, enabled=not quiet) as progress,
    ):
        directory = place.claim(stem(f"{plan.scenario.backend}-{plan.scenario.scheme}"))
        observers = [progress, *outside.observers]
        outcome = run_with_pictures(
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


def stem(what: str) -> str:
    """Return a name for a new directory that says when and what."""
    return f"{datetime.now():%Y%m%d-%H%M%S}-{what}"


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
