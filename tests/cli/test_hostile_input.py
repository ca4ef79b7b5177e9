"""Whatever a user, a file or a plugin gives: one line on stderr, exit code 2 or 3."""

from __future__ import annotations

import io
import json
import os
import sys
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from visctrl.cli.main import main
from visctrl.cli.options import SCHEMES
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.files import write_camera
from visctrl.robots.errors import DiskError
from visctrl.robots.files import openable
from visctrl.runtime.schemes import schemes
from visctrl.runtime.target_view import TargetView

ROOT = Path(__file__).parents[2]
TOYS = ROOT / "tests" / "runtime"
TOY = """
backend: mock
estimator: {name: "toy_plugins:ToyEstimator"}
controller: {name: "toy_plugins:ToyController"}
approach: {enabled: false}
start: {x_m: 0, y_m: -1, phi_deg: 0}
"""


@dataclass
class Done:
    code: int
    out: str
    err: str


Call = Callable[..., Done]


@pytest.fixture
def visctrl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Call:
    """Return a function that runs the program in this process, in a folder with a toy scenario."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(TOYS)
    (tmp_path / "toy.yaml").write_text(TOY)

    def call(*arguments: object) -> Done:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["visctrl", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        out, err = capfd.readouterr()
        return Done(int(caught.value.code or 0), out, err)

    return call


def check(done: Done, code: int, *words: str) -> None:
    """Check that a call was refused in a clear line."""
    assert done.code == code, done.err
    assert done.out == ""
    assert "Traceback" not in done.err
    assert "internal error" not in done.err
    assert done.err.count("\n") == 1, done.err
    for word in words:
        assert word in done.err


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{c}: &{c} [{','.join([f'*{p}'] * 9)}]\n" for p, c in zip("abcdefgh", "bcdefghi", strict=True)
)
YAML = {
    "seed: !!int x": "'x' is no int",
    f"seed: {'9' * 5000}": "is no int",
    "seed: 2024-99-99": "key 'seed'",
    "title: !!binary x": "unknown tag",
    "title: !!python/object:os.system x": "unknown tag",
    "seed: 1\nseed: 2": "key 'seed' twice",
    "camera: {name: a, name: b}": "key 'name' twice",
    "on: 3": "expected text as a key",
    "? [a]\n: b": "expected text as a key",
    "title: " + "[" * 600 + "]" * 600: "levels deep",
    "- " * 20_000: "levels deep",
    BOMB: "more than 200,000 values",
    "title: &a [*a]": "holds itself",
    "title: *a": "undefined alias",
    "title: \x00": "not valid YAML",
    "title: .nan": "key 'title'",
    "duration_s: .inf": "finite",
    "camera: 3": "key 'camera'",
    "mock: []": "key 'mock'",
    "1: 2": "key '1': keys should be strings",
    "- a": "expected a mapping",
    "--- {}\n--- {}": "another document",
    "x" * 5_000_000: "larger than",
}


@pytest.mark.parametrize("text", YAML, ids=range(len(YAML)))
def test_scenarios(visctrl: Call, tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    check(visctrl("run", "bad.yaml"), 2, "bad.yaml", YAML[text])


def test_files_that_are_none(visctrl: Call, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    check(visctrl("run", "pipe.yaml"), 2, "pipe.yaml: is not a file")
    (tmp_path / "folder.yaml").mkdir()
    check(visctrl("run", "mock", "--camera", "folder.yaml"), 2, "folder.yaml: cannot be read")
    check(visctrl("run", "mock", "--camera", "/dev/zero.yaml"), 2, "no such file")
    os.mkfifo(tmp_path / "pipe.npz")
    check(visctrl("run", "mock", "--target", "pipe.npz"), 2, "it is no file")
    for command in ("run", "study", "report", "replay"):
        check(visctrl(command, "x" * 300 + ".yaml"), 2, "x" * 50)
    check(visctrl("run", "toy.yaml", "--out", "x" * 300), 2, "File name too long")
    check(visctrl("run", "toy.yaml", "--out", "toy.yaml/x"), 2, "--out toy.yaml/x")
    check(visctrl("run", "toy.yaml", "--out", "."), 2, "not a run's")
    assert (tmp_path / "toy.yaml").read_text() == TOY


def target_file(**parts: object) -> bytes:
    camera = load_camera("perspective")
    facts = {"odometry": None, "backend": "mock", "robot": "p3dx", "taken": ""}
    whole = {
        "format": 1,
        "images": np.zeros((1, camera.height, camera.width), dtype=np.uint8),
        "camera": camera.model_dump_json(),
        "facts": json.dumps(facts),
    }
    file = io.BytesIO()
    np.savez_compressed(file, **{**whole, **parts})  # type: ignore[arg-type]
    return file.getvalue()


def archive(name: str, head: bytes, body: bytes = b"", flags: int = 0) -> bytes:
    """Return a target file with one array replaced by bytes as they are given."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(target_file())) as old, zipfile.ZipFile(file, "w") as new:
        for other in old.namelist():
            if other != f"{name}.npy":
                new.writestr(other, old.read(other))
        about = zipfile.ZipInfo(f"{name}.npy")
        about.compress_type = zipfile.ZIP_DEFLATED
        new.writestr(about, head + body)
    data = file.getvalue()
    if flags:
        for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            at = data.rindex(mark) + offset
            data = data[:at] + bytes([data[at] | flags]) + data[at + 1 :]
    return data


