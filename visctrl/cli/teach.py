"""``visctrl teach``: the target view, by showing it to the robot."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from visctrl.hal.types import Frame
from visctrl.perception.quality import Quality, assess
from visctrl.robots.files import absolute, owner_only
from visctrl.runtime.config import Override
from visctrl.runtime.interrupts import Interrupts
from visctrl.runtime.overrides import load_for_backend
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.target_view import TargetView
from visctrl.runtime.teaching import take_target
from visctrl.viewers.video.frames import draw_frame, save_picture

#: Of a target's features, about these shares are found again from near and from far; measured
#: in the simulated hall from 1.5 m and 3.5 m.
_FOUND_NEAR, _FOUND_FAR = 0.3, 0.15
#: Matches that start a run with room to spare, and the least that start one.
_COMFORTABLE, _ENOUGH = 60, 20
#: Below this a picture is visibly blurred (two pixels or so).
_SHARP = 0.55
#: Mean brightness outside which a picture is too dark or too bright, of 255.
_DARK, _BRIGHT = 40, 215
#: Contrast (standard deviation, of 255) of a good picture, and that of one that may be noise.
_CONTRAST, _ABOVE_NOISE = 15, 8
#: Share of the visible sectors that hold features in a good picture.
_SPREAD = 0.6
#: Corners that decide arrival at least, on the floor too if that is to give the metres, and the
#: standard deviations (m, rad) from which it stays in doubt.
_CORNERS, _FLOOR, _ARRIVAL_M, _ARRIVAL_RAD = 40, 4, 0.005, math.radians(0.25)


def teach(
    scenario: str,
    overrides: Sequence[Override],
    flags: Mapping[str, Any],
    out: Path,
    count: int,
    preview: Path | None,
    *,
    shared: bool = False,
) -> int:
    """Take ``count`` pictures where the robot stands (a simulated one visits its target).

    ``flags`` are the options that belong to a backend (see `load_for_backend`).

    Raises
    ------
    InputError, DeviceError, DiskError
        A device, file or option cannot be used, or the view cannot serve as a target.
    """
    out = absolute(out)
    picture = absolute(preview or out.with_suffix(".png"))
    untaught = Override(("target", "file"), None, "visctrl teach")
    loaded = load_for_backend(scenario, [*overrides, untaught], flags)
    plan = make_plan(loaded)
    with Interrupts():
        view, frames = take_target(plan, count)
    quality = assess(frames, plan.camera)
    findings = [*judge(quality), judge_arrival(view, plan)]
    with owner_only(unless=shared):
        view.save(out)
        _save_preview(picture, frames[0], plan, quality)
    _show(out, picture, findings)
    return 0


def judge(quality: Quality) -> list[tuple[bool, str, str]]:
    """Return what to think of a view: (good, figure, what it means)."""
    near = quality.features * _FOUND_NEAR
    spread = quality.sectors / max(1, quality.visible) >= _SPREAD
    sharp = quality.sharpness >= _SHARP
    light = _light(quality)
    return [
        (
            near >= _COMFORTABLE and quality.contrast >= _ABOVE_NOISE,
            f"{quality.features} features",
            _reach(quality),
        ),
        (
            spread,
            f"in {quality.sectors} of {quality.visible} sectors of 30 deg",
            "spread well"
            if spread
            else "all in one corner of the view: positions will be several times less exact",
        ),
        (
            sharp,
            f"sharpness {quality.sharpness:.2f}",
            "sharp" if sharp else "blurred: focus, or let the robot stand",
        ),
        (
            not light,
            f"mean {quality.mean:.0f}, contrast {quality.contrast:.0f} of 255",
            light or "well lit",
        ),
    ]


def judge_arrival(view: TargetView, plan: Plan) -> tuple[bool, str, str]:
    """Return whether a view will tell that the robot has arrived, and what would help."""
    from visctrl.schemes.arrival.teaching import decidability

    found = decidability(list(view.images), plan.camera, plan.mount.height_m)
    figure = f"{found.features} corners to judge arrival by, {found.floor} of them on the floor"
    if found.features < _CORNERS:
        return False, figure, "too few: turn to more texture, light it better, or add marks"
    if found.position_sd > _ARRIVAL_M or found.heading_sd > _ARRIVAL_RAD:
        meaning = "arrival will stay in doubt: show it things nearer by and in more directions"
        return False, figure, meaning
    if found.twin is not None:
        turn = f"{math.degrees(found.twin):.0f} deg"
        return False, figure, f"looks the same turned by {turn}: add something that does not"
    sds = f"± {100.0 * found.position_sd:.2f} cm, ± {math.degrees(found.heading_sd):.2f} deg"
    if found.floor < _FLOOR:
        return True, figure, f"{sds} (at 4 m); how far, the wheels will tell"
    return True, figure, f"arrival will be told to {sds}"


def _reach(quality: Quality) -> str:
    """Return what the schemes can do with so many features."""
    near, far = quality.features * _FOUND_NEAR, quality.features * _FOUND_FAR
    if quality.contrast < _ABOVE_NOISE:
        return "in so little contrast they may be noise"
    if far >= _COMFORTABLE:
        return "every scheme, from 3.5 m and more"
    if near >= _COMFORTABLE:
        return "every scheme, from about 1.5 m; from 3.5 m it may not be recognised"
    if near >= _ENOUGH:
        return "only from near by; show it more texture, or sharpen and light it better"
    return "too few to be recognised from anywhere else: choose another place"


def _light(quality: Quality) -> str:
    """Return what is wrong with the light; empty if nothing is."""
    if quality.mean < _DARK:
        return "too dark: more light, or a longer exposure"
    if quality.mean > _BRIGHT:
        return "too bright: less light, or a shorter exposure"
    return "" if quality.contrast >= _CONTRAST else "little contrast: mind exposure and focus"


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
