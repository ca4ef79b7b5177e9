"""Text of a file as a mapping: OpenCV's YAML dialect, its XML and its JSON, plain YAML."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from typing import Any

from visctrl.robots.documents import parse_yaml
from visctrl.robots.errors import InputError

_OPENCV_TAGS = re.compile(r"!!opencv-(matrix|nd-matrix|sparse-matrix)|!<tag:[^>]*>")


def mapping_of(text: str, where: str) -> dict[str, Any]:
    """Return the mapping that a YAML, JSON or XML text holds.

    Raises
    ------
    InputError
        It cannot be read; the message names the line, and the key after which it ends.
    """
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith("<"):
        return _from_xml(start, where)
    if start.startswith("{"):
        try:
            data: dict[str, Any] = json.loads(start, object_pairs_hook=_without_twins)
        except json.JSONDecodeError as error:
            after = _after(start, error.lineno)
            raise InputError(
                f"{where}:{error.lineno}: not valid JSON{after}: {error.msg}"
            ) from None
        except (ValueError, RecursionError) as error:
            raise InputError(f"{where}: {_reason(error)}") from None
        return data
    # OpenCV's header is no YAML, or of a version that its own text is not.
    plain = _OPENCV_TAGS.sub("", re.sub(r"^%YAML[: ]\s*1\.\d[^\n]*", "", start))
    try:
        return parse_yaml(plain, where)
    except InputError as error:
        found = re.match(re.escape(where) + r":(\d+):", str(error))
        line = int(found[1]) if found else len(plain)
        raise InputError(f"{error}{_after(plain, line)}") from None


def _after(text: str, line: int) -> str:
    """Return a hint at the last key before a line."""
    keys = re.findall(r"^\s*\"?([A-Za-z]\w*)\"?\s*:", "\n".join(text.splitlines()[:line]), re.M)
    return f" (after key '{keys[-1]}')" if keys else ""


def _reason(error: ValueError | RecursionError) -> str:
    return str(error) if isinstance(error, ValueError) else "nested too deeply"


def _from_xml(text: str, where: str) -> dict[str, Any]:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        line = error.position[0]
        tags = re.findall(r"<([A-Za-z]\w*)", "\n".join(text.splitlines()[:line]))
        hint = f" (after key '{tags[-1]}')" if tags else ""
        raise InputError(f"{where}:{line}: not valid XML{hint}: {error}") from None
    if root.tag != "opencv_storage":
        raise InputError(f"{where}: XML of '{root.tag}', expected 'opencv_storage'")
    try:
        content = _element(root)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: {_reason(error)}") from None
    return content if isinstance(content, dict) else {}


def _element(element: ElementTree.Element) -> Any:
    """Return what an element of OpenCV's XML holds: a mapping, a list, a number or a text."""
    children = list(element)
    if not children:
        return _scalar(element.text or "")
    if all(child.tag == "_" for child in children):
        return [_element(child) for child in children]
    return _without_twins([(child.tag, _element(child)) for child in children])


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return pairs as a mapping; a key that stands there twice is a ValueError."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key '{key}' stands there twice")
        found[key] = value
    return found


def _scalar(text: str) -> Any:
    text = text.strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    words = text.split()
    try:
        values = [float(word.replace(".Nan", "nan").replace(".Inf", "inf")) for word in words]
    except ValueError:
        return text
    return values[0] if len(values) == 1 else values
