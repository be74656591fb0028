"""The xacro library, confined: no Python, no environment, and no files but the robot's own.

xacro evaluates Python, reads whatever file a document names, puts in what the environment holds,
and expands macros without end. While it is confined none of that is possible.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom

from chains.errors import InputError
from chains.readers.expressions import LONGEST_VALUE, evaluate
from chains.xml import parse_xml

MOST_ELEMENTS = 20_000  # that are looked at: 3 s; writing out a Husky with its arm takes 700
LARGEST_FILE = 10_000_000  # bytes of one file
LARGEST_ROBOT_YAML = 1_000_000  # bytes, as a robot's own YAML is a few pages and slow to read
_ALIAS = re.compile(r"(?m)(^|[\s\[{,:-])[&*][^\s\]},]")
_WANTED = "a xacro file"


def read_document(path: Path) -> minidom.Document:
    """A xacro document as minidom has it.

    Raises:
        InputError: it cannot be read, is too large or no XML, or has a DOCTYPE.
    """
    try:
        if not path.is_file():
            raise InputError(f"{path} is no file; {_WANTED} is wanted")
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(
                f"{path} has more than {LARGEST_FILE / 1e6:.0f} MB; no robot's file has"
            )
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); name a file") from None
    return parse_document(text, path)


def parse_document(text: str | bytes, where: object) -> minidom.Document:
    """The same of its text; `where` is its file, for messages."""
    parse_xml(text, where, _WANTED)
    return minidom.parseString(text)


@dataclass(frozen=True)
class _Guard:
    """What stands in for the parts of xacro that reach beyond the document.

    Args:
        xacro: the library's module.
        own: the folders of the file and of its package.
        packages: gives the folders of packages that were found.
        read_yaml: xacro's own reader of YAML.
    """

    xacro: Any
    own: Sequence[Path]
    packages: Callable[[], Iterable[str]]
    read_yaml: Callable[[str], Any]

    def named(self, name: str) -> str:
        """The path of a name in a file: relative ones begin in that file's folder."""
        here = os.path.dirname(self.xacro.filestack[-1] or "") if self.xacro.filestack else ""
        return os.path.join(here or self.own[0], name)

    def allowed(self, name: Any) -> Path:
        """The file or folder of that name; ValueError where it is none of the robot's."""
        path = Path(self.named(str(name))).resolve()
        folders = (*self.own, *map(Path, self.packages()))
        if not any(path.is_relative_to(folder) for folder in folders):
            raise ValueError(f"{name} is outside of the robot's packages; --package names one")
        return path

    def included(self, spec: str, symbols: Any) -> Iterator[str]:
        """The files that an include names, which may be a pattern."""
        path = self.named(str(self.xacro.eval_text(spec, symbols)))
        found = [path]
        if re.search(r"[*?\[]", path):
            folder = self.allowed(os.path.dirname(path))
            found = [str(file) for file in sorted(folder.glob(os.path.basename(path)))]
        for file in found:
            yield str(self.allowed(file))

    def parse(self, text: Any, name: str | None = None) -> minidom.Document:
        """A document, from its text or its file."""
        if text is None:
            file = self.allowed(name)
            if not file.exists():
                self.xacro.filestack.pop()
                missing = FileNotFoundError(2, "No such file or directory", str(file))
                raise self.xacro.XacroException(f"{missing.strerror}: {file}", exc=missing)
            return read_document(file)
        return parse_document(text, "the document") if isinstance(text, str | bytes) else text

    def load_yaml(self, name: Any) -> Any:
        """The data of a YAML file of the robot."""
        file = self.allowed(name)
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        if len(text) > LARGEST_ROBOT_YAML or _ALIAS.search(text):
            raise ValueError(f"{name} is too large, or has aliases, which are not read here")
        return self.read_yaml(str(file))


def _no_environment(resolved: str, a: str, args: list[str], context: object) -> str:
    raise ValueError(f"$({a}) asks for the environment, which is not read; write the value there")


def _counted(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, until it was called as often as no robot needs."""
    calls = itertools.count()

    def counted(*arguments: Any) -> Any:
        if next(calls) > MOST_ELEMENTS:
            raise ValueError(f"its macros make more than {MOST_ELEMENTS} elements")
        return function(*arguments)

    return counted


def _short(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, of texts that are no longer than a robot needs."""

    def short(*arguments: Any) -> Any:
        value = function(*arguments)
        if isinstance(value, str) and len(value) > LONGEST_VALUE:
            raise ValueError(f"a text has more than {LONGEST_VALUE} characters")
        return value

    return short


def _with(symbols: Mapping[str, Any], **given: Any) -> dict[str, Any]:
    """xacro's names with some replaced, wherever they stand."""
    made = {}
    for name, value in symbols.items():
        if isinstance(value, dict) and value.keys() & given:
            value = type(value)()
            value.update(symbols[name])
            value.update({key: new for key, new in given.items() if key in symbols[name]})
        made[name] = given.get(name, value)
    return made


@contextmanager
def _replaced(module: Any, **given: Any) -> Iterator[None]:
    """Other values for some names of a module."""
    kept = {name: getattr(module, name) for name in given}
    try:
        vars(module).update(given)
        yield
    finally:
        vars(module).update(kept)


@contextmanager
def confined(path: Path, packages: Callable[[], Iterable[str]]) -> Iterator[None]:
    """Where xacro can do nothing but what a robot's file needs.

    Args:
        path: the file that is written out.
        packages: gives the folders of the packages that were found, whose files may be read beside
            those of the file's own folder and package.
    """
    import xacro
    from xacro import substitution_args

    own = [path.parent.resolve()]
    own += [p for p in path.resolve().parents if (p / "package.xml").is_file()][:1]
    guard = _Guard(xacro=xacro, own=own, packages=packages, read_yaml=xacro.load_yaml)
    symbols = _with(xacro._global_symbols, load_yaml=guard.load_yaml, abs_filename=guard.named)
    with (
        _replaced(
            xacro,
            filestack=[None],
            macrostack=[],
            _global_symbols=symbols,
            safe_eval=evaluate,
            abs_filename_spec=guard.named,
            load_yaml=guard.load_yaml,
            get_include_files=guard.included,
            parse=guard.parse,
            eval_all=_counted(xacro.eval_all),
            eval_text=_short(xacro.eval_text),
        ),
        _replaced(
            substitution_args,
            _env=_no_environment,
            _optenv=lambda resolved, a, args, _: resolved.replace(f"$({a})", " ".join(args[1:])),
            _eval=lambda text, context: str(evaluate(text, context.get("arg", {}))),
        ),
    ):
        yield
