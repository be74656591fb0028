"""Effects of users' own: formulas in a YAML file, classes in a Python file."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

from calib.effects.base import Effect, Site
from calib.effects.own.formula import FormulaEffect
from calib.effects.own.trust import Code, Trust, code_named
from chains.errors import InputError
from sensors.documents import nearest, read_yaml

YAML, PYTHON = (".yaml", ".yml"), ".py"
_RUN: dict[str, Code] = {}  # name of a module made here -> the file that was run


def is_file(text: str) -> bool:
    """Whether an item names a file of effects, with or without a class."""
    return text.endswith((*YAML, PYTHON)) or f"{PYTHON}:" in text


def files_in(folder: str) -> list[str]:
    """The files of formulas in a folder, by name; what is Python there is not named, so not run.

    Raises:
        InputError: there is none.
    """
    found = sorted(str(path) for path in Path(folder).iterdir() if path.suffix in YAML)
    if not found:
        raise InputError(f"{folder} has no file of effects; write formulas into {folder}/mine.yaml")
    return found


def from_file(text: str, trust: Trust | None = None) -> list[Effect]:
    """The effects that a file holds: ``file.yaml``, ``file.py`` or ``file.py:Class``.

    A YAML file is one formula effect (see `FormulaFile`) or a list of them. A Python file is run.

    Args:
        text: the file, and the class.
        trust: the Python files that may run; None where the user named this one himself.

    Raises:
        InputError: the file is missing, may not run, or holds no such effect.
    """
    if text.endswith(YAML):
        return _formulas(text)
    path, _, name = text.rpartition(f"{PYTHON}:") if f"{PYTHON}:" in text else (text, "", "")
    path = f"{path}{PYTHON}" if name else text.removesuffix(":")
    code = Code.read(path) if trust is None else code_named(path, None, "the spec", trust)
    return _effects(code, name)


def _effects(code: Code, name: str) -> list[Effect]:
    """The effects of a Python file, which is run: those of all its classes, or of one."""
    module, path = _run(code), code.path
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
    return [_made(code, key, kind) for key, kind in chosen.items()]


def from_document(document: Mapping[str, Any], path: str | Path, trust: Trust) -> Effect:
    """The effect of a mapping that `Effect.document` gave; `path` is where it stands.

    Raises:
        NotTrustedError: it is of a Python file that is not in `trust`.
        InputError: there is no such effect, or the file has changed.
    """
    if "python" not in document:
        return FormulaEffect.read(document, path, {})
    try:
        source, name = str(document["python"]), str(document["name"])
        shape = None if document.get("shape") is None else float(document["shape"])
        recorded = None if document.get("sha256") is None else str(document["sha256"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: {dict(document)} names no effect of a Python file") from None
    (effect,) = _effects(code_named(source, recorded, path, trust), name)
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


def _module_name(code: Code) -> str:
    return f"rigcal_effects_{code.sha256[:16]}"


def _run(code: Code) -> ModuleType:
    """The module of a Python file.

    It is compiled from the bytes that were hashed: an importer would take a cached .pyc for it,
    which need not be made from the same text.
    """
    module = ModuleType(_module_name(code))
    module.__file__ = str(code.path)
    sys.modules[module.__name__], _RUN[module.__name__] = module, code
    try:
        exec(compile(code.source, str(code.path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise InputError(f"{code.path} cannot be run: {type(error).__name__}: {error}") from error
    return module


def code_of(what: object) -> Code | None:
    """The file that defines a class or a function, where it is one that was run here."""
    defined = inspect.isclass(what) or inspect.isfunction(what)
    return _RUN.get(what.__module__) if defined else None


def of_code(code: Code, name: str) -> Any:
    """A class or a function of a file, which is run unless it was; for another process."""
    module = sys.modules.get(_module_name(code)) or _run(code)
    return attrgetter(name)(module)


def _made(code: Code, name: str, kind: type[Effect]) -> Effect:
    """The effect of a class, which remembers where it came from."""
    path = code.path
    try:
        effect = kind()
    except Exception as error:
        raise InputError(f"{path}: {name}() fails: {type(error).__name__}: {error}") from error
    if not isinstance(getattr(effect, "name", None), str) or not effect.name.isidentifier():
        raise InputError(f"{path}: {name} needs a name: letters, digits and _")
    if not isinstance(getattr(effect, "site", None), Site):
        raise InputError(f"{path}: {name} needs a site, one of calib.effects.Site")
    effect.origin = {"python": str(path), "name": name, "sha256": code.sha256}
    return effect
