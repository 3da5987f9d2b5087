"""Frozen dataclasses as configuration: YAML in, checked objects out.

Each stage owns one frozen dataclass of plain fields, validated in its `__post_init__`; this module only builds them from
mappings, naming a wrong key with its nearest known neighbour.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import re
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from obsnet.errors import ConfigError

T = TypeVar("T")


def build(cls: type[T], values: Mapping[str, Any] | None = None, where: str = "") -> T:
    """Build a (nested) frozen dataclass from a mapping.

    Parameters
    ----------
    cls : type
        A dataclass whose fields are plain values or dataclasses themselves.
    values : mapping, optional
        Keys are field names; missing ones take their defaults.
    where : str
        Dotted path of `values` in the file, for messages.

    Raises
    ------
    ConfigError
        An unknown key (the nearest known one is named), a value of the wrong type, or one that the class refuses.
    """
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where or 'the configuration'} must be a mapping of keys, found {values!r}")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    arguments = {}
    for key, value in values.items():
        path = f"{where}.{key}" if where else str(key)
        if key not in fields:
            near = difflib.get_close_matches(str(key), list(fields), n=1, cutoff=0.0)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ConfigError(f"unknown key '{path}' in the configuration{hint} (known: {', '.join(fields)})")
        arguments[key] = _convert(value, hints[key], path)
    try:
        return cls(**arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}" if where else str(error)) from None
    except TypeError as error:
        raise ConfigError(f"{where or cls.__name__}: {error}") from None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file, interpolations resolved, into plain containers."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError, safe_load

    try:
        text = Path(path).read_text(encoding="utf-8")
        found = safe_load(text)
        plain = (
            OmegaConf.to_container(OmegaConf.create(text), resolve=True) if isinstance(found, dict) else {}
        )
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {path}: {error.strerror}") from None
    except (OmegaConfBaseException, YAMLError, ValueError, RecursionError) as error:
        line = " ".join(str(error).split())[:300]
        raise ConfigError(f"{path} is not a valid YAML configuration: {line}") from None
    if not isinstance(plain, dict) or not isinstance(found, dict | None):
        raise ConfigError(f"{path} must hold a mapping of keys, found a {type(found).__name__}")
    return {str(key): value for key, value in plain.items()}


def merge_overrides(values: Mapping[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Values with `section.key=value` overrides laid over them."""
    if not overrides:
        return dict(values)
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    for override in overrides:
        if not re.match(r"\w+(\.\w+)*=", override):
            raise ConfigError(f"override '{override}' must read section.key=value")
    try:
        merged = OmegaConf.merge(OmegaConf.create(dict(values)), OmegaConf.from_dotlist(overrides))
        plain = OmegaConf.to_container(merged, resolve=True)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise ConfigError(
            f"overrides {overrides} cannot be applied: {' '.join(str(error).split())}"
        ) from None
    return {str(key): value for key, value in plain.items()} if isinstance(plain, dict) else {}


def require_seed(seed: Any) -> None:
    """`ConfigError` unless a generator of random numbers can be seeded with it."""
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or seed < 0:
        raise ConfigError(f"the seed must be a whole number of at least 0, found {seed!r}")


def to_dict(config: Any) -> dict[str, Any]:
    """Plain nested dictionary of a configuration dataclass, ready for YAML or JSON."""
    return dataclasses.asdict(config)


def first_change(before: Mapping[str, Any], now: Mapping[str, Any], where: str = "") -> str:
    """The first parameter of nested mappings that differs, in words; empty where none does."""
    for key in sorted({*before, *now}):
        old, new, path = before.get(key), now.get(key), f"{where}{key}"
        if isinstance(old, dict) and isinstance(new, dict):
            if found := first_change(old, new, f"{path}."):
                return found
        elif old != new:
            return f"{path} = {old!r}, not {new!r}"
    return ""


def _convert(value: Any, hint: Any, path: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        (hint,) = [option for option in options if option is not type(None)][:1]
        return _convert(value, hint, path)
    if origin is typing.Literal:
        choices = typing.get_args(hint)
        if value not in choices:
            raise ConfigError(f"{path} must be one of {', '.join(map(str, choices))}, found {value!r}")
        return value
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, (list, tuple)):
            raise ConfigError(f"{path} must be a list, found {value!r}")
        item = typing.get_args(hint)[0]
        return tuple(_convert(element, item, f"{path}[{i}]") for i, element in enumerate(value))
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, path)
    if hint is float and type(value) in (int, float):
        if not math.isfinite(value):
            raise ConfigError(f"{path} must be a finite number, found {value}")
        return float(value)
    if hint in (str, Path) and isinstance(value, (str, Path)):
        return hint(value)
    if hint in (int, float, bool) and type(value) is not hint:
        raise ConfigError(f"{path} must be {_article(hint)}, found {value!r}")
    if hint is str:
        raise ConfigError(f"{path} must be text, found {value!r}")
    return value


def _article(hint: type) -> str:
    return {int: "a whole number", float: "a number", bool: "true or false"}[hint]
