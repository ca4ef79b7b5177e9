"""Fig. 3.9–3.13 of the source: one recording, seen by SIFT and by Lucas–Kanade."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from visctrl.geometry.trifocal.tensor import ELEMENTS, normalised, tensor_from_poses
from visctrl.hal.types import Pose
from visctrl.reproduce.entry import Bench, Row
from visctrl.runtime.config import parse_setting
from visctrl.runtime.recorder import TICKS
from visctrl.runtime.recording import open_recording
from visctrl.runtime.replay import replay
from visctrl.runtime.replay_plan import load_for_replay, plan_replay
from visctrl.runtime.run_directory import RunDirectory
from visctrl.studies.run_spec import RunSpec
from visctrl.viewers.report.ticks import Ticks, read_ticks

Array = NDArray[np.float64]

#: The element that all others are divided by.
_UNIT = "T121"
#: Way driven since the initial view (m) from which its tensor is determined: before, and
#: within the same distance of the target, two of the three views are the same.
_APART_M = 0.2
#: The source's estimator: five-point samples, RANSAC.
_TENSOR = ("estimator.name=tensor", "estimator.method=linear5")
_SIFT, _LK = ("perception.name=sift", *_TENSOR), ("perception.name=klt", *_TENSOR)
#: Pairs of replays: the source's numbers of points (34 matches against 12 tracks), and all.
_PAIRS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "as many points as the source": (
        (*_SIFT, "perception.keypoints=300"),
        (*_LK, "perception.max_features=12"),
    ),
    "all points": (_SIFT, _LK),
}
_NAMES = ("SIFT", "Lucas-Kanade")


def figure_3_10(bench: Bench) -> list[Row]:
    """Replay one rendered sequence with SIFT and with Lucas–Kanade: variance of each element.

    The source prints pictures, no numbers: a row holds where SIFT scatters more than the
    tracked points do. The reference is the tensor of the true poses.
    """
    recording = bench.out / "recording"
    bench.run([RunSpec("default", ("backend=sim", "record_images=true"), recording)])
    cases = [(pair, k) for pair in _PAIRS for k in (0, 1)]
    errors: dict[str, tuple[Array, Array]] = {}
    for done, (pair, k) in enumerate(cases):
        bench.announce(len(cases), done)
        case = f"{_NAMES[k]}, {pair}"
        directory = bench.out / case.lower().replace(",", "").replace(" ", "-")
        _replay(recording, _PAIRS[pair][k], directory)
        errors[case] = _errors(directory)
    bench.announce(len(cases), len(cases))
    _plot(bench.out / "elements.png", errors)
    return [
        _row(element, pair, *(errors[f"{name}, {pair}"][1] for name in _NAMES))
        for pair in _PAIRS
        for element in ELEMENTS
        if element != _UNIT
    ]


def _row(element: str, pair: str, sift: Array, tracked: Array) -> Row:
    """Compare the variance of an element's error, and of its changes from tick to tick."""
    i = ELEMENTS.index(element)
    ours = {
        "variance_sift": float(np.var(sift[:, i])),
        "variance_lk": float(np.var(tracked[:, i])),
        "jumps_sift": _jumps(sift[:, i]),
        "jumps_lk": _jumps(tracked[:, i]),
    }
    bound = {"variance_lk": ours["variance_sift"], "jumps_lk": ours["jumps_sift"]}
    more = ours["variance_sift"] > ours["variance_lk"] and ours["jumps_sift"] > ours["jumps_lk"]
    return Row(f"{element}, {pair}", ours, bound=bound, ok=more)


def _replay(recording: Path, settings: tuple[str, ...], out: Path) -> None:
    images = open_recording(recording, None, lambda: 10.0)
    plan = plan_replay(load_for_replay(images, [parse_setting(text) for text in settings]))
    replay(images, plan, RunDirectory(out, overwrite=True))


def _errors(directory: Path) -> tuple[Array, Array]:
    """Return times (N,) and errors (N, 8) of the normalised tensor in the main stage."""
    ticks = read_ticks(directory / TICKS)
    main = np.array([stage == "main" for stage in ticks.words["stage"]])
    ok = np.array([health == "ok" for health in ticks.words["estimate_health"]])
    poses = np.stack([ticks.numbers[f"{name}_true"] for name in ("x", "y", "phi")], axis=-1)
    initial = Pose(*poses[np.argmax(main)].tolist())
    way = np.linalg.norm(poses[:, :2] - poses[np.argmax(main), :2], axis=1)
    togo = np.linalg.norm(poses[:, :2], axis=1)
    used = main & ok & (way > _APART_M) & (togo > _APART_M)
    truth = normalised(tensor_from_poses(np.broadcast_to(initial, poses.shape), poses))
    return ticks.numbers["t"][used], (_elements(ticks) - truth)[used]


def _elements(ticks: Ticks) -> Array:
    return np.stack([ticks.numbers[f"tensor.{name}"] for name in ELEMENTS], axis=-1)


def _jumps(error: Array) -> float:
    """Return the variance of what changes at random from one tick to the next."""
    return float(np.var(np.diff(error)) / 2.0)


def _plot(path: Path, errors: Mapping[str, tuple[Array, Array]]) -> None:
    figure = Figure(figsize=(13, 7), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle("error of the normalised tensor's elements, five-point RANSAC")
    axes = figure.subplots(2, 4).ravel()
    for i, (axis, element) in enumerate(zip(axes, ELEMENTS, strict=True)):
        for case, (t, error) in errors.items():
            axis.plot(t, error[:, i], label=case, linewidth=0.9)
        axis.set(title=element, xlabel="time (s)")
        axis.grid(alpha=0.3)
    axes[ELEMENTS.index(_UNIT)].legend(fontsize=7)
    figure.savefig(path, dpi=110)
