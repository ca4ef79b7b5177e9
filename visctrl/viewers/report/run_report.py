"""``report.html``: one run on one page, made from the files in its directory."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from visctrl.contracts import Array
from visctrl.hal.types import Pose
from visctrl.robots import load_robot
from visctrl.robots.documents import read_json, read_yaml, validate
from visctrl.robots.errors import InputError
from visctrl.robots.files import read_bytes, write_text, writing
from visctrl.robots.plain_yaml import MOST_BYTES
from visctrl.runtime.config import to_yaml
from visctrl.runtime.recorder import (
    CONFIG,
    FAULT,
    FINAL,
    INITIAL,
    REPORT,
    SUMMARY,
    TARGET,
    TICKS,
    VIDEO,
)
from visctrl.viewers.report.outcome import Driven, Outcome, Settings
from visctrl.viewers.report.page import download, page, picture, section, tiles, verdict
from visctrl.viewers.report.panels import (
    Span,
    estimated_pose,
    events,
    main_charts,
    other_charts,
    phases,
)
from visctrl.viewers.report.svg import draw_chart
from visctrl.viewers.report.ticks import Ticks, read_ticks
from visctrl.viewers.report.topview import DrivenPath, Outline, box_shape, disc_shape, draw_paths

_MOST_EVENTS = 30


@dataclass(frozen=True)
class RunFiles:
    """What the files of a run hold.

    config : every key that the run depended on; summary : its outcome (see `summarise`).
    """

    directory: Path
    config: dict[str, Any]
    summary: dict[str, Any]
    ticks: Ticks

    @property
    def scheme(self) -> str:
        """Scheme and backend in words."""
        return f"{self.config.get('scheme', '?')} on {self.config.get('backend', '?')}"

    def outline(self) -> Outline | None:
        """Return the robot's outline; None for a robot that is not known here."""
        try:
            robot = load_robot(self.config["robot"])
            return Outline.of(robot, robot.mount(self.config["camera"]["mount"]))
        except (InputError, KeyError, TypeError):
            return None

    def obstacles(self) -> list[Array]:
        """Return the shapes (N, 2) of the boxes and listed obstacles that the scenario names."""
        try:
            boxes = self.config["sim"]["boxes"] if self.config["backend"] == "sim" else ()
            shapes = [
                box_shape(
                    box["x_m"],
                    box["y_m"],
                    (box["width_m"], box["depth_m"]),
                    math.radians(box["yaw_deg"]),
                )
                for box in boxes
            ]
            shapes += [
                disc_shape(disc["x_m"], disc["y_m"], disc["radius_m"])
                for provider in self.config["obstacles"]
                for disc in provider.get("discs", ())
            ]
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
            return []
        return shapes


def read_run(directory: Path) -> RunFiles:
    """Read a run's directory.

    Raises
    ------
    InputError
        It holds no run, or one whose files cannot be read; the message names the file.
    """
    if not os.path.isdir(directory):
        raise InputError(f"{directory}: no such run directory")
    if not os.path.exists(directory / TICKS):
        raise InputError(f"{directory}: holds no run: {TICKS} is missing")
    ticks = read_ticks(directory / TICKS)
    config = read_yaml(directory / CONFIG)
    path = directory / SUMMARY
    if not os.path.lexists(path):
        raise InputError(f"{path}: no such file: has the run ended?")
    summary = read_json(path)
    if not isinstance(summary, dict) or "status" not in summary:
        raise InputError(f"{path}: is not the summary of a run")
    validate(summary, Outcome, str(path))
    if "path_length_m" in summary:
        validate(summary, Driven, str(path))
    validate(config, Settings, str(directory / CONFIG))
    return RunFiles(directory, config, summary, ticks)


def write_report(directory: Path, target: Path | None = None) -> Path:
    """Write the page of a run and return its path.

    Parameters
    ----------
    directory : Path
        Of the run.
    target : Path or None
        The page; None for ``report.html`` in the run's directory.

    Raises
    ------
    InputError
        The directory holds no run that can be read, or cannot be written to.
    """
    run = read_run(directory)
    target = target or directory / REPORT
    save(target, page(f"{run.summary['status']}: {run.scheme}", _body(run)))
    return target


def save(target: Path, text: str) -> None:
    """Write a page.

    Raises
    ------
    InputError, DiskError
        It cannot be written.
    """
    with writing(target):
        write_text(target, text)


def final_error(summary: Mapping[str, Any]) -> str:
    """Return the distance and heading left at the end, in words."""
    error = summary.get("final_error")
    if error is None:
        return "not known"
    distance = 100.0 * float(np.hypot(error["x_m"], error["y_m"]))
    return f"{distance:.2f} cm, {abs(error['phi_deg']):.2f}°"


