"""The log of a run, written while it goes on, and the names of the files that a run leaves."""

from __future__ import annotations

import csv
import math
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import ClassVar, Protocol

from visctrl.contracts import Signal
from visctrl.hal.types import Pose
from visctrl.robots.errors import DiskError
from visctrl.runtime.records import STAGES, Observer, TickRecord

TICKS, TRAJECTORY, SUMMARY, CONFIG = "ticks.csv", "trajectory.tum", "summary.json", "config.yaml"
TARGET, INITIAL, FINAL, REPORT = "target.png", "initial.png", "final.png", "report.html"
VIDEO, MCAP, FAULT, IMAGES = "video.mp4", "run.mcap", "fault.txt", "images"
FILES = (TICKS, TRAJECTORY, SUMMARY, CONFIG, TARGET, INITIAL, FINAL, REPORT, VIDEO, MCAP, FAULT)

_MS = 1000.0
#: Ticks that may wait to be written; with more, they are given up.
_BACKLOG = 10_000
_FLUSH_S = 0.5

_CORE = (
    *("tick", "t [s]", "stage", "phase", "dt [s]", "sequence", "stamp [s]"),
    *("features", "views_health", "estimate_health", "event"),
    *("x_true [m]", "y_true [m]", "phi_true [rad]"),
    *("x_odometry [m]", "y_odometry [m]", "phi_odometry [rad]"),
    *("v_odometry [m/s]", "omega_odometry [rad/s]"),
    *("v_wanted [m/s]", "omega_wanted [rad/s]", "v_sent [m/s]", "omega_sent [rad/s]"),
    "battery [V]",
)
#: Columns of words; all others hold numbers.
WORDS = frozenset({"stage", "phase", "views_health", "estimate_health", "event", "blame"})
#: Columns that differ between two runs of one seed, after all others.
TIMING = ("lateness [ms]", "missed", "blame", *(f"{name} [ms]" for name in STAGES[:-1]))
#: What every log has: between these are the plugins' signals.
COLUMNS = (*_CORE, *TIMING)


class Reporting(Protocol):
    """Anything with numbers for columns: a plugin, or what judges one."""

    signals: ClassVar[tuple[Signal, ...]]


class Recorder(Observer):
    """Writes ``ticks.csv`` and ``trajectory.tum``.

    The trajectory is the true pose where it is known, else the odometry, in REP-103 axes. On
    the wall clock a thread does the writing, so that a slow disk never delays a tick; where
    time stands still during a tick, the tick does it. What is written is flushed twice a second,
    so that a crash leaves a readable log. A run whose record cannot be kept ends: `on_tick` raises
    `DiskError` once the disk is full.

    Parameters
    ----------
    directory : Path
        Where to write.
    plugins : sequence of (name, Reporting)
        Whose signals become columns.
    lockstep : bool
        Time stands still during a tick.
    """

    def __init__(
        self, directory: Path, plugins: Sequence[tuple[str, Reporting]], *, lockstep: bool
    ) -> None:
        self._signals = _signal_columns(plugins)
        self._ticks = (directory / TICKS).open("w", encoding="utf-8", newline="")
        self._trajectory = (directory / TRAJECTORY).open("w", encoding="utf-8")
        self._rows = csv.writer(self._ticks, lineterminator="\n")
        self._rows.writerow((*_CORE, *self._signals.values(), *TIMING))
        self._flushed_at = -math.inf
        self._given_up = 0
        #: What went wrong, empty if nothing, and whether the log is cut short.
        self.problem = ""
        self.failed = False
        self._queue: SimpleQueue[TickRecord | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        if not lockstep:
            self._thread = threading.Thread(target=self._write_queued, name="recorder", daemon=True)
            self._thread.start()

    def on_tick(self, record: TickRecord) -> None:
        """Write a tick, or queue it for writing.

        Raises
        ------
        DiskError
            Writing has failed.
        """
        if self._thread is None:
            self._write_safely(record)
        elif self._queue.qsize() < _BACKLOG:
            self._queue.put(record)
        else:
            self._given_up += 1
        if self.failed:
            raise DiskError(self.problem)

    def close(self) -> None:
        """Write what is left and close the files."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
        try:
            self._ticks.close()
            self._trajectory.close()
        except OSError as error:
            self._fail(error)
        if self._given_up and not self.problem:
            self.problem = f"{self._given_up} ticks were not recorded: the disk was too slow"

    def _write_queued(self) -> None:
        while (record := self._queue.get()) is not None:
            self._write_safely(record)

    def _write_safely(self, record: TickRecord) -> None:
        if self.failed:
            return
        try:
            self._write(record)
            now = time.monotonic()
            if now - self._flushed_at > _FLUSH_S:
                self._ticks.flush()
                self._trajectory.flush()
                self._flushed_at = now
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failed = True
        self.problem = f"recording ended early: {error.strerror or error}"

    def _write(self, record: TickRecord) -> None:
        signals = {
            (name, key): value for name, values in record.signals for key, value in values.items()
        }
        timing = (
            _MS * record.tick.lateness,
            record.tick.missed,
            record.blame,
            *(_MS * seconds for seconds in record.seconds),
        )
        self._rows.writerow((*_core(record), *map(signals.get, self._signals), *timing))
        pose = record.truth or record.odometry.pose
        if math.isfinite(pose.x):
            self._trajectory.write(_tum(record.t, pose))


def _signal_columns(plugins: Sequence[tuple[str, Reporting]]) -> dict[tuple[str, str], str]:
    """Return the header of each signal by plugin and signal name."""
    return {
        (name, signal.name): f"{name}.{signal.name} [{signal.unit}]"
        for name, plugin in plugins
        for signal in plugin.signals
    }


def _core(record: TickRecord) -> tuple[object, ...]:
    odometry, wanted = record.odometry, record.decision.velocity
    return (
        record.number,
        record.t,
        record.stage,
        record.decision.phase,
        record.tick.dt,
        record.frame.sequence,
        record.frame.stamp,
        len(record.views),
        record.views.health,
        record.estimate.health,
        record.event,
        *(record.truth or (None, None, None)),
        *odometry.pose,
        *odometry.velocity,
        *wanted,
        *record.sent,
        record.battery_v,
    )


def _tum(t: float, pose: Pose) -> str:
    """Return one line of a TUM trajectory: time, position, quaternion."""
    x, y, yaw = pose.y, -pose.x, pose.phi  # REP-103, as `visctrl.robots.unicycle.to_rep103`
    return f"{t:.6f} {x:.9f} {y:.9f} 0 0 0 {math.sin(yaw / 2):.12f} {math.cos(yaw / 2):.12f}\n"
