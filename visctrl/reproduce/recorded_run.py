"""A run of an entry, with what its figures are drawn from."""

from __future__ import annotations

from typing import Any

from visctrl.reproduce.image_motion import ImageMotion
from visctrl.runtime.session import run_session
from visctrl.studies.run_spec import RunSpec
from visctrl.viewers.run_pictures import run_with_pictures


def drive(run: RunSpec) -> dict[str, Any]:
    """Run one and return its summary; where it has a directory, with pictures and features.

    Raises
    ------
    InputError
        The scenario or a setting cannot be used.
    """
    plan, directory = run.plan(), run.directory()
    if directory is None:
        return run_session(plan).summary
    motion = ImageMotion()
    summary = run_with_pictures(plan, directory, observers=[motion]).summary
    motion.save(directory.path)
    return summary
