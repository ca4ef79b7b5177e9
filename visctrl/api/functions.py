"""What the commands do, as functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from visctrl.api.results import Run
from visctrl.api.stepping import Session
from visctrl.robots.errors import InputError
from visctrl.runtime.config import Override
from visctrl.runtime.overrides import flag_overrides, load_for_backend
from visctrl.runtime.plan import Plan, make_plan
from visctrl.runtime.records import Observer
from visctrl.runtime.stop import StopRequest

if TYPE_CHECKING:
    from visctrl.runtime.target_view import TargetView

Settings = Mapping[str, Any]
Start = tuple[float, float, float]
#: An ending that is no number of a summary: replays have no verdict.
_REPLAYED = {"status": "replayed", "reason": "perception and estimation again over a recording"}


def run(
    scenario: str = "default",
    *,
    start: Start | None = None,
    scheme: str | None = None,
    backend: str | None = None,
    robot: str | None = None,
    camera: str | None = None,
    seed: int | None = None,
    duration: float | None = None,
    target: Path | str | None = None,
    settings: Settings | None = None,
    out: Path | str | None = None,
    video: bool = False,
    observers: Sequence[Observer] = (),
) -> Run:
    """Run a scenario to its end, whatever that is.

    Parameters
    ----------
    scenario : str
        Built-in name (``visctrl list``) or a YAML file.
    start : (x m, y m, φ deg), optional
        Start in the target's frame: x right, y forward, heading counter-clockwise.
    scheme, backend, robot, camera, seed, duration, target
        As the options of the same names.
    settings : mapping
        Scenario keys and their values, such as ``{"mock.noise_px": 1.0}``.
    out : path, optional
        Run directory; without it the files live as long as the result does.
    video : bool
        Also write a video.
    observers : sequence of Observer
        Told about everything that happens.

    Raises
    ------
    InputError
        Something cannot be used, found before the robot was told anything. Every other end,
        faults of devices and plugins included, is told by the `Run`.
    """
    plan = _plan(scenario, settings, start, scheme, backend, robot, camera, seed, duration, target)
    return _conduct(plan, out, video=video, observers=observers)


def session(
    scenario: str = "default",
    *,
    start: Start | None = None,
    scheme: str | None = None,
    backend: str | None = None,
    robot: str | None = None,
    camera: str | None = None,
    seed: int | None = None,
    duration: float | None = None,
    target: Path | str | None = None,
    settings: Settings | None = None,
    out: Path | str | None = None,
) -> Session:
    """Return a run that is done tick by tick (see `Session`); parameters as of `run`.

    Raises
    ------
    InputError
        The scenario cannot be used.
    """
    plan = _plan(scenario, settings, start, scheme, backend, robot, camera, seed, duration, target)

    def begin(gate: Observer, stop: StopRequest) -> Run:
        return _conduct(plan, out, video=False, observers=[gate], stop=stop)

    return Session(begin)


def teach(
    path: Path | str | None = None,
    *,
    backend: str | None = None,
    robot: str | None = None,
    camera: str | None = None,
    seed: int | None = None,
    count: int = 1,
    settings: Settings | None = None,
) -> TargetView:
    """Take the target view where the robot stands (a simulated one visits its target).

    Parameters
    ----------
    path : path, optional
        ``.npz`` file to write it to, for ``run(target=path)``.
    count : int
        Pictures taken from the same pose.
    backend, robot, camera, seed, settings
        As of `run`.

    Raises
    ------
    InputError, DeviceError
        An option or a device cannot be used, or there is no picture.
    """
    from visctrl.runtime.teaching import take_target

    plan = _plan("default", settings, None, None, backend, robot, camera, seed, None, None)
    view, _ = take_target(plan, count)
    if path is not None:
        view.save(Path(path))
    return view


def replay(
    recording: Path | str,
    *,
    camera: str | None = None,
    settings: Settings | None = None,
    out: Path | str | None = None,
) -> Run:
    """Run perception, estimator and controller once more over recorded images, open loop.

    Parameters
    ----------
    recording : path
        Directory of a run with ``record_images``, or a folder of images.
    camera : str, optional
        Which camera took them, where the recording does not say.
    settings, out
        As of `run`; ``{"perception.name": "sift"}`` replays with another plugin.

    Raises
    ------
    InputError
        Images or options cannot be used.
    """
    from visctrl.runtime.config import load_scenario
    from visctrl.runtime.recording import open_recording
    from visctrl.runtime.registry import REGISTRIES
    from visctrl.runtime.replay import replay as replay_recording
    from visctrl.runtime.replay_plan import load_for_replay, plan_replay
    from visctrl.viewers.run_pictures import Pictures

    overrides = [*_overrides(settings), *flag_overrides(camera=camera)]

    def rate_hz() -> float:
        known = REGISTRIES.backends.names()
        return load_scenario(overrides=overrides, backend_names=known).scenario.rate_hz

    source = open_recording(Path(recording), None, rate_hz)
    if source.camera is None and not any(o.path == ("camera", "name") for o in overrides):
        raise InputError(f"{recording}: say with camera=... which camera took these images")
    loaded = load_for_replay(source, overrides)
    named = any(override.path == ("controller", "name") for override in overrides)
    plan = plan_replay(loaded, recorded=source.config is not None, named=named)
    directory, temporary = _directory(out)
    summary = replay_recording(source, plan, directory, observers=[Pictures(plan, directory)])
    return Run({**_REPLAYED, **summary}, 0, directory, (), temporary)


def study(
    name: str, *, out: Path | str | None = None, workers: int | None = None
) -> dict[str, Any]:
    """Run a study (a built-in name or a file) and return its summary, cell by cell.

    ``out`` keeps table and log, so that a later call goes on with what is missing; the table is
    ``table.csv`` there.

    Raises
    ------
    InputError
        The study or one of its scenarios cannot be used; nothing has been run.
    """
    from visctrl.studies.conduct import conduct_study
    from visctrl.studies.loading import load_study
    from visctrl.studies.workers import LocalWorkers, default_workers

    directory, temporary = _directory(out)
    loaded = load_study(name)
    loaded.check()
    done = conduct_study(loaded, directory, LocalWorkers(workers or default_workers()))
    if temporary is not None:
        temporary.cleanup()
    if done.interruption is not None:
        raise done.interruption
    return done.summary


def _plan(
    scenario: str,
    settings: Settings | None,
    start: Start | None,
    scheme: str | None,
    backend: str | None,
    robot: str | None,
    camera: str | None,
    seed: int | None,
    duration: float | None,
    target: Path | str | None,
) -> Plan:
    flags = flag_overrides(
        start=start,
        scheme=scheme,
        backend=backend,
        robot=robot,
        camera=camera,
        seed=seed,
        duration=duration,
        target=None if target is None else str(target),
    )
    return make_plan(load_for_backend(scenario, [*_overrides(settings), *flags], {}))


def _overrides(settings: Settings | None) -> list[Override]:
    return [
        Override(tuple(key.split(".")), value, f"settings {key!r}")
        for key, value in (settings or {}).items()
    ]


def _directory(out: Path | str | None) -> tuple[Path, TemporaryDirectory[str] | None]:
    """Return the directory for files, and what holds it where nobody asked for one."""
    if out is not None:
        return Path(out).absolute(), None
    temporary = TemporaryDirectory(prefix="visctrl-")
    return Path(temporary.name) / "run", temporary


def _conduct(
    plan: Plan,
    out: Path | str | None,
    *,
    video: bool,
    observers: Sequence[Observer],
    stop: StopRequest | None = None,
) -> Run:
    from visctrl.viewers.run_pictures import run_with_pictures

    directory, temporary = _directory(out)
    outcome = run_with_pictures(plan, directory, video=video, observers=observers, stop=stop)
    return Run(outcome.summary, outcome.exit_code, directory, outcome.notes, temporary)
