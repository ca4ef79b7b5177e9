"""Strict YAML documents: every error names the file, the key and what was expected."""

from __future__ import annotations

import difflib
import json
import logging
import reprlib
from collections.abc import Iterable, Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from visctrl.robots.errors import InputError
from visctrl.robots.files import read_text
from visctrl.robots.plain_yaml import MOST_BYTES, YamlError, load_plain

_log = logging.getLogger(__name__)

Model = TypeVar("Model", bound=BaseModel)


#: Characters of a wrong value in a message.
_WIDEST = 80
#: Pydantic's words for a value where there should be keys.
_WANTED_A_MAPPING = ("model_type", "model_attributes_type")
#: Wrong keys that are told at a time.
_MOST_ERRORS = 10


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
    _log.info("reading %s", source)
    if isinstance(source, Path):
        return parse_yaml(read_text(source, MOST_BYTES), str(source))
    return parse_yaml(source.read_text(encoding="utf-8"), str(source))


def read_json(path: Path, most: int = MOST_BYTES) -> Any:
    """Return what a JSON file holds; ``most`` is the largest size that is read (bytes).

    Raises
    ------
    InputError
        The file is missing, unreadable, or not JSON.
    """
    return parse_json(read_text(path, most), str(path))


def parse_json(text: str, origin: str) -> Any:
    """Return what a JSON text says; ``origin`` names it in messages.

    Raises
    ------
    InputError
        It is not JSON.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, ValueError) else "nested too deeply"
        raise InputError(f"{origin}: not valid JSON: {reason}") from None


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Return the mapping that a YAML text holds; ``source`` names it in messages.

    Raises
    ------
    InputError
        Not YAML, or not a mapping.
    """
    try:
        data = load_plain(text)
    except YamlError as error:
        where = source if error.line is None else f"{source}:{error.line}"
        raise InputError(f"{where}: not valid YAML: {error}") from None
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
        found = error.errors()
        lines = [_describe(detail, model, origin) for detail in found[:_MOST_ERRORS]]
        if len(found) > _MOST_ERRORS:
            lines.append(f"{origin}: and {len(found) - _MOST_ERRORS} more")
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
    if detail["type"] in _WANTED_A_MAPPING and (keys := _keys_at(model, detail["loc"])):
        example = f"{path}.{keys[0]}"
        return (
            f"{origin}: key '{path}': expected keys below it ({', '.join(keys)}), as in {example} "
            f"(got {_short(detail)})"
        )
    message = detail["msg"].removeprefix("Value error, ")
    return f"{origin}: key '{path}': {message[:1].lower()}{message[1:]} (got {_short(detail)})"


def _short(detail: ErrorDetails) -> str:
    """Return the value that is wrong, as far as it fits into a line."""
    shown = reprlib.repr(detail["input"])
    return shown if len(shown) <= _WIDEST else f"{shown[:_WIDEST]}..."


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
