"""Recorded images, played again: the same numbers, or other plugins, or a clear complaint."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from visctrl.cli.main import main
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.session import run_session

pytestmark = pytest.mark.sim

SETTINGS = (
    *("record_images=true", "backend=sim", "camera.width=400", "duration_s=0.6"),
    *("target.frames=2", "sim.faults.camera_frozen_s=[1.3,1.55]", "safety.max_frame_age_s=0.15"),
    *("start.x_m=-0.2", "start.y_m=-1.0", "start.phi_deg=-28"),
    *("sim.detail=0.7", "sim.show_floor=false"),
)
#: Columns of a tick log that tell how long something took.
TIMES = ("[ms]", "missed", "blame")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a turn towards the target, the first second of the way, and a frozen camera."""
    directory = tmp_path_factory.mktemp("recorded") / "run"
    overrides = [parse_setting(text) for text in SETTINGS]
    loaded = load_scenario("default", overrides, REGISTRIES.backends.names())
    run_session(make_plan(loaded), directory)
    return directory


@pytest.fixture
def copy(recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of the recording that may be spoilt."""
    return Path(shutil.copytree(recorded, tmp_path / "copy"))


@pytest.fixture
def visctrl(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs the program and returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["visctrl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return int(caught.value.code or 0), *capfd.readouterr()

    return call


def ticks(run: Path) -> list[dict[str, str]]:
    with (run / "ticks.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_frame_that_was_used_is_kept_as_it_was(recorded: Path) -> None:
    with (recorded / "images" / "index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    roles = [row["role"] for row in rows]
    assert roles[:3] == ["target", "target", "initial"]
    assert roles.count("initial") == 2, "the view before the turn and the one after it"
    assert roles.count("tick") == len(ticks(recorded))
    files = {row["file"] for row in rows}
    assert files == {path.name for path in (recorded / "images").glob("*.png")}
    assert len(files) < len(rows) - 2, "a frame used twice is one file"
    image = cv2.imread(str(recorded / "images" / rows[-1]["file"]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (300, 400)
    assert image.dtype == np.uint8


def test_the_same_plugins_give_the_same_numbers(recorded: Path, visctrl, tmp_path: Path) -> None:
    code, out, err = visctrl("replay", recorded, "--out", "again", "--json")
    assert code == 0, err
    before, after = ticks(recorded), ticks(tmp_path / "again")
    assert len(before) == len(after) > 12
    compared = [name for name in after[0] if not name.endswith(TIMES[0]) and name not in TIMES]
    assert {"tensor.T111 [1]", "klt.features_held [1]", "planar-motion.bearing_sd [rad]"} <= set(
        compared
    )
    for old, new in zip(before, after, strict=True):
        assert {k: old[k] for k in compared} == {k: new[k] for k in compared}
    assert any(float(row["v_wanted [m/s]"]) > 0.1 for row in after), "the controller decides"
    assert "trifocal-smc.progress [s]" in compared
    assert any("old" in row["event"] for row in before), "the frozen camera was part of it"
    summary = json.loads(out)
    assert summary["status"] == "replayed"
    assert summary["controller"] == "trifocal-smc"
    assert summary == json.loads((tmp_path / "again" / "summary.json").read_text())
    for name in ("target.png", "initial.png", "final.png", "config.yaml", "report.html"):
        assert (tmp_path / "again" / name).exists()


def test_other_plugins_and_options_see_the_same_images(
    recorded: Path, visctrl, tmp_path: Path
) -> None:
    code, out, err = visctrl(
        *("replay", recorded / "images", "--perception", "sift", "--estimator", "epipoles"),
        *("--set", "perception.keypoints=400", "--out", "other", "--video", "-q"),
    )
    assert (code, out) == (0, ""), err
    rows = ticks(tmp_path / "other")
    assert len(rows) == len(ticks(recorded))
    assert any(name.startswith("epipoles.") for name in rows[0])
    assert np.median([int(row["features"]) for row in rows]) > 30
    assert (tmp_path / "other" / "video.mp4").stat().st_size > 1000
    config = (tmp_path / "other" / "config.yaml").read_text()
    assert "keypoints: 400" in config
    assert "backward_px" not in config, "the options of the plugin that was replaced are gone"


def test_another_controller_decides_open_loop(recorded: Path, visctrl, tmp_path: Path) -> None:
    name = "trifocal-smooth"
    code, _, err = visctrl("replay", recorded, "--controller", name, "--out", "other", "-q")
    assert code == 0, err
    before, after = ticks(recorded), ticks(tmp_path / "other")
    sent = ("v_sent [m/s]", "omega_sent [rad/s]")
    assert [[row[k] for k in sent] for row in before] == [[row[k] for k in sent] for row in after]
    assert any(row[f"{name}.distance [m]"] for row in after)
    assert {row["phase"] for row in before} != {row["phase"] for row in after}
    code, _, err = visctrl("replay", recorded, "--controller", "pose-tracking", "--out", "no")
    assert code == 2
    assert "needs PoseEstimate" in err


def test_a_plain_folder_of_images_is_a_sequence(recorded: Path, visctrl, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    taken = sorted((recorded / "images").glob("0*.png"))[-6:]
    for number, path in enumerate(taken, start=8):
        shutil.copy(path, folder / f"shot{number}.png")
    camera = recorded / "images" / "camera.yaml"
    code, _, err = visctrl("replay", folder, "--camera", camera, "--out", "out", "-q")
    assert code == 0, err
    rows = ticks(tmp_path / "out")
    assert [float(row["t [s]"]) for row in rows] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert all(int(row["features"]) > 30 for row in rows)
    assert (tmp_path / "out" / "trajectory.tum").read_text() == "", "nobody knows where it was"
    code, _, err = visctrl("replay", folder, "--out", "out", "-q")
    assert (code, "--camera" in err) == (2, True)
    (folder / "shot9.png").rename(folder / "shot09.jpg")
    code, _, err = visctrl("replay", folder, "--camera", camera, "-q", "--target", taken[-1])
    assert code == 0, err
    (folder / "shot10.png").unlink()
    code, _, err = visctrl("replay", folder, "--camera", camera, "-q")
    assert code == 2
    assert "shot09.jpg and shot11.png" in err


def broken(copy: Path, number: int, how: str) -> Path:
    path = sorted((copy / "images").glob("0*.png"))[number]
    if how == "missing":
        path.unlink()
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[:200])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))
    return path


@pytest.mark.parametrize(
    ("how", "complaint"),
    [
        ("missing", "the image is missing"),
        ("truncated", "not a readable image"),
        ("empty", "not a readable image"),
        ("small", "is 100x100, but camera 'hypercatadioptric' takes 400x300"),
    ],
)
def test_a_bad_image_is_named(copy: Path, visctrl, tmp_path: Path, how: str, complaint: str):
    path = broken(copy, 3, how)
    code, out, err = visctrl("replay", copy, "--out", "never", "--quiet")
    assert (code, out) == (2, "")
    assert f"{path}: {complaint}" in err
    assert not (tmp_path / "never").exists()


def test_what_cannot_be_replayed_is_said(copy: Path, visctrl, tmp_path: Path) -> None:
    code, _, err = visctrl("replay", "nowhere")
    assert (code, "no such run directory" in err) == (2, True)
    code, _, err = visctrl("replay", tmp_path)
    assert (code, "no images here" in err) == (2, True)
    code, _, err = visctrl("replay", copy, "--perception", "siift")
    assert (code, "did you mean 'sift'" in err) == (2, True)
    code, _, err = visctrl("replay", copy, "--set", "perception.min_matches=5000", "-q")
    assert (code, "target-0.png" in err) == (2, True)
    code, _, err = visctrl("replay", copy, "--out", copy)
    assert (code, "would replace the recording" in err) == (2, True)
    shutil.rmtree(copy / "images")
    code, _, err = visctrl("replay", copy)
    assert (code, "--record-images" in err) == (2, True)
    code, _, err = visctrl("run", "mock", "--record-images")
    assert (code, "takes no pictures" in err) == (2, True)