def npy_head(shape: str, kind: str = "'|u1'") -> bytes:
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (117 - len(text)) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def plain_array() -> bytes:
    file = io.BytesIO()
    np.save(file, np.zeros((2, 600, 800), dtype=np.uint8))
    return file.getvalue()


def flipped(data: bytes) -> bytes:
    """Return an archive whose compressed pictures are damaged."""
    at = data.index(b"images.npy") + 60
    return data[:at] + bytes(255 - byte for byte in data[at : at + 20]) + data[at + 20 :]


TARGETS: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "not a target view"),
    "text": (lambda: b"hello", "not a target view"),
    "plain npy": (plain_array, "not a target view"),
    "cut short": (lambda: target_file()[:-40], "not a target view"),
    "flipped": (lambda: flipped(target_file()), "not a target view"),
    "no camera": (lambda: target_file().replace(b"camera.npy", b"camara.npy"), "is missing"),
    "terabytes": (lambda: archive("images", npy_head("(1, 1000000, 1000000)")), "claims"),
    "negative": (lambda: archive("images", npy_head("(-1, 600, 800)")), "not a target view"),
    "short body": (lambda: archive("images", npy_head("(1, 600, 800)"), b"xx"), "claims"),
    "bomb": (lambda: archive("images", npy_head("(600,)"), b"\0" * 520_000_000), "at most"),
    "objects": (lambda: archive("images", npy_head("(1,)", "'|O'"), b"12345678"), "object"),
    "encrypted": (lambda: archive("images", npy_head("()"), b"x", flags=1), "encrypted"),
    "head nests": (lambda: archive("images", npy_head("(" * 60)), "not a target view"),
    "floats": (lambda: target_file(images=np.zeros((1, 600, 800))), "expected 8-bit grey"),
    "no image": (lambda: target_file(images=np.zeros((0, 600, 800), np.uint8)), "8-bit grey"),
    "flat": (lambda: target_file(images=np.zeros(600, np.uint8)), "8-bit grey"),
    "other size": (lambda: target_file(images=np.zeros((1, 6, 8), np.uint8)), "size of its camera"),
    "format text": (lambda: target_file(format="one"), "teach it again"),
    "format list": (lambda: target_file(format=[1, 2]), "teach it again"),
    "camera text": (lambda: target_file(camera="x"), "camera: not valid JSON"),
    "camera list": (lambda: target_file(camera="[1]"), "camera: expected a mapping"),
    "camera number": (lambda: target_file(camera=1.5), "camera: expected a mapping"),
    "camera keys": (lambda: target_file(camera='{"x": 1}'), "unknown key 'x'"),
    "facts null": (lambda: target_file(facts="null"), "facts: expected a mapping"),
    "facts deep": (lambda: target_file(facts="[" * 90_000), "facts: not valid JSON"),
    "odometry": (
        lambda: target_file(
            facts='{"odometry": [1, "x"], "backend": "", "robot": "", "taken": ""}'
        ),
        "facts: key 'odometry",
    ),
}


@pytest.mark.parametrize("kind", TARGETS)
def test_target_files(visctrl: Call, tmp_path: Path, kind: str) -> None:
    make, words = TARGETS[kind]
    (tmp_path / "bad.npz").write_bytes(make())
    done = visctrl("run", "mock", "--camera", "perspective", "--target", "bad.npz")
    if kind in ("odometry", "camera keys"):
        assert done.code == 2
        assert words in done.err
    else:
        check(done, 2, "bad.npz", words)


