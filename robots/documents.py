"""Strict YAML documents: every error names the file, the key and what was expected."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from visctrl.robots.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """A part of a YAML file: immutable, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_yaml(source: Path | Traversable) -> dict[str, Any]:
    """Return the mapping that a YAML file holds.

    Raises
    ------
    InputError
        The file is missing, unreadable, not YAML, or not a mapping.
    """
    try:
        text = source.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{source}: cannot be read: {error}") from None
    return parse_yaml(text, str(source))


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Return the mapping that a YAML text holds; ``source`` names it in messages.

    Raises
    ------
    InputError
        Not YAML, or not a mapping.
    """
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark is not None else str(source)
        problem = getattr(error, "problem", None) or "cannot be parsed"
        raise InputError(f"{where}: not valid YAML: {problem}") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError(f"{source}: expected a mapping of keys, found {type(data).__name__}")
    return data


def validate(data: Mapping[str, Any], model: type[Model], origin: str) -> Model:
    """Check ``data`` against ``model``; ``origin`` names the file or option in the message.

    Raises
    ------
    InputError
        One line per wrong key, each with its dotted path and what was expected.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = [_describe(detail, model, origin) for detail in error.errors()]
        raise InputError("\n".join(lines)) from None


def load(source: Path | Traversable, model: type[Model]) -> Model:
    """Read one YAML file and check it against ``model`` (see `read_yaml`, `validate`)."""
    return validate(read_yaml(source), model, str(source))


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return the known names, nearest first: ``known: a, b (did you mean 'a'?)``."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"known: {', '.join(names)}{hint}"


def _describe(detail: ErrorDetails, model: type[BaseModel], origin: str) -> str:
    path = ".".join(str(part) for part in detail["loc"]) or "(top level)"
    if detail["type"] == "extra_forbidden":
        known = _keys_at(model, detail["loc"][:-1])
        hint = f"; {suggestion(str(detail['loc'][-1]), known)}" if known else ""
        return f"{origin}: unknown key '{path}'{hint}"
    if detail["type"] == "missing":
        return f"{origin}: key '{path}' is missing"
    message = detail["msg"].removeprefix("Value error, ")
    return f"{origin}: key '{path}': {message[:1].lower()}{message[1:]} (got {detail['input']!r})"


def _keys_at(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the field names of the sub-model that ``path`` leads to (empty if unclear)."""
    here: type[BaseModel] | None = model
    for part in path:
        if here is None:
            return []
        if isinstance(part, int) or part not in here.model_fields:
            continue
        here = _model_in(here.model_fields[part].annotation)
    return list(here.model_fields) if here is not None else []


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
