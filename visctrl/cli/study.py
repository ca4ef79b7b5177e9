"""``visctrl study``: from a file to a table."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from visctrl.cli.study_progress import StudyProgress
from visctrl.robots.errors import InputError
from visctrl.robots.files import absolute, owner_only
from visctrl.runtime.interrupts import Interrupted
from visctrl.studies.conduct import conduct_study
from visctrl.studies.loading import load_study
from visctrl.studies.table import Row
from visctrl.studies.workers import LocalWorkers, Workers, default_workers

RUNS = Path("runs")
#: Cells that are printed; the summary file has them all.
_SHOWN = 40
_WIDE = 200


def study(
    name: str,
    out: Path | None,
    workers: int | None,
    cluster: str | None,
    *,
    as_json: bool,
    quiet: bool,
    shared: bool = False,
) -> int:
    """Run a study and report; return the exit code.

    Raises
    ------
    InputError
        The study, one of its scenarios, the folder or the cluster cannot be used; nothing has
        been run.
    """
    runs = absolute(RUNS)
    loaded = load_study(name)
    folder = absolute(out) if out is not None else runs / f"study-{Path(loaded.origin).stem}"
    console = Console(stderr=True, quiet=quiet)
    with owner_only(unless=shared), StudyProgress(console) as progress:
        loaded.check(progress.checked)
        with _workers(workers, cluster) as place:
            done = conduct_study(loaded, folder, place, progress.ran(loaded.study.count))
    if as_json:
        print(json.dumps({**done.summary, "table": str(done.files[0])}, indent=2))
    elif not quiet:
        _show(done.summary, done.files)
    return _exit_code(done.summary, done.rows, done.interruption)


@contextmanager
def _workers(count: int | None, cluster: str | None) -> Iterator[Workers]:
    """Yield the cluster's workers, or processes of this machine."""
    if cluster is None:
        yield LocalWorkers(count or default_workers())
        return
    if count is not None:
        raise InputError(
            "--workers: a cluster has its own workers; leave --workers or --cluster out"
        )
    from visctrl.studies.cluster import ClusterWorkers

    with closing(ClusterWorkers(cluster)) as workers:
        yield workers


def _exit_code(
    summary: Mapping[str, Any], rows: Sequence[Row], interruption: Interrupted | None
) -> int:
    """Return the exit code, and say on stderr why it is not 0."""
    if interruption is not None:
        left = summary["runs"] - summary["finished"]
        print(
            f"visctrl: {interruption} with {left} of {summary['runs']} runs to go; the same "
            "command goes on from here",
            file=sys.stderr,
        )
        return interruption.exit_code
    for row in rows:
        if row["run"] in summary["died"]:
            print(f"visctrl: run {row['run']} failed: {row['reason']}", file=sys.stderr)
    return 1 if summary["died"] else 0


def _show(summary: Mapping[str, Any], files: Sequence[Path]) -> None:
    """Print one line a cell and where the files are."""
    cells = summary["cells"]
    keys = list(cells[0]["values"]) if cells else []
    heads = ("distance cm (median)", "x cm (mean)", "y cm (mean)", "phi deg (mean)")
    table = Table(*keys, "runs", "reached %", *heads, title=summary["title"] or None)
    for cell in cells[:_SHOWN]:
        values = [str(value) for value in cell["values"].values()]
        table.add_row(*values, str(cell["runs"]), _share(cell["reached"]), *_errors(cell))
    console = Console() if sys.stdout.isatty() else Console(width=_WIDE)
    console.print(table)
    if len(cells) > _SHOWN:
        console.print(f"and {len(cells) - _SHOWN} more cells: see {files[-1]}", highlight=False)
    methods = summary["intervals"]
    console.print(
        f"[low, high]: 95 % confidence; reached: {methods['reached']}; means: {methods['mean']}; "
        f"medians: {methods['median']}; errors {methods['errors']}",
        highlight=False,
        markup=False,
    )
    statuses = ", ".join(f"{name} {count}" for name, count in summary["statuses"].items())
    console.print(f"runs: {summary['finished']} of {summary['runs']} ({statuses})", highlight=False)
    console.print(f"files: {', '.join(map(str, files))}", highlight=False, soft_wrap=True)


def _errors(cell: Mapping[str, Any]) -> list[str]:
    errors = cell["errors"]
    if not errors:
        return [""] * 4
    means = [_interval(errors[name]["mean"]) for name in ("x_cm", "y_cm", "phi_deg")]
    return [_interval(errors["distance_cm"]["median"]), *means]


def _share(share: Mapping[str, float]) -> str:
    value, low, high = (100.0 * share[key] for key in ("value", "low", "high"))
    return f"{value:.1f} \\[{low:.1f}, {high:.1f}]"


def _interval(interval: Mapping[str, float | None]) -> str:
    if interval["low"] is None:
        return f"{interval['value']:.3f}"
    return f"{interval['value']:.3f} \\[{interval['low']:.3f}, {interval['high']:.3f}]"
