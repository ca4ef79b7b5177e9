"""``visctrl replay``: from options to a table."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, TaskID

from visctrl.cli.run import Place, stem
from visctrl.robots.errors import InputError
from visctrl.runtime.config import Override, load_scenario
from visctrl.runtime.images import TICK
from visctrl.runtime.recording import Recording, open_recording
from visctrl.runtime.records import Observer, TickRecord
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.replay import replay
from visctrl.runtime.replay_plan import load_for_replay, plan_replay
from visctrl.viewers.run_pictures import Pictures


def replay_images(
    source: Path,
    overrides: Sequence[Override],
    target: Path | None,
    place: Place,
    *,
    video: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Replay images and report.

    Raises
    ------
    InputError
        Images or options cannot be used.
    """

    def rate_hz() -> float:
        known = REGISTRIES.backends.names()
        return load_scenario(overrides=overrides, backend_names=known).scenario.rate_hz

    recording = open_recording(source, target, rate_hz)
    if recording.camera is None and not any(o.path == ("camera", "name") for o in overrides):
        raise InputError(f"{source}: say with --camera which camera took these images")
    loaded = load_for_replay(recording, overrides)
    recorded = recording.config is not None
    named = any(override.path == ("controller", "name") for override in overrides)
    plan = plan_replay(loaded, recorded=recorded, named=named)
    _distinct(source, place.out)
    if not _ticks(recording):
        raise InputError(f"{source}: holds no tick to replay: the run ended before it began")
    directory = place.claim(stem(f"replay-{plan.perception.name}"))
    console = Console(stderr=True)
    with Progress(console=console, disable=quiet, transient=True) as bar:
        watch = _Watch(bar, bar.add_task("replay", total=_ticks(recording)))
        pictures = Pictures(plan, directory.path, video=video)
        summary = replay(recording, plan, directory, observers=[watch, pictures])
    if as_json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    elif not quiet:
        _show(summary, directory.path)


_PLUGINS = ("perception", "estimator", "controller")


class _Watch(Observer):
    def __init__(self, bar: Progress, task: TaskID) -> None:
        self._bar, self._task = bar, task

    def on_tick(self, record: TickRecord) -> None:
        self._bar.advance(self._task)


def _ticks(recording: Recording) -> int:
    return sum(shot.role == TICK for shot in recording.shots)


def _distinct(source: Path, out: Path | None) -> None:
    """Refuse to write over what is read."""
    read = os.path.realpath(source)
    if out is not None and os.path.realpath(out) in (read, os.path.dirname(read)):
        raise InputError(f"--out {out}: this would replace the recording: choose another directory")


def _show(summary: Mapping[str, Any], directory: Path) -> None:
    """Print the short table at the end of a replay."""
    health, cost = summary["health"], summary["stages_ms"]
    rows = [
        ("plugins", ", ".join(summary[k] for k in _PLUGINS if summary[k] is not None)),
        ("images", f"{sum(health['views'].values())}: views {_counts(health['views'])}"),
        ("estimates", _counts(health["estimate"])),
    ]
    features = summary["features"]
    if features["median"] is not None:
        rows.append(("features", f"median {features['median']:g}, least {features['min']}"))
    if cost["perception"]["median"] is not None:
        times = ", ".join(f"{name} {value['median']:.1f} ms" for name, value in cost.items())
        rows.append(("median cost", times))
    rows.append(("files", str(directory)))
    for name, text in rows:
        print(f"{name:<12} {text}")


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"
