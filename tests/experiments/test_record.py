"""Rows, their verdicts and the page of the record."""

import json

import pytest

from visctrl.reproduce.chapter4_bound import cramer_rao
from visctrl.reproduce.chapter4_runs import noisy
from visctrl.reproduce.entry import Row, against_source, told, within
from visctrl.reproduce.record import keep, page
from visctrl.studies.run_spec import RunSpec


def test_what_a_row_is_judged_by_is_said():
    published, own = {"y_cm": -2.0}, {"y_cm": 1.0}
    assert against_source("", published, {"y_cm": 1.9}).ok
    assert not against_source("", published, {"y_cm": -2.1}).ok
    row = within("", own, {"y_cm": 1.9}, published=published)
    assert row.ok is False
    assert (row.as_dict()["published"], row.as_dict()["bound"]) == (published, own)
    assert Row("", {"y_cm": 9.0}).ok is None


def test_settings_beside_task_and_source_are_told():
    run = RunSpec("default", ("start.x_m=1", "mock.noise_px=1", "controller.tau_s=9", "seed=3"))
    assert told(run) == ("controller.tau_s=9",)
    assert told(run, ["controller.tau_s"]) == ()
    more = RunSpec("default", ("target.frames=10", "perception.noise_px=1"))
    assert told(more) == more.settings


def test_the_page_hides_no_row_that_falls_short(tmp_path):
    rows = [
        against_source("one", {"x_cm": 1.0}, {"x_cm": 0.5}, source={"x_cm": 2.0}),
        against_source("two", {"x_cm": 1.0}, {"x_cm": 3.0}, told=("target.frames=9",)),
        within("three", {"x_cm": 4.0}, {"x_cm": 3.0}),
    ]
    folder = tmp_path / "table-2.1"
    folder.mkdir()
    keep(folder, {"name": "table-2.1", "seconds": 7.2, "rows": [row.as_dict() for row in rows]})
    assert json.loads((folder / "rows.json").read_text())["rows"][1]["ok"] is False
    text = page(tmp_path)
    assert "3 rows are judged, 2 of them by the source's own numbers; 1 fall short." in text
    assert "| one | x_cm | 1 | 2 | 0.5 | 0.5 | ok |" in text
    assert "| two (*told* `target.frames=9`) | x_cm | 1 |  | 3 | 3 | **worse** |" in text
    assert "| three | x_cm | [4] |  | 3 |  | ok |" in text
    assert "`visctrl reproduce table-2.1`, 7 s." in text
    assert "`table-4.1`" in text.partition("Not run for this page")[2]


@pytest.mark.parametrize("frames", [1, 4])
def test_the_bound_falls_with_the_root_of_the_frames(frames):
    runs = [noisy((2.0, -12.0, 45.0), seed) for seed in (1, 2)]
    assert cramer_rao(runs, frames) * frames**0.5 == pytest.approx(cramer_rao(runs, 1))


def test_the_bound_is_that_of_a_pose_from_known_points():
    """Gauss–Newton on noisy images of known points scatters by the bound."""
    import numpy as np

    from visctrl.hal.mock.backend import Purpose
    from visctrl.hal.mock.scene import scatter, view_matrix
    from visctrl.hal.types import Pose
    from visctrl.reproduce.chapter4_bound import _jacobian

    run = noisy((2.0, -12.0, 45.0), 1)
    plan = run.plan()
    options = plan.backend_options
    points = scatter(
        options.features,
        (options.near_m, options.far_m),
        plan.true_camera,
        plan.mount,
        plan.scenario.start.pose(),
        Purpose.SCENE.generator(1),
    )
    homogeneous = np.column_stack([points, np.ones(len(points))])
    exact = plan.true_camera.robot_pixels(homogeneous @ view_matrix(Pose(0.0, 0.0, 0.0)))[0]
    J = _jacobian(plan.true_camera, points)
    rng = np.random.default_rng(0)
    found = []
    for _ in range(400):
        seen = exact + rng.normal(size=exact.shape)
        pose = np.zeros(3)
        for _ in range(3):
            now = plan.true_camera.robot_pixels(homogeneous @ view_matrix(Pose(*pose)))[0]
            pose += np.linalg.lstsq(J, (seen - now).ravel(), rcond=None)[0]
        found.append(pose)
    scale = np.array([100.0, 100.0, np.degrees(1.0)])
    assert np.std(found, axis=0) * scale == pytest.approx(cramer_rao([run], 1), rel=0.1)
