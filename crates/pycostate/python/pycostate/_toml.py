"""Scenes as text: TOML is what the engine reads."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping

from .errors import InputError

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def _key(key) -> str:
    key = str(key)
    return key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)


def _number(value: float) -> str:
    if math.isfinite(value):
        return repr(float(value))
    return "nan" if math.isnan(value) else ("inf" if value > 0 else "-inf")


def _value(value, path: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        parts = [
            f"{_key(k)} = {_value(v, f'{path}.{k}')}" for k, v in value.items() if v is not None
        ]
        return "{ " + ", ".join(parts) + " }" if parts else "{}"
    if hasattr(value, "tolist"):  # numpy's arrays and numbers
        return _value(value.tolist(), path)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(v, path) for v in value) + "]"
    raise InputError(f"{path}: a {type(value).__name__} is neither text, number, list nor dict")


def dumps(sections: Mapping) -> str:
    """Sections as TOML: dicts of dicts become tables, so that messages have lines of their own."""
    plain, tables = [], []
    for name, value in sections.items():
        if value is None:
            continue
        if isinstance(value, Mapping):
            lines = [f"[{_key(name)}]"]
            lines += [
                f"{_key(k)} = {_value(v, f'{name}.{k}')}" for k, v in value.items() if v is not None
            ]
            tables.append("\n".join(lines))
        else:
            plain.append(f"{_key(name)} = {_value(value, str(name))}")
    return "\n\n".join(["\n".join(plain), *tables] if plain else tables) + "\n"


def loads(text: str) -> dict:
    """The sections of a text."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]
    return tomllib.loads(text)


def merged(sections: Mapping, changes: Mapping) -> dict:
    """Sections with changes: a dict is merged into the one that is there, None takes away."""
    out = dict(sections)
    for name, value in changes.items():
        if value is None:
            out.pop(name, None)
        elif isinstance(value, Mapping) and isinstance(out.get(name), Mapping):
            out[name] = merged(out[name], value)
        else:
            out[name] = value
    return out
