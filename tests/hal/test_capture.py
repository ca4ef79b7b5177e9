"""The capture camera on streams and recordings."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from virtual_robot import Site

from visctrl.hal.cameras.capture import CaptureCamera, CaptureOptions
from visctrl.hal.cameras.models.unified import UnifiedCamera
from visctrl.hal.clock import WallClock
from visctrl.hal.emulator.stream import MjpegServer
from visctrl.hal.errors import CameraError, StaleFrameError
from visctrl.hal.types import Frame

WIDTH, HEIGHT, RATE = 160, 120, 25.0
MODEL = UnifiedCamera(
    name="test", width=WIDTH, height=HEIGHT, xi=0.0, fx=100.0, fy=100.0, cx=79.5, cy=59.5
)


def picture(level: int) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    image[40:80, 60:100] = 255 - level
    return image


class Projector:
    """Publishes pictures whose grey level counts up, until told to pause."""

    def __init__(self, server: MjpegServer) -> None:
        self.server = server
        self.level = 0
        self.repeat = False
        self.running = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Projector:
        self.running.set()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(1.0 / RATE):
            if self.running.is_set():
                self.level = self.level if self.repeat else (self.level + 8) % 120
                ok, jpeg = cv2.imencode(".jpg", picture(self.level))
                assert ok
                self.server.publish(jpeg.tobytes())


@contextmanager
def opened(source: str, model: UnifiedCamera = MODEL, **options: object) -> Iterator[CaptureCamera]:
    camera = CaptureCamera(
        model, CaptureOptions.model_validate({"source": source, **options}), WallClock()
    )
    try:
        camera.open()
        yield camera
    finally:
        camera.close()


@pytest.fixture
def projector() -> Iterator[Projector]:
    with MjpegServer() as server, Projector(server) as projector:
        yield projector


def frames_of(camera: CaptureCamera, limit: float) -> Iterator[Frame]:
    """Read again and again for ``limit`` seconds."""
    start = time.monotonic()
    while time.monotonic() - start < limit:
        yield camera.read()
        time.sleep(0.005)


def wait_for_stale(camera: CaptureCamera) -> tuple[float, str]:
    """Return after how long the camera refused, and what it said."""
    start = time.monotonic()
    while time.monotonic() - start < 2.0:
        try:
            camera.read()
        except StaleFrameError as error:
            return time.monotonic() - start, str(error)
        time.sleep(0.01)
    raise AssertionError("never stale")


@pytest.mark.realtime
def test_newest_picture_only(projector: Projector) -> None:
    with opened(projector.server.url) as camera:
        time.sleep(0.5)  # nobody reads; nothing must pile up
        frames = []
        for _ in range(20):
            frames.append(camera.read())
            level = int(np.asarray(frames[-1].image)[0, 0])
            behind = (projector.level - level) % 120
            assert min(behind, 120 - behind) <= 16  # two pictures
            time.sleep(0.02)
    stamps = [frame.stamp for frame in frames]
    assert stamps == sorted(stamps)
    for one, two in itertools.pairwise(frames):
        assert (two.stamp > one.stamp) == (two.sequence > one.sequence)
    assert frames[-1].sequence - frames[0].sequence >= 8
    assert np.asarray(frames[0].image).shape == (HEIGHT, WIDTH)


@pytest.mark.realtime
def test_stamps_are_arrival_less_the_known_latency(projector: Projector) -> None:
    with opened(projector.server.url, latency_s=0.05, max_age_s=1.0) as camera:
        time.sleep(0.3)
        ages = []
        for _ in range(30):
            ages.append(camera._clock.now() - camera.read().stamp)
            time.sleep(0.013)
    assert 0.05 <= min(ages) < 0.08
    assert max(ages) < 0.05 + 2.5 / RATE


@pytest.mark.realtime
@pytest.mark.parametrize("how", ["frozen", "repeating"])
def test_frozen_camera(projector: Projector, how: str) -> None:
    """Whether nothing comes any more, or the same picture for ever."""
    with opened(projector.server.url) as camera:
        camera.read()
        if how == "frozen":
            projector.running.clear()
        else:
            projector.repeat = True
        after, says = wait_for_stale(camera)
        assert 0.2 < after < 0.45
        assert "0.35 s" in says


@pytest.mark.realtime
def test_drawn_pictures_may_repeat(projector: Projector) -> None:
    with opened(projector.server.url, repeats_are_stale=False) as camera:
        projector.repeat = True
        time.sleep(0.6)
        assert camera.read().sequence > 10


@pytest.mark.realtime
def test_dropped_stream_is_reported_and_comes_back(projector: Projector) -> None:
    with opened(projector.server.url) as camera:
        before = camera.read().sequence
        projector.server.drop()
        _, says = wait_for_stale(camera)
        assert projector.server.url in says
        projector.server.restore()
        deadline = time.monotonic() + 3.0
        while True:
            try:
                assert camera.read().sequence > before
                return
            except StaleFrameError:
                assert time.monotonic() < deadline, "it never came back"
                time.sleep(0.02)


def test_other_size_than_the_calibration(projector: Projector) -> None:
    model = MODEL.altered(width=320, height=240)
    with (
        pytest.raises(CameraError, match="160x120, the calibration 'test' is for 320x240"),
        opened(projector.server.url, model),
    ):
        pass


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("97", "video devices here"),
        ("/dev/video97", "video devices here"),
        ("nothing.avi", "file exists"),
        ("http://127.0.0.1:9/stream.mjpg", "server is running"),
    ],
)
def test_no_such_camera(source: str, says: str) -> None:
    with pytest.raises(CameraError, match=says), opened(source):
        pass


@pytest.mark.realtime
def test_recording_plays_at_its_own_speed_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "recording.avi"
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (WIDTH, HEIGHT), isColor=True
    )
    for k in range(20):
        writer.write(picture(5 * k))
    writer.release()
    start = time.monotonic()
    with opened(str(path)) as camera:
        frames: list[Frame] = []
        with pytest.raises(CameraError, match="ended"):
            frames.extend(frames_of(camera, limit=3.0))
        assert frames[-1].sequence >= 18
    assert time.monotonic() - start == pytest.approx(20 / RATE, abs=0.3)


def test_closed_camera(projector: Projector) -> None:
    with opened(projector.server.url) as camera:
        pass
    camera.close()
    with pytest.raises(CameraError, match="not open"):
        camera.read()


# --- on simulated time -----------------------------------------------------------------------


def test_age_of_what_is_read_and_when_it_is_refused(site: Site) -> None:
    """A picture is refused as soon as it is too old, and taken again when there is a new one."""
    with opened("http://camera/stream.mjpg") as camera:
        stamps = []
        for _ in range(100):
            site.world.sleep(0.013)
            frame = camera.read()
            assert site.world.now - frame.stamp <= 0.1 + 1e-6
            stamps.append(frame.stamp)
        assert len(set(stamps)) == pytest.approx(13, abs=1)
        for trouble in ("frozen", "dropped"):
            last = camera.read().stamp
            setattr(site.film, trouble, True)
            site.world.sleep(last + 0.34 - site.world.now)
            assert camera.read().stamp == last
            site.world.sleep(0.02)
            with pytest.raises(StaleFrameError, match=trouble):
                camera.read()
            site.world.sleep(1.5)
            setattr(site.film, trouble, False)
            site.world.sleep(0.5)
            assert camera.read().stamp > last + 1.5
    assert site.film.opened == site.film.released > 1


def test_a_stream_that_changes_its_size_is_a_fault(tmp_path: Path) -> None:
    """FFmpeg by itself goes on delivering the first size."""
    path = tmp_path / "stream.mjpeg"
    shots = [picture(level) for level in range(0, 40, 8)]
    shots += [cv2.resize(picture(level), (WIDTH, HEIGHT // 2)) for level in range(0, 80, 8)]
    path.write_bytes(b"".join(cv2.imencode(".jpg", shot)[1].tobytes() for shot in shots))
    with (
        pytest.raises(CameraError, match=f"it delivers {WIDTH}x{HEIGHT // 2}"),
        opened(str(path)) as camera,
    ):
        for _ in frames_of(camera, 5.0):
            pass
