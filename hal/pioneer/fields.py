"""Binary layouts written as dataclasses: a field's metadata says how it is coded.

Codes are those of `struct` (little endian), and ``z`` for a NUL-terminated string. A layout may
end early: firmware of different ages appends fields, so a decoder takes those that are there.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any, TypeVar

Layout = TypeVar("Layout", bound="Fields")


_known: dict[type, tuple[tuple[str, str], ...]] = {}


def coded(code: str, default: Any = None) -> Any:
    """Return a dataclass field with a wire code; None means that the packet ended before it."""
    return dataclasses.field(default=default, metadata={"code": code})


@dataclasses.dataclass(frozen=True)
class Fields:
    """Base of a layout. ``surplus`` holds the bytes behind the last complete field."""

    surplus: bytes = dataclasses.field(default=b"", kw_only=True)

    @classmethod
    def decode(cls: type[Layout], data: bytes) -> Layout:
        """Return the fields that ``data`` holds; those behind its end are None."""
        values: dict[str, Any] = {}
        position = 0
        for name, code in _codes(cls):
            taken = _take(data, position, code)
            if taken is None:
                break
            values[name], position = taken
        missing = {name: None for name, _ in _codes(cls) if name not in values}
        return cls(**values, **missing, surplus=data[position:])

    def encode(self) -> bytes:
        """Return the bytes of the fields up to the first that is None, and the surplus."""
        data = b""
        for name, code in _codes(type(self)):
            value = getattr(self, name)
            if value is None:
                break
            data += (
                value.encode("latin-1") + b"\0" if code == "z" else struct.pack("<" + code, value)
            )
        return data + self.surplus


def _codes(layout: type[Fields]) -> tuple[tuple[str, str], ...]:
    if layout not in _known:
        fields = dataclasses.fields(layout)
        codes = ((field.name, field.metadata["code"]) for field in fields if field.metadata)
        _known[layout] = tuple(codes)
    return _known[layout]


def _take(data: bytes, position: int, code: str) -> tuple[Any, int] | None:
    """Return the value at ``position`` and where the next begins, or None behind the end."""
    if code == "z":
        end = data.find(b"\0", position)
        return None if end < 0 else (data[position:end].decode("latin-1"), end + 1)
    end = position + struct.calcsize("<" + code)
    if end > len(data):
        return None
    return struct.unpack("<" + code, data[position:end])[0], end
