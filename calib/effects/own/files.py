"""Effects of users' own: formulas in a YAML file, classes in a Python file."""

from __future__ import annotations

import importlib.util
import inspect
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from calib.effects.base import Effect, Site
from calib.effects.own.formula import FormulaEffect
from chains.errors import InputError
from sensors.documents import nearest, read_yaml

YAML, PYTHON = (".yaml", ".yml"), ".py"


def is_file(text: str) -> bool:
    """Whether an item names a file of effects, with or without a class."""
    return text.endswith((*YAML, PYTHON)) or f"{PYTHON}:" in text


def from_file(text: str) -> list[Effect]:
    """The effects that a file holds: ``file.yaml``, ``file.py`` or ``file.py:Class``.

    A YAML file is one formula effect (see `FormulaFile`) or a list of them. A Python file is run.

    Raises:
        InputError: the file is missing, or holds no such effect.
    """
    if text.endswith(YAML):
        return _formulas(text)
    path, _, name = text.rpartition(f"{PYTHON}:") if f"{PYTHON}:" in text else (text, "", "")
    path = f"{path}{PYTHON}" if name else text.removesuffix(":")
    module = _run(Path(path))
    classes = {
        key: value
        for key, value in vars(module).items()
        if inspect.isclass(value)
        and issubclass(value, Effect)
        and value.__module__ == module.__name__
        and not inspect.isabstract(value)
    }
    if not classes:
        raise InputError(
            f"{path} has no effect; derive a class with params and basis from calib.effects.Effect"
        )
    if name and name not in classes:
        raise InputError(f"{path} has no effect '{name}'{nearest(name, classes)}")
    chosen = {name: classes[name]} if name else classes
    return [_made(Path(path), key, kind) for key, kind in chosen.items()]


def from_document(document: Mapping[str, Any], path: str | Path) -> Effect:
    """The effect of a mapping that `Effect.document` gave; `path` is where it stands."""
    if "python" not in document:
        return FormulaEffect.read(document, path, {})
    try:
        source, name = str(document["python"]), str(document["name"])
        shape = None if document.get("shape") is None else float(document["shape"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: {dict(document)} names no effect of a Python file") from None
    (effect,) = from_file(f"{source}:{name}")
    return effect if shape is None else effect.at(shape)


def _formulas(path: str) -> list[Effect]:
    data, marks = read_yaml(path)
    if not isinstance(data, list):
        return [FormulaEffect.read(data, path, marks)]
    if not data:
        raise InputError(f"{path} lists no effect")
    return [
        FormulaEffect.read(each, path, {k[1:]: line for k, line in marks.items() if k[:1] == (i,)})
        for i, each in enumerate(data)
    ]


def _run(path: Path) -> ModuleType:
    """The module of a Python file."""
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    path = path.resolve()
    name = f"rigcal_effects_{zlib.crc32(str(path).encode()):08x}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise InputError(f"{path} cannot be run: {type(error).__name__}: {error}") from error
    return module


def _made(path: Path, name: str, kind: type[Effect]) -> Effect:
    """The effect of a class, which remembers where it came from."""
    try:
        effect = kind()
    except Exception as error:
        raise InputError(f"{path}: {name}() fails: {type(error).__name__}: {error}") from error
    if not isinstance(getattr(effect, "name", None), str) or not effect.name.isidentifier():
        raise InputError(f"{path}: {name} needs a name: letters, digits and _")
    if not isinstance(getattr(effect, "site", None), Site):
        raise InputError(f"{path}: {name} needs a site, one of calib.effects.Site")
    effect.origin = {"python": str(path.resolve()), "name": name}
    return effect
