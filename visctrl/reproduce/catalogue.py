"""The entries of ``visctrl reproduce``, imported when they are run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from visctrl.reproduce.entry import Bench, Row
from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError


@dataclass(frozen=True)
class Entry:
    """A table or figure that one command makes again.

    where : ``module:function``; the function takes a `Bench` and returns rows.
    """

    name: str
    title: str
    where: str

    def run(self, bench: Bench) -> list[Row]:
        """Run the entry; its files go to ``bench.out``."""
        module, function = self.where.split(":")
        work: Callable[[Bench], list[Row]] = getattr(import_module(module), function)
        bench.out.mkdir(parents=True, exist_ok=True)
        return work(bench)


_ENTRIES = (
    Entry(
        "arrival",
        "1,650 pictures about targets in 15 worlds: arrival by the image (the project's bounds)",
        "visctrl.reproduce.arrival:arrival",
    ),
    Entry(
        "arrival-starts",
        "113 starts within 0.3 m of the target, three conditions (bounds are the project's own)",
        "visctrl.reproduce.arrival_starts:arrival_starts",
    ),
    Entry(
        "sim-starts",
        "48 seeded starts on rendered images, trifocal scheme (bounds are the project's own)",
        "visctrl.reproduce.main_job:starts",
    ),
    Entry(
        "sim-cameras",
        "every camera and both robots on rendered images (bounds are the project's own)",
        "visctrl.reproduce.main_job:cameras",
    ),
    Entry(
        "camera-models",
        "four cameras with lens distortion, every scheme, four starts, rendered (own bounds)",
        "visctrl.reproduce.camera_models:camera_models",
    ),
    Entry(
        "table-2.1",
        "epipolar control from four starts: the smooth law; the source's shown beside it",
        "visctrl.reproduce.chapter2:table_2_1",
    ),
    Entry(
        "table-2.1-noise",
        "the same with 0.5 px noise, 20 seeds (bounds are the project's own)",
        "visctrl.reproduce.chapter2:table_2_1_noise",
    ),
    Entry(
        "fig-2.5",
        "epipolar control: paths and epipoles of the four starts",
        "visctrl.reproduce.chapter2:figure_2_5",
    ),
    Entry(
        "fig-2.6",
        "through the singularity with and without the sliding mode",
        "visctrl.reproduce.chapter2:figure_2_6",
    ),
    Entry(
        "fig-2.8",
        "epipolar control with omnidirectional cameras (bounds are the project's own)",
        "visctrl.reproduce.chapter2:figure_2_8",
    ),
    Entry(
        "fig-2.11",
        "epipolar control with wrong focal lengths and image centres",
        "visctrl.reproduce.chapter2:figure_2_11",
    ),
    Entry(
        "fig-2.12",
        "epipolar control with 0.5 px noise, median of 20 seeds (bounds are the project's own)",
        "visctrl.reproduce.chapter2:figure_2_12",
    ),
    Entry(
        "fig-2.13",
        "epipolar control of a simulated Pioneer, rendered images (bounds are the project's own)",
        "visctrl.reproduce.chapter2:figure_2_13",
    ),
    Entry(
        "robot-2.15",
        "the epipolar robot experiment on the simulator, rendered images",
        "visctrl.reproduce.chapter2:robot_2_15",
    ),
    Entry(
        "table-3.1",
        "trifocal control from four starts, and with 1 px noise (its bound is the project's own)",
        "visctrl.reproduce.chapter3:table_3_1",
    ),
    Entry(
        "phi-1",
        "trifocal control told any φ1 from -30 to 30 deg, every law (bound is the project's own)",
        "visctrl.reproduce.chapter3:figure_phi_1",
    ),
    Entry(
        "fig-3.3",
        "trifocal control: paths, states, tensor elements and inputs of the four starts",
        "visctrl.reproduce.chapter3:figure_3_3",
    ),
    Entry(
        "fig-3.6",
        "trifocal control with each omnidirectional camera: motion of the features",
        "visctrl.reproduce.chapter3:figure_3_6",
    ),
    Entry(
        "fig-3.7",
        "trifocal control with 1 px noise, 20 seeds (bounds are the project's own)",
        "visctrl.reproduce.chapter3:figure_3_7",
    ),
    Entry(
        "fig-3.10",
        "SIFT and Lucas-Kanade on one recording: variance of the tensor's elements",
        "visctrl.reproduce.chapter3_replay:figure_3_10",
    ),
    Entry(
        "trifocal-laws",
        "every trifocal law under what spoils real runs (bounds are the project's own)",
        "visctrl.reproduce.trifocal_laws:laws",
    ),
    Entry(
        "trifocal-2d",
        "the earlier scheme on the 2D tensor against the 1D tensor (bounds are the project's own)",
        "visctrl.reproduce.chapter3:earlier_scheme",
    ),
    Entry(
        "robot-3.14",
        "the trifocal robot experiment on the simulator (bounds are the project's own)",
        "visctrl.reproduce.chapter3:robot_3_14",
    ),
    Entry(
        "table-4.1",
        "the consistent pose filter, 100 runs a row, and the source's beside it",
        "visctrl.reproduce.chapter4:table_4_1",
    ),
    Entry(
        "fig-4.2",
        "100 runs of the consistent filter from one start: 2σ, NEES and NIS",
        "visctrl.reproduce.chapter4:figure_4_2",
    ),
    Entry(
        "fig-4.3",
        "pose scheme with a tilted camera or a displaced centre, 50 runs each",
        "visctrl.reproduce.chapter4_figures:figure_4_3",
    ),
    Entry(
        "fig-4.4",
        "pose scheme past an obstacle (bounds are the project's own)",
        "visctrl.reproduce.chapter4_figures:figure_4_4",
    ),
    Entry(
        "fig-4.4-sim",
        "pose scheme past boxes, listed or heard by sonar, rendered (bounds are the project's own)",
        "visctrl.reproduce.chapter4_figures:figure_4_4_sim",
    ),
    Entry(
        "fig-4.6",
        "pose scheme with each kind of camera (bounds are the project's own)",
        "visctrl.reproduce.chapter4_figures:figure_4_6",
    ),
    Entry(
        "robot-4.8",
        "the pose robot experiment on the simulator (bounds are the project's own)",
        "visctrl.reproduce.chapter4_figures:robot_4_8",
    ),
    Entry(
        "adverse",
        "52 adverse cells, three schemes: success, false success, doubt (the project's own)",
        "visctrl.reproduce.adverse:adverse",
    ),
    Entry(
        "matches",
        "first matches in 42 worlds, wrong ones and needless refusals (the project's own)",
        "visctrl.reproduce.matches:matches",
    ),
    Entry(
        "calibrate-camera",
        "(ξ, K) from rendered boards, every camera (bounds are the project's own)",
        "visctrl.reproduce.calibration:cameras",
    ),
    Entry(
        "calibrate-center",
        "projection centre from rendered vertical lines (bounds are the project's own)",
        "visctrl.reproduce.calibration:centres",
    ),
)
ENTRIES = {entry.name: entry for entry in _ENTRIES}


def entries_named(names: list[str]) -> list[Entry]:
    """Return entries by name; no name means all.

    Raises
    ------
    InputError
        An unknown name; the message lists the known ones.
    """
    for name in names:
        if name not in ENTRIES:
            raise InputError(f"unknown entry '{name}'; {suggestion(name, ENTRIES)}")
    return [ENTRIES[name] for name in names] if names else list(ENTRIES.values())
