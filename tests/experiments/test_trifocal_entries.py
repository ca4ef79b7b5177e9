"""The entries of the trifocal chapter: short runs through the same code."""

from importlib import import_module

import numpy as np
import pytest

from visctrl.reproduce.cases import column, distances, errors, folder_name
from visctrl.reproduce.catalogue import ENTRIES
from visctrl.reproduce.chapter3 import RESOLUTION, TABLE_3_1, _judged
from visctrl.reproduce.chapter3_plots import plot_motion, plot_states, plot_tensors
from visctrl.reproduce.image_motion import FILE
from visctrl.reproduce.recorded_run import drive
from visctrl.studies.run_spec import RunSpec


@pytest.mark.parametrize("name", sorted(ENTRIES))
def test_every_entry_leads_to_a_function(name):
    module, function = ENTRIES[name].where.split(":")
    assert callable(getattr(import_module(module), function))


def test_a_published_zero_is_what_rounds_to_it():
    zero = TABLE_3_1[2][1]
    found = {"x_cm": 0.9 * RESOLUTION, "y_cm": -0.1, "phi_deg": 0.0}
    assert _judged("", zero, found).ok
    assert not _judged("", zero, found | {"x_cm": 1.1 * RESOLUTION}).ok
    assert not _judged("", zero, found | {"y_cm": -0.12}).ok


def test_a_run_is_drawn_with_the_motion_of_its_features(tmp_path):
    settings = ("backend=mock", "start.x_m=0", "start.y_m=-0.6", "start.phi_deg=0")
    job = RunSpec("default", settings, tmp_path / folder_name("a run", "φ1 = 0"))
    summary = drive(job)
    assert summary["status"] == "reached"
    with np.load(job.out / FILE) as data:
        assert len(data["ids"]) == len(data["pixels"]) > 0
        last = data["pixels"][-len(data["target"]) :]
        # At the target, the features are where the target view has them.
        np.testing.assert_allclose(last, data["target"], atol=0.5)
    for plot in (plot_states, plot_tensors, plot_motion):
        assert plot(tmp_path, [job.out], "a run").stat().st_size > 10_000
    assert np.abs(column(job.out, "trifocal-smc.s1")).max() < 0.1
    assert distances(summary)["position_cm"] == pytest.approx(
        np.hypot(errors(summary)["x_cm"], errors(summary)["y_cm"])
    )
