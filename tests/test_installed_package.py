"""What is installed lies under `visctrl` alone, and nothing that others install overwrites it."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import sys
import venv
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIST, RUN = ["list"], ["run", "mock", "--duration", "2", "--quiet"]
#: Folders of the repository whose names belong to other packages on the index.
SHARED_NAMES = ("robots", "sim", "hal", "configs")

pytestmark = pytest.mark.skipif(find_spec("hatchling") is None, reason="needs hatchling")


def python(code: str, cwd: Path) -> str:
    """Run a line of Python in a folder; return what it prints last."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def built(kind: str, source: Path, out: Path) -> Path:
    """Build a wheel or sdist of a source tree with the project's own backend."""
    out.mkdir(parents=True, exist_ok=True)
    name = python(f"import hatchling.build as b; print(b.build_{kind}({str(out)!r}))", source)
    return out / name


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


def stand_in(name: str, folder: Path) -> Path:
    """Write a wheel of a foreign package of that name, which does not want to be imported."""
    path = folder / f"{name}-9.0-py3-none-any.whl"
    info = f"{name}-9.0.dist-info"
    files = {
        f"{name}/__init__.py": f"raise ImportError('the foreign package {name}')\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(f"{file},,\n" for file in (*files, f"{info}/RECORD"))
    with zipfile.ZipFile(path, "w") as archive:
        for file, text in {**files, f"{info}/RECORD": record}.items():
            archive.writestr(file, text)
    return path


def environment(folder: Path, *arguments: str) -> Path:
    """Make a virtual environment, install into it without an index; return its programs' folder.

    The packages that this program needs come from the environment of the tests; what is
    installed here goes before them.
    """
    venv.create(folder, with_pip=False)
    place = next(folder.glob("lib/python*/site-packages"), folder / "Lib" / "site-packages")
    outside = [path for path in site.getsitepackages() if Path(path).is_dir()]
    (place / "outside.pth").write_text("\n".join(outside), encoding="utf-8")
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    install = ["-m", "pip", f"--python={programs / 'python'}", "install", "--quiet", "--no-index"]
    install += ["--no-deps", "--no-build-isolation", "--no-warn-script-location"]
    for packages in (arguments, [str(stand_in(name, folder)) for name in SHARED_NAMES]):
        subprocess.run([sys.executable, *install, *packages], check=True, capture_output=True)
    return programs


def works(programs: Path, cwd: Path, *commands: list[str]) -> None:
    """The commands do what they shall, with foreign packages of the same names there."""
    plain = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    for arguments in commands:
        done = subprocess.run(
            [str(programs / "visctrl"), *arguments],
            cwd=cwd, capture_output=True, text=True, env=plain, check=False,
        )  # fmt: skip
        # Two seconds are too few to arrive: "missed" is 1, a broken installation a traceback.
        assert done.returncode == (0 if arguments == LIST else 1), done.stderr
        assert "Traceback" not in done.stderr
        if arguments == LIST:
            assert all(word in done.stdout for word in ("p3dx", "hypercatadioptric", "trifocal"))


def test_the_wheel_holds_nothing_outside_visctrl(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"visctrl", "visctrl-0.1.0.dist-info"}
    assert len(names) == len(set(names))
    for needed in ("py.typed", "robots/p3dx/robot.yaml", "sim/scenes/hall.yaml", "hal/clock.py"):
        assert f"visctrl/{needed}" in names


def test_a_wheel_of_the_source_archive_is_the_same(wheel: Path, tmp_path: Path) -> None:
    shutil.unpack_archive(built("sdist", ROOT, tmp_path), tmp_path)
    (source,) = (path for path in tmp_path.iterdir() if path.is_dir())
    ours, theirs = zipfile.ZipFile(wheel), zipfile.ZipFile(built("wheel", source, tmp_path / "w"))
    assert sorted(ours.namelist()) == sorted(theirs.namelist())
    for name in ours.namelist():
        if not name.endswith("/RECORD"):
            assert ours.read(name) == theirs.read(name), name


def test_an_installed_wheel_survives_packages_of_the_same_names(
    wheel: Path, tmp_path: Path
) -> None:
    works(environment(tmp_path / "env", str(wheel)), tmp_path, LIST, RUN)


@pytest.mark.skipif(find_spec("editables") is None, reason="needs editables")
def test_an_editable_installation_survives_packages_of_the_same_names(tmp_path: Path) -> None:
    works(environment(tmp_path / "env", "--editable", str(ROOT)), tmp_path, RUN)


def checkout(folder: Path) -> Path:
    """Copy what is imported, with text files where the links are, as Git without links does."""
    for name in ("visctrl", *SHARED_NAMES):
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=unwanted)
    for name in SHARED_NAMES:
        (folder / "visctrl" / name).unlink()
        (folder / "visctrl" / name).write_text(f"../{name}", encoding="utf-8")
    return folder


def test_a_checkout_without_symbolic_links_works_all_the_same(tmp_path: Path) -> None:
    folder = checkout(tmp_path / "repository")
    code = (
        "import visctrl.sim.options, visctrl.hal.mock.backend as m;"
        "from visctrl.robots import load_robot; load_robot('p3dx').urdf(); print(m.__file__)"
    )
    assert Path(python(code, folder)) == folder / "hal" / "mock" / "backend.py"


def test_a_torn_checkout_says_what_is_missing(tmp_path: Path) -> None:
    folder = checkout(tmp_path / "repository")
    shutil.rmtree(folder / "hal")
    with pytest.raises(AssertionError, match=r"incomplete.*Check the repository out as a whole"):
        python("import visctrl", folder)
