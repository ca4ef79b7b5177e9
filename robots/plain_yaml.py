"""YAML restricted to what JSON can say, of bounded size: nothing to be surprised by.

The loader is PyYAML's. What is left out: dates and tags (they make objects of other types), a key
given twice (of which one would silently win), depth and aliases beyond measure.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, ClassVar

import yaml
from yaml.constructor import ConstructorError

#: The scanner written in C, where PyYAML was built with it, is ten times faster.
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

#: Bytes of a file, levels of nesting, and values with every alias written out.
MOST_BYTES = 4_000_000
_MOST_DEEP, _MOST_VALUES = 50, 200_000
_KINDS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_PREFIX = "tag:yaml.org,2002:"


class YamlError(ValueError):
    """A text is no YAML of this kind.

    line : where, from 1; None if it is not known.
    """

    def __init__(self, problem: str, mark: Any = None) -> None:
        super().__init__(problem)
        self.line = None if mark is None else mark.line + 1


def load_plain(text: str) -> Any:
    """Return what a YAML text says, in dicts, lists, strings, numbers, booleans and None.

    Raises
    ------
    YamlError
        It is not YAML, or uses what is left out; the message says what.
    """
    try:
        _measure(text)
        return yaml.load(text, Loader=_Loader)  # _Loader is a subclass of the safe one
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or "cannot be parsed"
        raise YamlError(problem, getattr(error, "problem_mark", None)) from None
    except RecursionError:
        raise YamlError("is nested too deeply") from None
    except (ValueError, OverflowError) as error:
        if isinstance(error, YamlError):
            raise
        raise YamlError("holds characters that no text has") from None


def _measure(text: str) -> None:
    """Refuse a text that nests too deeply or would grow too large, before anything is built."""
    sizes: dict[str, int | None] = {}
    opened: list[tuple[str | None, int]] = []
    count = 0
    for event in yaml.parse(text, Loader=_Base):
        if isinstance(event, yaml.AliasEvent):
            size = sizes.get(str(event.anchor), 0)
            if size is None:
                raise YamlError(f"alias *{event.anchor} holds itself", event.start_mark)
            count += size
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, count))
            if event.anchor:
                sizes[event.anchor] = None
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            if anchor:
                sizes[anchor] = count - before
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor:
                sizes[event.anchor] = 1
        if len(opened) > _MOST_DEEP:
            raise YamlError(f"is nested more than {_MOST_DEEP} levels deep", event.start_mark)
        if count > _MOST_VALUES:
            raise YamlError(f"holds more than {_MOST_VALUES:,} values", event.start_mark)


class _Loader(_Base):  # type: ignore[misc]
    """PyYAML's safe loader without dates, with errors for keys given twice."""

    yaml_implicit_resolvers: ClassVar = {
        first: [(tag, pattern) for tag, pattern in found if tag.removeprefix(_PREFIX) in _KINDS]
        for first, found in _Base.yaml_implicit_resolvers.items()
    }

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node; one that cannot be made is told with its place."""
        if node.tag.removeprefix(_PREFIX) not in _KINDS:
            raise ConstructorError(None, None, f"unknown tag {node.tag!r}", node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, KeyError, IndexError):
            what = node.tag.removeprefix(_PREFIX)
            shown = str(node.value)[:40]
            problem = f"'{shown}' is no {what} that can be used"
            raise ConstructorError(None, None, problem, node.start_mark) from None

    def construct_mapping(self, node: yaml.Node, deep: bool = False) -> dict[Hashable, Any]:
        """Return a mapping; a key must be text or a whole number and stand there once."""
        if isinstance(node, yaml.MappingNode):
            seen = set()
            for key, _ in node.value:
                if key.tag == f"{_PREFIX}merge":
                    continue
                name = key.value if isinstance(key, yaml.ScalarNode) else None
                if name is None or key.tag.removeprefix(_PREFIX) not in ("str", "int"):
                    shown = repr(name) if name is not None else "a list or mapping"
                    problem = f"expected text as a key, found {shown}: put it in quotes"
                    raise ConstructorError(None, None, problem, key.start_mark)
                if name in seen:
                    raise ConstructorError(None, None, f"key '{name}' twice", key.start_mark)
                seen.add(name)
        found: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return found
