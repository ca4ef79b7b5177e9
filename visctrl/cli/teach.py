"""``visctrl teach``: the target view, by showing it to the robot."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hal.errors import CameraError
from hal.interfaces import Backend
from hal.types import Frame
from robots.errors import InputError
from visctrl.cli.run import check_flags
from visctrl.config import Override, load_scenario
from visctrl.perception.quality import Quality, assess
from visctrl.report.frames import draw_frame, save_picture
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.target_view import TargetView, now_text

#: Longest wait for another picture (s).
_PICTURE_S = 2.0
_POLL_S = 0.01

#: Of a target's features, about these shares are found again from near and from far; measured
#: in the simulated hall from 1.5 m and 3.5 m.
_FOUND_NEAR, _FOUND_FAR = 0.3, 0.15
#: Matches that start a run with room to spare, and the least that start one.
_COMFORTABLE, _ENOUGH = 60, 20
#: Below this a picture is visibly blurred (two pixels or so).
_SHARP = 0.55
#: Mean brightness outside which a picture is too dark or too bright, of 255.
_DARK, _BRIGHT = 40, 215
_CONTRAST = 15


def teach(
    scenario: str, overrides: Sequence[Override], out: Path, count: int, preview: Path | None
) -> int:
    """Take ``count`` pictures where the robot stands (a simulated one visits its target).

    Raises
    ------
    InputError, DeviceError
        A device or option cannot be used, or the view cannot serve as a target.
    """
    untaught = Override(("target", "file"), None, "visctrl teach")
    loaded = load_scenario(scenario, [*overrides, untaught], REGISTRIES.backends.known())
    check_flags(overrides, loaded.scenario.backend)
    plan = make_plan(loaded)
    if plan.backend.delivers_features:
        raise InputError(f"backend '{loaded.scenario.backend}' takes no pictures")
    with Interrupts(), plan.open_backend() as backend:
        frames = backend.teach(count) or list(_pictures(backend, count))
        view = TargetView(
            images=np.stack([np.asarray(frame.image) for frame in frames]),
            camera=plan.camera,
            odometry=backend.base.odometry().pose,
            backend=loaded.scenario.backend,
            robot=plan.robot.name,
            taken=now_text(),
        )
    quality = assess(frames, plan.camera)
    findings = judge(quality)
    view.save(out)
    picture = preview or out.with_suffix(".png")
    _save_preview(picture, frames[0], plan, quality)
    _show(out, picture, findings)
    return 0


def judge(quality: Quality) -> list[tuple[bool, str, str]]:
    """Return what to think of a view: (good, figure, what it means)."""
    near, far = quality.features * _FOUND_NEAR, quality.features * _FOUND_FAR
    if far >= _COMFORTABLE:
        reach = "every scheme, from 3.5 m and more"
    elif near >= _COMFORTABLE:
        reach = "every scheme, from about 1.5 m; from 3.5 m it may not be recognised"
    elif near >= _ENOUGH:
        reach = "only from near by; show it more texture, or sharpen and light it better"
    else:
        reach = "too few to be recognised from anywhere else: choose another place"
    spread = quality.sectors / max(1, quality.visible)
    light = _DARK <= quality.mean <= _BRIGHT and quality.contrast >= _CONTRAST
    return [
        (near >= _COMFORTABLE, f"{quality.features} features", reach),
        (
            spread >= 0.6,
            f"in {quality.sectors} of {quality.visible} sectors of 30 deg",
            "spread well"
            if spread >= 0.6
            else "all in one corner of the view: positions will be several times less exact",
        ),
        (
            quality.sharpness >= _SHARP,
            f"sharpness {quality.sharpness:.2f}",
            "sharp" if quality.sharpness >= _SHARP else "blurred: focus, or let the robot stand",
        ),
        (
            light,
            f"mean {quality.mean:.0f}, contrast {quality.contrast:.0f} of 255",
            "well lit" if light else "badly lit: mind the exposure",
        ),
    ]


def _pictures(backend: Backend, count: int) -> Iterator[Frame]:
    """Yield pictures that follow each other."""
    clock = backend.clock
    last = -1
    for _ in range(count):
        deadline = clock.now() + _PICTURE_S
        while (frame := backend.camera.read()).sequence == last:
            if clock.now() > deadline:
                raise CameraError(f"no new picture for {_PICTURE_S:g} s")
            clock.sleep_until(clock.now() + _POLL_S)
        last = frame.sequence
        yield frame


def _save_preview(path: Path, frame: Frame, plan: Plan, quality: Quality) -> None:
    caption = f"target: {quality.features} features"
    try:
        save_picture(path, draw_frame(frame, plan.camera, quality.pixels, caption))
    except OSError as error:
        print(f"visctrl: no preview: {error}", file=sys.stderr)


def _show(out: Path, picture: Path, findings: list[tuple[bool, str, str]]) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for good, figure, meaning in findings:
        table.add_row("[green]ok[/green]" if good else "[yellow]warning[/yellow]", figure, meaning)
    table.add_row("files", str(out), str(picture))
    Console().print(table)