GOOD = """
from toy_plugins import *
from visctrl.contracts import *
"""
PLUGINS = {
    "def": (3, "SyntaxError"),
    "x = undefined": (3, "NameError"),
    "1 / 0": (3, "ZeroDivisionError"),
    "import sys; sys.exit(1)": (3, "SystemExit"),
    "raise ValueError('no')": (3, "ValueError"),
    "import not_there_at_all": (2, "not_there_at_all"),
    "": (2, "has no attribute 'Mine'"),
    "Mine = 3": (2, "not a subclass"),
    "class Mine: pass": (2, "not a subclass"),
    GOOD + "class Mine(Controller): pass": (2, "does not implement update"),
    GOOD + "class Mine(ToyController):\n  Options = 3": (2, "'Options'"),
    GOOD + "class Mine(ToyController):\n  signals = 'x'": (2, "'signals'"),
    GOOD + "class Mine(ToyController):\n  accepts = 'Estimate'": (2, "'accepts'"),
    GOOD + "class Mine(Controller):\n  Options = ToyOptions\n  def update(self, e, u, t): ...": (
        2,
        "'accepts'",
    ),
    GOOD + "class Mine(ToyController):\n  def __init__(self, *a): 1 / 0": (3, "ZeroDivision"),
    GOOD + "class Mine(ToyController):\n  def update(self, *a): return None": (3, "'mine:Mine'"),
    GOOD + "class Mine(ToyController):\n  def update(self, *a): return 0.1, 0": (3, "'mine:Mine'"),
    GOOD + "class Mine(ToyController):\n  def values(self): 1 / 0": (3, "'mine:Mine'"),
    GOOD + "class Mine(ToyController):\n  def values(self): return 3": (3, "'mine:Mine'"),
    GOOD + "class Mine(ToyController):\n  def expect(self, *a): 1 / 0": (0, ""),
    GOOD + "class Mine(ToyController):\n  def notes(self): return None": (0, "could not say"),
    GOOD + "class Mine(ToyController):\n  def close(self): raise OSError": (3, "be closed"),
    "import os; os.chdir('/')\n" + GOOD + "Mine = ToyController": (0, ""),
    GOOD
    + "import os\nclass Mine(ToyController):\n  def update(self, *a):\n    os.chdir('/')\n"
    + "    return super().update(*a)": (0, ""),
}


@pytest.mark.parametrize("code", PLUGINS, ids=range(len(PLUGINS)))
def test_plugins(visctrl: Call, tmp_path: Path, code: str, request: pytest.FixtureRequest) -> None:
    request.addfinalizer(lambda: sys.modules.pop("mine", None))
    (tmp_path / "mine.py").write_text(code)
    here = Path.cwd()
    done = visctrl("run", "toy.yaml", "--set", "controller.name=mine:Mine", "-q", "--out", "o")
    os.chdir(here)
    expected, words = PLUGINS[code]
    assert done.code == expected, done.err
    assert "Traceback" not in done.err
    assert "internal error" not in done.err
    assert words in done.err
    if expected == 0:
        assert (tmp_path / "o" / "summary.json").exists()


