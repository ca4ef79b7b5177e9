"""``visctrl list`` and ``visctrl config``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

from visctrl.hal.cameras.catalogue import camera_names, load_camera
from visctrl.robots import load_robot, robot_names
from visctrl.robots.errors import InputError
from visctrl.runtime.config import (
    Override,
    load_scenario,
    scenario_names,
    scenario_title,
    to_yaml,
)
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.schemes import schemes
from visctrl.studies.grid import study_names, study_title

_WIDE = 200


def show_everything() -> None:
    """Print scenarios, robots, cameras, backends, schemes and plugins."""
    # In a pipe there is no line to fit into.
    console = Console() if sys.stdout.isatty() else Console(width=_WIDE)
    registries = REGISTRIES
    _show(console, "scenarios", ((name, scenario_title(name)) for name in scenario_names()))
    _show(console, "studies", ((name, study_title(name)) for name in study_names()))
    _show(console, "robots", ((name, _robot_line(name)) for name in robot_names()))
    _show(console, "cameras", ((name, _camera_line(name)) for name in camera_names()))
    _show(console, "schemes", ((name, scheme.title) for name, scheme in schemes().items()))
    for title, registry in (
        ("backends", registries.backends),
        ("perception", registries.perception),
        ("estimators", registries.estimators),
        ("controllers", registries.controllers),
        ("obstacle providers", registries.obstacles),
    ):
        _show(console, title, ((name, registry.target(name)) for name in registry.names()))


def show_scenario(name: str, overrides: Sequence[Override], *, resolve: bool) -> None:
    """Print a scenario as YAML, checked; with ``resolve`` every default is filled in.

    Raises
    ------
    InputError
        It could not be run.
    """
    loaded = load_scenario(name, overrides, REGISTRIES.backends.names())
    plan = make_plan(loaded)
    data = plan.effective() if resolve else loaded.data
    sys.stdout.write(to_yaml(data))


def _robot_line(name: str) -> str:
    try:
        return load_robot(name).title
    except InputError as error:  # of another package, which is broken
        return f"cannot be used: {error}"


def _camera_line(name: str) -> str:
    camera = load_camera(name)
    return f"{camera.width}x{camera.height}, {camera.model}, looks {camera.optical_axis}"


def _show(console: Console, title: str, rows: Iterable[tuple[str, str]]) -> None:
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 2))
    for row in rows:
        table.add_row(*row)
    console.print(f"[bold]{title}[/bold]")
    console.print(table)
