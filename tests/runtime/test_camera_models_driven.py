"""Distorted cameras drive home: the short form of `visctrl reproduce camera-models`."""

from __future__ import annotations

from pathlib import Path

import pytest

from visctrl.reproduce.camera_models import BOUNDS, CAMERAS, camera_file, seeded_starts
from visctrl.reproduce.main_job import final_error
from visctrl.reproduce.recorded_run import drive
from visctrl.studies.run_spec import RunSpec

#: Every camera once, and every scheme once; features by the model instead of pictures.
PAIRS = list(zip(sorted(CAMERAS), ("pose", "trifocal", "epipolar", "trifocal"), strict=True))


@pytest.mark.parametrize(("camera", "scheme"), PAIRS)
def test_it_ends_on_the_target(tmp_path: Path, camera: str, scheme: str) -> None:
    x, y, phi = seeded_starts(camera)[1]
    settings = (
        f"camera.name={camera_file(camera, tmp_path)}",
        f"scheme={scheme}",
        *(f"start.x_m={x}", f"start.y_m={y}", f"start.phi_deg={phi}", "seed=1"),
    )
    summary = drive(RunSpec("mock", settings))
    assert summary["status"] == "reached"
    for error, bound in zip(final_error(summary), BOUNDS.values(), strict=True):
        assert error <= bound