def _body(run: RunFiles) -> str:
    spans = phases(run.ticks)
    shades = [(span.begin, span.end) for span in spans[1::2]]
    charts = [draw_chart(chart, shades) for chart in main_charts(run.ticks)] if run.ticks else []
    others = [draw_chart(chart, shades) for chart in other_charts(run.ticks)] if run.ticks else []
    parts = [_head(run), _pictures(run.directory)]
    if charts:
        top = f'<div class="charts">{"".join(charts[:4])}</div>'
        course = f'<div class="overview">{_path(run)}{top}</div>'
        parts.append(section("The drive", _timeline(spans) + _events(run.ticks) + course))
        parts.append(
            section(
                "What it saw, and what that cost",
                f'<div class="charts">{"".join(charts[4:])}</div>',
            )
        )
    if others:
        parts.append(
            section("Other signals", f'<div class="charts">{"".join(others)}</div>', closed=True)
        )
    parts += [_fault(run.directory), _again(run)]
    return "".join(parts)


def _head(run: RunFiles) -> str:
    summary, config = run.summary, run.config
    title = config.get("title") or run.scheme
    camera = config.get("camera", {})
    about = (
        f"{config.get('scheme')} scheme, backend {config.get('backend')}, robot "
        f"{config.get('robot')}, camera {summary.get('camera')} {camera.get('width')}×"
        f"{camera.get('height')} (mount {camera.get('mount')}), seed {config.get('seed')}; "
    )
    files = escape(str(os.path.basename(os.path.realpath(run.directory))))
    if os.path.exists(run.directory / VIDEO):
        files += f', <a href="{VIDEO}">video</a>'
    return (
        f"<header><h1>{escape(title)}</h1><p>{verdict(summary['status'])} "
        f"{escape(summary.get('reason', ''))}</p>"
        f'<p class="lead">{escape(about)}run {files}</p>{tiles(numbers(summary).items())}</header>'
    )


def numbers(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the outcome's numbers in words; a replay has fewer than a run."""
    found = {}
    if "path_length_m" in summary:
        found["final error"] = final_error(summary)
        found["path"] = f"{summary['path_length_m']:.2f} m"
        found["time"] = f"{summary['duration_s']:.1f} s"
        found["ticks"] = f"{summary['ticks']}, {summary['missed_ticks']} missed"
    compute, features = summary.get("compute_ms", {}), summary.get("features", {})
    if None not in (compute.get("median"), compute.get("p99")):
        found["tick, median / p99"] = f"{compute['median']:.1f} / {compute['p99']:.1f} ms"
    if None not in (features.get("median"), features.get("min")):
        found["features, median / least"] = f"{features['median']:g} / {features['min']:g}"
    return found


def _pictures(directory: Path) -> str:
    views = (
        (INITIAL, "First view, and where its features go"),
        (FINAL, "Last view, and where its features came from"),
        (TARGET, "Target view"),
    )
    shown = "".join(picture(directory / name, caption) for name, caption in views)
    return section("What the camera saw", f'<div class="pictures">{shown}</div>') if shown else ""


def _path(run: RunFiles) -> str:
    ticks = run.ticks
    known = ticks.pose_source == "true"
    paths = [DrivenPath("true path" if known else "odometry", ticks.t, *ticks.pose(), colour=0)]
    pose = estimated_pose(ticks)
    if known and pose is not None:
        paths.append(DrivenPath("estimated path", ticks.t, *pose, colour=1, dashed=True))
    target = Pose(0.0, 0.0, 0.0) if known else None
    what = "path in the target's frame" if known else "path by odometry, from where it connected"
    obstacles = run.obstacles() if known else ()
    return draw_paths(paths, run.outline(), target, obstacles, caption=what)


def _timeline(spans: Sequence[Span]) -> str:
    bars = []
    for span in spans:
        name, length = escape(span.name), max(span.end - span.begin, 0.01)
        when = f"{span.begin:.1f} to {span.end:.1f} s"
        bars.append(f'<span style="flex-grow:{length:.2f}" title="{name}: {when}">{name}</span>')
    return f'<div class="timeline">{"".join(bars)}</div>'


def _events(ticks: Ticks) -> str:
    found = events(ticks)
    items = [f"<li>{t:.1f} s: {escape(text)}</li>" for t, text in found[:_MOST_EVENTS]]
    if len(found) > _MOST_EVENTS:
        items.append(f"<li>and {len(found) - _MOST_EVENTS} more, see {TICKS}</li>")
    return f'<ul class="events">{"".join(items)}</ul>' if items else ""


def _fault(directory: Path) -> str:
    path = directory / FAULT
    if not os.path.isfile(path):
        return ""
    text = read_bytes(path, MOST_BYTES).decode(errors="replace")
    return section("The fault", f"<pre>{escape(text)}</pre>")


def _again(run: RunFiles) -> str:
    config = to_yaml(run.config)
    commands = (
        f"visctrl run {shlex.quote(str(run.directory))}        # from its run directory\n"
        f"visctrl run {CONFIG}        # from the configuration below, saved as {CONFIG}"
    )
    versions = ", ".join(
        f"{name} {number}" for name, number in run.summary.get("versions", {}).items()
    )
    return section(
        "Make it again",
        f"<pre>{escape(commands)}</pre><p>{download(CONFIG, config)}</p>"
        f'<p class="lead">{escape(versions)}</p>'
        + section(
            "Configuration, every default filled in", f"<pre>{escape(config)}</pre>", closed=True
        ),
    )
