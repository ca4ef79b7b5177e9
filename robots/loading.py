"""Classes named as ``module:Class``, imported when they are used, whatever their code does."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import sys
import traceback
from types import ModuleType

from visctrl.robots.errors import InputError, LoadError

_log = logging.getLogger(__name__)


def load_object(target: str, what: str) -> object:
    """Import ``module:Class``; ``what`` opens the error message.

    Raises
    ------
    InputError
        There is no such module, or nothing of this name in it.
    LoadError
        Its code fails while it is imported.
    """
    module_name, _, attribute = target.partition(":")
    found: object = load_module(module_name, what)
    try:
        for part in attribute.split("."):
            found = getattr(found, part)
    except AttributeError as error:
        raise InputError(f"{what} cannot be loaded: {error}") from error
    return found


def load_module(name: str, what: str) -> ModuleType:
    """Import a module, also from the current folder; ``what`` opens the error message.

    The current folder, where an installed command does not look by itself, stays what it was:
    relative paths of a scenario count from there.

    Raises
    ------
    InputError
        There is no such module.
    LoadError
        Its code fails while it is imported.
    """
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it is gone: what is installed can still be used
        here = None
    if here is not None and here not in sys.path:
        sys.path.append(here)
    _log.debug("importing %s", name)
    try:
        return importlib.import_module(name)
    except (ImportError, TypeError, ValueError) as error:
        if isinstance(error, ImportError) or _is_about_name(error):
            raise InputError(f"{what} cannot be loaded: {error}") from error
        raise _failure(what, error) from error
    except (Exception, SystemExit) as error:
        raise _failure(what, error) from error
    finally:
        if here is not None:
            with contextlib.suppress(OSError):
                os.chdir(here)


def _is_about_name(error: BaseException) -> bool:
    """Return whether an import failed before any code of the module was run."""
    frames = traceback.extract_tb(error.__traceback__)
    return all("importlib" in frame.filename or frame.filename == __file__ for frame in frames)


def _failure(what: str, error: BaseException) -> LoadError:
    """Return what to tell of code that failed: the error and the line it comes from."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    inside = "importlib" not in frame.filename
    where = f" ({frame.filename}, line {frame.lineno})" if inside else ""
    name = type(error).__name__
    return LoadError(f"{what} fails while it is imported: {name}: {error}{where}")