def test_a_perception_that_matches_nothing_is_named(
    visctrl: Call, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    request.addfinalizer(lambda: sys.modules.pop("mine2", None))
    (tmp_path / "mine2.py").write_text(
        "from visctrl.perception.features import IdentifiedFeatures\n"
        "class Mine(IdentifiedFeatures):\n  def set_initial(self, frame): return None\n"
    )
    done = visctrl("run", "toy.yaml", "--set", "perception.name=mine2:Mine", "-q", "--out", "o")
    assert done.code == 3, done.err
    assert "perception 'mine2:Mine' failed: TypeError: returned NoneType, not Match" in done.err


def png_that_claims(width: int, height: int) -> bytes:
    head = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\0\0\0\0"
    data = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + head
    return data + zlib.crc32(head).to_bytes(4, "big") + b"\0\0\0\0IEND\xaeB`\x82"


IMAGES = {
    "claims 60000 x 60000": png_that_claims(60_000, 60_000),
    "claims 30000 x 30000": png_that_claims(30_000, 30_000),
    "claims 4 billion": png_that_claims(2**31, 2**31),
    "empty": b"",
    "text": b"hello",
    "no data": png_that_claims(800, 600),
    "jpeg head": b"\xff\xd8\xff\xe0\x00\x10JFIF",
    "bmp head": b"BM" + b"\xff" * 60,
    "pgm": b"P5 99999999 99999999 255\n",
}


@pytest.mark.parametrize("kind", IMAGES)
def test_pictures(visctrl: Call, tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a-1.png", "a-2.png"):
        (folder / name).write_bytes(IMAGES[kind])
    done = visctrl("replay", "images", "--camera", "perspective", "-q")
    check(done, 2, "a-2.png")


def test_names_that_are_not_utf_8(visctrl: Call, tmp_path: Path) -> None:
    """OpenCV, given such a name, ends the whole process."""
    name = os.fsdecode(b"caf\xe9")
    assert visctrl("run", "toy.yaml", "-q", "--out", name, "--video").code in (0, 2)
    assert visctrl("run", "toy.yaml", "-q", "--out", f"{name}2").code == 0
    done = visctrl("report", f"{name}2")
    assert done.code == 0, done.err
    assert "caf\\udce9" in done.out
    images = tmp_path / f"{name}3"
    images.mkdir()
    for k in range(2):
        _, data = cv2.imencode(".png", np.zeros((480, 640), np.uint8))
        (images / f"{k}.png").write_bytes(data.tobytes())
    check(visctrl("replay", images, "--camera", "perspective", "-q"), 2, "is blank")
    board = visctrl("calibrate", "board", "--size", "8x6", "-o", f"{name}.png")
    assert board.code in (0, 2), board.err


def test_the_help_names_every_scheme_and_no_type_beside_a_flag(
    visctrl: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(SCHEMES) == schemes().keys()
    monkeypatch.setenv("COLUMNS", "200")
    text = visctrl("run", "--help").out
    assert "epipolar, pose, trifocal, trifocal2d" in text
    flags = [line for line in text.splitlines() if "--" in line and "--help" not in line]
    assert not [line for line in flags if "bool" in line]


def test_a_key_that_holds_keys_says_which(visctrl: Call) -> None:
    done = visctrl("run", "toy.yaml", "--set", "start=3")
    check(done, 2, "key 'start': expected keys below it (x_m, y_m, phi_deg), as in start.x_m")


def test_what_the_program_does_can_be_logged(visctrl: Call) -> None:
    assert "INFO" not in visctrl("run", "toy.yaml", "-q", "--out", "a").err
    done = visctrl("--verbose", "run", "toy.yaml", "-q", "--out", "b")
    assert "visctrl: INFO: visctrl.runtime.run_directory: writing to" in done.err
    assert "DEBUG" not in done.err
    done = visctrl("--log-level", "debug", "run", "toy.yaml", "-q", "--out", "c")
    assert "DEBUG: visctrl.robots.loading: importing toy_plugins" in done.err


def test_a_full_disk_leaves_an_old_target_as_it_was(
    visctrl: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: Any, **parts: object) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    old = target_file()
    (tmp_path / "target.npz").write_bytes(old)
    camera = load_camera("perspective")
    view = TargetView(np.zeros((1, camera.height, camera.width), np.uint8), camera)
    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(DiskError, match=r"target.npz: cannot be written: No space left"):
        view.save(tmp_path / "target.npz")
    assert (tmp_path / "target.npz").read_bytes() == old
    assert {path.name for path in tmp_path.iterdir()} == {"target.npz", "toy.yaml"}


def test_a_replay_of_nothing_is_no_success(visctrl: Call, tmp_path: Path) -> None:
    assert visctrl("run", "toy.yaml", "-q", "--out", "r", "--duration", "0.5").code == 1
    images = tmp_path / "r" / "images"
    images.mkdir()
    camera = load_camera("perspective")
    write_camera(camera, images / "camera.yaml", "visctrl")
    for name in ("t.png", "i.png"):
        _, data = cv2.imencode(".png", np.zeros((camera.height, camera.width), np.uint8))
        (images / name).write_bytes(data.tobytes())
    rows = "role,tick,sequence,stamp [s],age [s],file\ntarget,,0,0,0,t.png\ninitial,,1,0,0,i.png\n"
    (images / "index.csv").write_text(rows)
    check(visctrl("replay", "r", "-q"), 2, "holds no tick to replay")


def test_a_far_start_is_given_the_time_that_its_way_takes(visctrl: Call) -> None:
    done = visctrl("run", "mock", "--json", "-q", "--start", "0", "-20", "0", "--out", "far")
    assert done.code == 0, done.err
    assert json.loads(done.out)["duration_s"] > 60.0, "the time that a near start is given"
    assert visctrl("run", "mock", "-q", "--start", "0", "-20", "0", "--duration", "60").code == 1


def test_a_camera_that_would_hold_the_program_for_ever(visctrl: Call, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for source in ("pipe", "folder", os.fsdecode(b"caf\xe9.avi")):
        assert not openable(source)
    done = visctrl("doctor", "--quick", "--camera-url", "pipe")
    assert done.code == 3
    assert "neither a device nor a film" in " ".join(done.out.split())
