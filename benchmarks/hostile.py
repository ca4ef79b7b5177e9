"""Any bytes as a scenario, calibration, study, target, log, picture or request.

    python benchmarks/hostile.py --examples 2000        # per kind; a table of what it cost

Every example is a good file or request that was damaged: bytes changed, parts cut, doubled or
swapped, words put in that parsers stumble over. It must be taken or refused with an error meant
for the user (exit codes 0, 2, 3); anything else is printed with the example and counts as wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import resource
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from visctrl.hal.cameras.catalogue import load_camera
from visctrl.hal.cameras.files import FORMATS, read_camera, write_camera
from visctrl.hal.cameras.pictures import decode_grey
from visctrl.robots.errors import VisctrlError
from visctrl.runtime.config import load_scenario, parse_setting
from visctrl.runtime.plan import make_plan
from visctrl.runtime.recording import open_recording
from visctrl.runtime.registry import REGISTRIES
from visctrl.runtime.run_directory import RunDirectory
from visctrl.runtime.session import run_session
from visctrl.runtime.stop import StopRequest
from visctrl.runtime.summary import versions
from visctrl.runtime.target_view import TargetView, load_target
from visctrl.studies.loading import load_study
from visctrl.studies.log import LOG, StudyLog
from visctrl.studies.table import ended
from visctrl.viewers.report.run_report import write_report
from visctrl.viewers.web.address import Address
from visctrl.viewers.web.server import WebPage
from visctrl.viewers.web.view import LiveView

#: What must hold for every example: seconds, and MiB of the whole process.
MOST_S, MOST_MIB = 10.0, 1024
_NASTY = (
    *(b"\0", b"\xff", b"\xff\xfe", b"\n", b"\r\n", b"{", b"[", b"]", b"}", b'"', b"'", b","),
    *(b"nan", b"inf", b"-inf", b"1e400", b"9" * 400, b"-1", b"null", b"true", b"[]", b"{}"),
    *(b": ", b"- ", b"&a ", b"*a", b"!!int ", b"!!python/name:os", b"<<: ", b"\t", b"%", b"#"),
    *(b"../", b"/dev/zero", b"\x1b[2J", "\u202e".encode(), b"\xed\xa0\x80", b" " * 300),
)
_SCENARIO = "scheme: trifocal\nbackend: mock\ncamera: {name: fisheye, width: 400}\nseed: 3\n"
_STUDY = "title: x\nscenario: mock\nruns: 3\nseed: 1\ngrid:\n  mock.noise_px: [0.1, 0.5]\n"
_REQUEST = (
    b"GET /state?edition=1&known=2 HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: http://127.0.0.1:%d\r\n"
    b"Authorization: Bearer x\r\nContent-Length: 3\r\nConnection: keep-alive\r\n\r\nabc"
)


@dataclass(frozen=True)
class Kind:
    """Something that takes bytes from outside.

    example : bytes that are taken. take : raises `VisctrlError` for those that are not.
    """

    example: bytes
    take: Callable[[bytes], object]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return damaged bytes, or now and then some that never were any good."""
    if rng.random() < 0.05:
        return rng.randbytes(rng.randrange(200))
    made = bytearray(data)
    for _ in range(1 + min(int(rng.expovariate(0.5)), 8)):
        first, last = sorted(rng.randrange(len(made) + 1) for _ in range(2))
        last = min(last, first + rng.choice((1, 4, 64, len(made))))
        match rng.randrange(6):
            case 0:
                made[first:last] = rng.randbytes(min(last - first, 16))
            case 1:
                del made[first:last]
            case 2:
                made[first:first] = made[first:last]
            case 3:
                made[first : first + rng.randrange(8)] = rng.choice(_NASTY)
            case 4 if last > first:
                made[first] ^= 1 << rng.randrange(8)
            case _:
                made[first:first] = rng.choice(_NASTY) * rng.choice((1, 1, 1, 60))
    return bytes(made)


@contextlib.contextmanager
def kinds(folder: Path) -> Iterator[dict[str, Kind]]:
    """Yield everything that takes bytes, working in a folder."""
    run = _recorded_run(folder)
    found = {"scenario": Kind(_SCENARIO.encode(), _scenario(folder))}
    for form in FORMATS:
        for camera in (load_camera("perspective"), load_camera("fisheye")):
            with contextlib.suppress(VisctrlError):  # a format may not hold this camera
                write_camera(camera, folder / "good.yaml", form)
                data = (folder / "good.yaml").read_bytes()
                take = _file(folder / "camera.yaml", read_camera)
                found[f"calibration, {form}"] = Kind(data, take)
    camera = load_camera("fisheye")
    found["study"] = Kind(_STUDY.encode(), _study(folder))
    TargetView(np.zeros((1, camera.height, camera.width), np.uint8), camera).save(folder / "t.npz")
    target = (folder / "t.npz").read_bytes()
    found["target"] = Kind(target, _file(folder / "bad.npz", load_target))
    for name in ("ticks.csv", "summary.json", "config.yaml"):
        found[f"report, {name}"] = Kind((run / name).read_bytes(), _in_run(run / name, _report))
    for name in ("ticks.csv", "images/index.csv"):
        found[f"replay, {name}"] = Kind((run / name).read_bytes(), _in_run(run / name, _replay))
    found["study log"] = Kind(_study_log(), _study_rows(folder / "study"))
    grey = np.arange(48 * 64, dtype=np.uint16).astype(np.uint8).reshape(48, 64)
    for suffix in (".png", ".jpg", ".bmp", ".tiff", ".pgm"):
        data = cv2.imencode(suffix, grey)[1].tobytes()
        found[f"picture {suffix}"] = Kind(data, lambda bad: decode_grey(bad, "picture"))
    plan = make_plan(load_scenario("mock", (), REGISTRIES.backends.names()))
    with WebPage(LiveView(plan), StopRequest(), Address("127.0.0.1", 0)) as page:
        port = page.address.port
        found["HTTP request"] = Kind(_REQUEST % (port, port), lambda bad: _ask(port, bad))
        yield found
        assert _ask(port, _REQUEST % (port, port)).startswith(b"HTTP/1.1 200"), "it still answers"


