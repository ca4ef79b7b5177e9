"""A run that is over: its verdict, its numbers, its pictures."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from visctrl.robots.errors import InputError

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from visctrl.viewers.report.ticks import Ticks


class Errors(NamedTuple):
    """Final pose of the robot in the target's frame (m, degrees), where the truth is known."""

    x_m: float
    y_m: float
    phi_deg: float

    @property
    def distance_cm(self) -> float:
        """Distance from the target's position (cm)."""
        return 100.0 * math.hypot(self.x_m, self.y_m)


class Run:
    """A run, a replay or the files of either.

    summary : what ``--json`` prints (see `visctrl.runtime.summary.summarise`).
    exit_code : of the command line for the same end.
    directory : its files. Those of a run that was given no ``out`` go with this object.
    notes : what the user should know besides.
    """

    def __init__(
        self,
        summary: Mapping[str, Any],
        exit_code: int,
        directory: Path,
        notes: Sequence[str] = (),
        temporary: TemporaryDirectory[str] | None = None,
    ) -> None:
        self.summary = dict(summary)
        self.exit_code = exit_code
        self.directory = directory
        self.notes = tuple(notes)
        self._temporary = temporary

    @property
    def status(self) -> str:
        """How it ended, in a word."""
        return str(self.summary["status"])

    @property
    def reason(self) -> str:
        """Why it ended so."""
        return str(self.summary["reason"])

    @property
    def reached(self) -> bool:
        """Whether the run says that the robot is at the target."""
        return self.status == "reached"

    @property
    def errors(self) -> Errors | None:
        """The true final error; None where the truth is not known."""
        final = self.summary.get("final_error")
        return None if final is None else Errors(final["x_m"], final["y_m"], final["phi_deg"])

    @cached_property
    def columns(self) -> Ticks:
        """Every signal of every tick, as arrays by name (SI units, rad).

        Raises
        ------
        InputError
            The run ended before its first tick, or its files are gone.
        """
        from visctrl.runtime.recorder import TICKS
        from visctrl.viewers.report.ticks import read_ticks

        return read_ticks(self.directory / TICKS)

    @property
    def ticks(self) -> pandas.DataFrame:
        """The same as a DataFrame, one row a tick; `units` of the columns in its ``attrs``.

        Raises
        ------
        InputError
            pandas is not installed, or there are no ticks.
        """
        try:
            import pandas
        except ImportError:
            raise InputError(
                "ticks as a DataFrame need pandas: pip install pandas (arrays without it: columns)"
            ) from None
        log = self.columns
        frame = pandas.DataFrame({**log.words, **log.numbers})
        frame.attrs["units"] = dict(log.units)
        return frame

    def plot(self) -> Figure:
        """Return a figure: the path from above, velocities, features."""
        from visctrl.api.figures import run_figure

        return run_figure(self)

    def report(self) -> Path:
        """Return the run's HTML page, made now if it is not there yet."""
        from visctrl.viewers.report.run_report import write_report

        return write_report(self.directory)

    def __repr__(self) -> str:
        end = "" if self.errors is None else f", {self.errors.distance_cm:.2f} cm off"
        return f"<Run {self.status}{end}: {self.summary['ticks']} ticks, {self.directory}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        rows = [("status", f"{self.status}: {self.reason}")]
        if self.errors is not None:
            x, y, phi = self.errors
            rows.append(("final error", f"x {100 * x:+.2f} cm, y {100 * y:+.2f} cm, φ {phi:+.2f}°"))
        rows.append(("ticks", str(self.summary["ticks"])))
        rows.append(("files", str(self.directory)))
        cells = "".join(
            f"<tr><th>{name}</th><td style='text-align:left'>{html.escape(text)}</td></tr>"
            for name, text in rows
        )
        return f"<table>{cells}</table>"
