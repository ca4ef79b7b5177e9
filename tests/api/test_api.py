"""The Python interface does what the command line does."""

import doctest
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import visctrl
from visctrl.contracts import Views
from visctrl.robots.errors import InputError

START = (-0.55, -1.35, -35.0)
PAGE = Path(__file__).parents[2] / "docs" / "python.md"


@pytest.fixture(scope="module")
def driven():
    return visctrl.run("mock", start=START, seed=3)


def test_a_run_tells_how_it_ended(driven):
    assert driven.status == "reached"
    assert driven.reached
    assert driven.exit_code == 0
    final = driven.summary["final_error"]
    assert driven.errors == (final["x_m"], final["y_m"], final["phi_deg"])
    assert driven.errors.distance_cm < 1.0


def test_its_columns_and_figures_come_from_its_files(driven):
    log = driven.columns
    assert len(log) == driven.summary["ticks"]
    assert log.numbers["x_true"][0] == pytest.approx(START[0], abs=1e-6)
    axes = driven.plot().axes
    np.testing.assert_array_equal(axes[0].lines[0].get_xdata(), log.numbers["x_true"])
    assert "<html" in driven.report().read_text(encoding="utf-8")
    assert "reached" in driven._repr_html_()


def test_ticks_are_a_frame_where_pandas_is(driven):
    pandas = pytest.importorskip("pandas")
    frame = driven.ticks
    assert isinstance(frame, pandas.DataFrame)
    assert len(frame) == driven.summary["ticks"]
    assert frame.attrs["units"]["x_true"] == "m"


def test_without_pandas_its_install_command_is_told(driven, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pip install pandas"):
        _ = driven.ticks


def test_the_command_line_ends_where_the_function_does(driven, tmp_path):
    options = ["--start", *map(str, START), "--seed", "3", "--out", str(tmp_path / "run"), "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "visctrl", "run", "mock", *options],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert json.loads(done.stdout)["final_error"] == driven.summary["final_error"]


def test_settings_are_those_of_the_command_line():
    short = {"duration_s": 0.5, "mock.noise_px": 1.0, "approach.enabled": False}
    late = visctrl.run("mock", start=(-0.5, -2.0, 0.0), seed=1, settings=short)
    assert late.status != "reached"
    assert late.exit_code == 1
    assert late.summary["ticks"] <= 6
    with pytest.raises(InputError, match=r"mock\.nois.*noise_px"):
        visctrl.run("mock", settings={"mock.noise": 1.0})


def test_step_by_step_it_is_the_same_run(driven):
    with visctrl.session("mock", start=START, seed=3) as session:
        first = session.step()
        assert isinstance(first.views, Views)
        records = [first, *session]
        assert session.step() is None
    assert len(records) == driven.summary["ticks"]
    assert session.run.summary["final_error"] == driven.summary["final_error"]
    assert [record.number for record in records] == list(range(len(records)))


def test_a_session_that_is_left_stops_its_robot():
    with visctrl.session("mock", seed=0) as session:
        moving = next(record for record in session if record.sent.omega != 0.0)
    assert moving.stage == "approach"
    assert session.run.status == "stopped"
    assert session.run.exit_code == 130


def test_a_session_that_cannot_begin_says_why():
    with visctrl.session("mock", settings={"mock.features": 4}) as session:
        with pytest.raises(InputError, match="features"):
            session.step()
        assert session.run is None


def test_a_session_that_was_never_stepped_leaves_nothing():
    session = visctrl.session("mock")
    assert session.close() is None


def test_teaching_a_backend_without_pictures_is_refused():
    with pytest.raises(InputError, match="takes no pictures"):
        visctrl.teach(backend="mock")


@pytest.mark.sim
def test_teach_record_replay(tmp_path):
    small = {"camera.width": 400, "sim.detail": 0.5}
    view = visctrl.teach(tmp_path / "target.npz", settings=small)
    assert view.images.shape == (1, 300, 400)
    run = visctrl.run(
        target=tmp_path / "target.npz",
        settings={**small, "duration_s": 1.0, "record_images": True, "approach.enabled": False},
        start=(-0.3, -1.2, -10.0),
        out=tmp_path / "drive",
    )
    again = visctrl.replay(tmp_path / "drive")
    assert len(again.columns) == run.summary["ticks"]
    assert again.status == "replayed"


def test_a_study_gives_its_cells(tmp_path):
    file = tmp_path / "few.yaml"
    file.write_text("scenario: mock\ngrid: {mock.noise_px: [0.1, 0.5]}\nruns: 1\n")
    summary = visctrl.study(str(file), workers=1, out=tmp_path / "out")
    assert len(summary["cells"]) == 2
    assert (tmp_path / "out" / "table.csv").is_file()


@pytest.mark.parametrize("module", ["visctrl", "visctrl.api.stepping"])
def test_examples_in_docstrings(module):
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted > 0
    assert found.failed == 0


def test_the_documentation_page_runs():
    """The blocks of the page are one program."""
    text = PAGE.read_text(encoding="utf-8")
    blocks = [part.partition("```")[0] for part in text.split("```python\n")[1:]]
    assert len(blocks) >= 3
    exec(compile("\n".join(blocks), str(PAGE), "exec"), {})


def test_importing_it_imports_nothing_else():
    code = (
        "import sys, visctrl\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'pydantic', 'visctrl.api'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert 'run' in dir(visctrl) and callable(visctrl.run)\n"
    )
    root = Path(__file__).parents[2]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root)