def check(kind: Kind, data: bytes) -> str:
    """Give bytes to something; return what is wrong, empty if nothing."""
    began = time.monotonic()
    try:
        kind.take(data)
    except VisctrlError as error:
        if error.exit_code not in (2, 3):
            return f"exit code {error.exit_code}: {error}"
    except Exception:
        return traceback.format_exc()
    took = time.monotonic() - began
    return f"took {took:.1f} s" if took > MOST_S else ""


def peak_mib() -> float:
    """Return the most memory that this process has had (MiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# --- what takes bytes ----------------------------------------------------------------------------


def _file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    def take(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return take


def _scenario(folder: Path) -> Callable[[bytes], object]:
    known = REGISTRIES.backends.names()
    return _file(
        folder / "scenario.yaml", lambda path: make_plan(load_scenario(str(path), (), known))
    )


def _study(folder: Path) -> Callable[[bytes], object]:
    def read(path: Path) -> object:
        found = load_study(str(path))
        if found.study.count <= 20:
            found.check()
        return found

    return _file(folder / "study.yaml", read)


def _in_run(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Return what puts bytes in the place of one file of a run, for a while."""
    good = path.read_bytes()
    run = path.parent if path.parent.name != "images" else path.parent.parent

    def take(data: bytes) -> object:
        path.write_bytes(data)
        try:
            return read(run)
        finally:
            path.write_bytes(good)

    return take


def _report(run: Path) -> object:
    return write_report(run)


def _replay(run: Path) -> object:
    return open_recording(run, None, lambda: 10.0)


def _recorded_run(folder: Path) -> Path:
    """Make a short run on the mock, with pictures as if it had had a camera."""
    settings = (
        "duration_s=0.5",
        "camera.name=fisheye",
        "camera.width=64",
        "approach.enabled=false",
    )
    overrides = [parse_setting(text) for text in settings]
    plan = make_plan(load_scenario("mock", overrides, REGISTRIES.backends.names()))
    run_session(plan, RunDirectory(folder / "run"))
    images = folder / "run" / "images"
    images.mkdir()
    write_camera(plan.camera, images / "camera.yaml", "visctrl")
    picture = np.zeros((plan.camera.height, plan.camera.width), np.uint8)
    (images / "0.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    rows = ["role,tick,sequence,stamp [s],age [s],file"]
    rows += [f"{role},{tick},0,0.0,0.0,0.png" for role, tick in (("target", ""), ("initial", ""))]
    rows += [f"tick,{k},{k},{0.1 * k},0.01,0.png" for k in range(4)]
    (images / "index.csv").write_text("\n".join(rows) + "\n")
    return folder / "run"


def _study_log() -> bytes:
    lines: list[object] = [{"versions": versions()}]
    lines += [{"key": f"{k:032x}", "row": ended("missed", "no reason")} for k in range(3)]
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)


def _study_rows(folder: Path) -> Callable[[bytes], object]:
    def take(data: bytes) -> object:
        folder.mkdir(exist_ok=True)
        (folder / LOG).write_bytes(data)
        with StudyLog(folder) as log:
            return [
                f"{row['status']}{row['reason']}{row['time_s'] or 0.0}" for row in log.rows.values()
            ]

    return take


def _ask(port: int, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=MOST_S) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
        answer = io.BytesIO()
        with contextlib.suppress(ConnectionError):
            while part := connection.recv(65_536):
                answer.write(part)
    return answer.getvalue()


def main() -> int:
    """Try every kind; print what it cost and what was wrong; return 1 if anything was."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=200, help="of each kind")
    parser.add_argument("--kind", default="", help="only kinds whose name begins so")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as folder, kinds(Path(folder)) as found:
        for name, kind in found.items():
            if not name.startswith(options.kind):
                continue
            rng = random.Random(f"{options.seed} {name}")
            began, slowest, here = time.monotonic(), 0.0, 0
            for _ in range(options.examples):
                data = mutated(kind.example, rng)
                before = time.monotonic()
                if problem := check(kind, data):
                    here += 1
                    if here <= 3:
                        print(f"{name}: {data[:300]!r}...\n{problem}", file=sys.stderr)
                slowest = max(slowest, time.monotonic() - before)
            wrong += here
            each = 1e3 * (time.monotonic() - began) / options.examples
            print(
                f"{name:<24} {options.examples} examples, {here} wrong, {each:7.2f} ms each, "
                f"slowest {slowest:5.2f} s, peak {peak_mib():5.0f} MiB",
                flush=True,
            )
    return 1 if wrong or peak_mib() > MOST_MIB else 0


if __name__ == "__main__":
    sys.exit(main())
