"""The path from above as SVG, with the robot's outline at intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from visctrl.contracts import Array
from visctrl.hal.types import Pose
from visctrl.robots import Robot
from visctrl.robots.model import Mount
from visctrl.viewers.report.svg import line_path, number, round_steps

#: A new outline after so much way (m) or turn (rad).
_EVERY = (0.3, math.radians(30.0))
_MOST_OUTLINES = 40
#: Poses kept for the marker that follows the cursor.
_MOST_POSES = 600
#: Canvas of a picture that is as wide as high (px), and what is left around the plot.
_SIZE, _MARGIN = 440.0, 34.0
_MOST_STRETCHED = 1.45


@dataclass(frozen=True)
class DrivenPath:
    """A path to draw.

    t : (N,) times (s); x, y, phi : (N,) poses of the camera (m, rad).
    colour : number of a colour of the style sheet.
    """

    name: str
    t: Array
    x: Array
    y: Array
    phi: Array
    colour: int
    dashed: bool = False


@dataclass(frozen=True)
class Outline:
    """A robot seen from above: a rectangle about its camera.

    corners : (5, 2) right and forward of the camera (m), closed.
    """

    corners: Array

    @classmethod
    def of(cls, robot: Robot, mount: Mount) -> Outline:
        """Return the outline of a robot that carries its camera on ``mount``."""
        half = robot.body.width_m / 2.0
        front = robot.body.front_m - mount.forward_m
        rear = -robot.body.rear_m - mount.forward_m
        corners = [(-half, rear), (half, rear), (half, front), (-half, front), (-half, rear)]
        return cls(np.array(corners))

    def at(self, pose: Pose) -> Array:
        """Return the corners (5, 2) at a pose of the camera."""
        s, c = math.sin(pose.phi), math.cos(pose.phi)
        right, forward = self.corners.T
        x, y = pose.x + c * right - s * forward, pose.y + s * right + c * forward
        return np.stack([x, y], axis=1)


def box_shape(x: float, y: float, size: tuple[float, float], yaw: float) -> Array:
    """Return the corners (4, 2) of a box of width and depth (m) turned by ``yaw`` (rad)."""
    right, forward = 0.5 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]).T * np.array([size]).T
    c, s = math.cos(yaw), math.sin(yaw)
    return np.stack([x + c * right - s * forward, y + s * right + c * forward], axis=1)


def disc_shape(x: float, y: float, radius: float) -> Array:
    """Return points (36, 2) on a circle (m)."""
    angle = np.radians(np.arange(0.0, 360.0, 10.0))
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def draw_paths(
    paths: Sequence[DrivenPath],
    outline: Outline | None,
    target: Pose | None,
    obstacles: Sequence[Array] = (),
    *,
    caption: str,
) -> str:
    """Return a ``<figure>`` of paths seen from above, equal scales, x right and y up.

    Parameters
    ----------
    paths : sequence of DrivenPath
        The robot's outline is drawn along the first.
    outline : Outline or None
        Of the robot, if it is to be drawn.
    target : Pose or None
        Where it is known.
    obstacles : sequence of (N, 2) arrays
        Corners of what stands there (m).
    caption : str
        What is shown.
    """
    poses = _spaced(paths[0]) if outline is not None else []
    corners = [outline.at(pose) for pose in poses] if outline is not None else []
    ends = [*corners, *(np.stack([path.x, path.y], axis=1) for path in paths)]
    if target is not None:
        ends.append(np.array([[target.x, target.y]]) if outline is None else outline.at(target))
    frame = _Frame.around(np.concatenate([*ends, *obstacles]))
    parts = frame.grid()
    parts += [f'<path class="obstacle" d="{frame.path(*shape.T)}Z"/>' for shape in obstacles]
    if target is not None:
        parts += _target(frame, outline, target)
    parts += [f'<path class="outline" d="{frame.path(c[:, 0], c[:, 1])}Z"/>' for c in corners]
    for path in paths:
        dashed = " dashed" if path.dashed else ""
        parts.append(
            f'<path class="line c{path.colour}{dashed}" d="{frame.path(path.x, path.y)}"/>'
        )
    for path in paths:
        parts += _start(frame, path)
    marker = frame.marker(paths[0], outline) if outline is not None else ""
    legend = "".join(
        f'<span class="key c{path.colour}{" dashed" if path.dashed else ""}"><i></i>'
        f"{escape(path.name)}</span>"
        for path in paths
    )
    return (
        f'<figure class="path"><figcaption><b>{escape(caption)}</b><span class="unit">m</span>'
        f'<span class="legend">{legend}</span></figcaption>'
        f'<svg viewBox="0 0 {frame.wide:.0f} {frame.high:.0f}" role="img" '
        f'aria-label="{escape(caption)}">{"".join(parts)}{marker}</svg></figure>'
    )


@dataclass(frozen=True)
class _Frame:
    """Where metres lie on the canvas."""

    left: float
    top: float
    scale: float
    wide: float
    high: float

    @classmethod
    def around(cls, points: Array) -> _Frame:
        good = points[np.isfinite(points).all(axis=1)]
        low, high = (good.min(axis=0), good.max(axis=0)) if len(good) else (np.zeros(2),) * 2
        size = np.maximum(high - low, 0.5)
        size = np.maximum(size, size.max() / _MOST_STRETCHED) * 1.06
        middle = (low + high) / 2.0
        scale = (_SIZE - 2.0 * _MARGIN) / float(size[0])
        tall = scale * float(size[1]) + 2.0 * _MARGIN
        left, top = middle[0] - size[0] / 2.0, middle[1] + size[1] / 2.0
        return cls(float(left), float(top), scale, _SIZE, tall)

    def u(self, x: Array) -> Array:
        return _MARGIN + self.scale * (x - self.left)

    def v(self, y: Array) -> Array:
        return _MARGIN + self.scale * (self.top - y)

    def point(self, x: float, y: float) -> tuple[float, float]:
        return float(self.u(np.array(x))), float(self.v(np.array(y)))

    def path(self, x: Array, y: Array) -> str:
        return line_path(self.u(x), self.v(y))

    def grid(self) -> list[str]:
        right = self.left + (self.wide - 2.0 * _MARGIN) / self.scale
        bottom = self.top - (self.high - 2.0 * _MARGIN) / self.scale
        lines = max(3, round((self.high - 2.0 * _MARGIN) / 70.0))
        steps = round_steps(bottom, self.top, lines)
        step = steps[1] - steps[0] if len(steps) > 1 else 1.0
        first, last = math.ceil(self.left / step - 1e-9), math.floor(right / step + 1e-9)
        parts = []
        for x in (k * step for k in range(first, last + 1)):
            u, _ = self.point(x, 0.0)
            parts.append(
                f'<path class="grid" d="M{u:.1f} {_MARGIN:g}V{self.high - _MARGIN:.1f}"/>'
                f'<text class="label" x="{u:.1f}" y="{self.high - _MARGIN + 15:.1f}" '
                f'text-anchor="middle">{number(round(x, 9))}</text>'
            )
        for y in steps:
            _, v = self.point(0.0, y)
            parts.append(
                f'<path class="grid" d="M{_MARGIN:g} {v:.1f}H{self.wide - _MARGIN:g}"/>'
                f'<text class="label" x="{_MARGIN - 5:g}" y="{v + 3.5:.1f}" text-anchor="end">'
                f"{number(y)}</text>"
            )
        return parts

    def marker(self, path: DrivenPath, outline: Outline) -> str:
        """Return the robot that follows the cursor, with the poses it may take."""
        step = max(1, len(path.t) // _MOST_POSES)
        rows = zip(path.t[::step], self.u(path.x)[::step], self.v(path.y)[::step], strict=True)
        angles = -np.degrees(path.phi)[::step]
        data = ";".join(
            f"{t:.2f},{u:.1f},{v:.1f},{a:.1f}"
            for (t, u, v), a in zip(rows, angles, strict=True)
            if math.isfinite(u) and math.isfinite(v)
        )
        right, forward = (self.scale * outline.corners).T
        return (
            f'<g class="robot" hidden data-poses="{data}"><path d="{line_path(right, -forward)}Z"/>'
            f'<path d="M0 0V{-float(forward.max()):.1f}"/></g>'
        )


def _spaced(path: DrivenPath) -> list[Pose]:
    """Return poses along a path, spaced by way and turn; the last one always."""
    known = np.isfinite(path.x) & np.isfinite(path.y) & np.isfinite(path.phi)
    x, y, phi = path.x[known], path.y[known], path.phi[known]
    if not len(x):
        return []
    way = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
    turn = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(np.unwrap(phi))))))
    distance = way / _EVERY[0] + turn / _EVERY[1]
    count = min(_MOST_OUTLINES, max(1, int(distance[-1]))) + 1
    places = np.searchsorted(distance, np.linspace(0.0, distance[-1], count) - 1e-9)
    places = np.unique(np.append(places, len(x) - 1))
    return [Pose(float(x[i]), float(y[i]), float(phi[i])) for i in places.tolist()]


def _target(frame: _Frame, outline: Outline | None, target: Pose) -> list[str]:
    u, v = frame.point(target.x, target.y)
    parts = [f'<path class="target" d="M{u - 8:.1f} {v:.1f}h16M{u:.1f} {v - 8:.1f}v16"/>']
    if outline is not None:
        corners = outline.at(target)
        shape = frame.path(corners[:, 0], corners[:, 1])
        parts.append(f'<path class="target ghost" d="{shape}Z"/>')
    return parts


def _start(frame: _Frame, path: DrivenPath) -> list[str]:
    known = np.flatnonzero(np.isfinite(path.x) & np.isfinite(path.y))
    if not known.size:
        return []
    u, v = frame.point(float(path.x[known[0]]), float(path.y[known[0]]))
    return [f'<circle class="start c{path.colour}" cx="{u:.1f}" cy="{v:.1f}" r="4"/>']
