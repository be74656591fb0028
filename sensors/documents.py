"""The documents people write and read: YAML, JSON, text.

Reading is strict, and every complaint names the file, the line and what would be right. Writing is
all or nothing: a file appears whole, under its own name, or not at all. This is the yaml door.
"""

import json
import os
import re
import stat
import sys
import typing
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pydantic
import yaml
from pydantic_core import PydanticSerializationError, to_json
from yaml import composer, constructor, resolver

from chains import escape
from chains.errors import InputError, nearest

LARGEST_TEXT = 500_000_000  # bytes: a log of a million rows has 200 MB
LARGEST_YAML = 10_000_000  # bytes: read at about 150 kB a second; no calibration has 1 MB
DEEPEST_YAML = 50  # lists and mappings within each other; a run's files have 6
LONGEST_WHOLE = 300  # digits; a float holds 308
FEW_NODES = 10_000  # values that aliases may always stand for

Marks = dict[tuple[str | int, ...], int]
"""Line (from 1) of every key and item of a YAML document, by its path in the data."""

Number = Annotated[float, pydantic.Strict()]
"""A number, never a quoted one and never a boolean."""

Triple = Annotated[
    tuple[Number, Number, Number],
    pydantic.BeforeValidator(lambda v: (v, v, v) if isinstance(v, int | float) else v),
]
"""Three numbers, or one that stands for all three."""


class Document(pydantic.BaseModel):
    """A mapping in a document: frozen, finite numbers only, unknown keys refused."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Document)


# ---------------------------------------------------------------------------------------- reading


class _StrictLoader(yaml.SafeLoader):
    """YAML 1.2 scalars: 1e-3 is a number, 012 is twelve, `on` and `1:30` are text.

    Nothing is nested deeper than people write, and no other tags are read.
    """

    yaml_implicit_resolvers: typing.ClassVar[dict] = {}
    yaml_constructors: typing.ClassVar[dict] = {
        tag: construct
        for tag, construct in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in ("str", "seq", "map")
    }
    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        self._depth += 1
        if self._depth > DEEPEST_YAML:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem=f"nested more than {DEEPEST_YAML} deep", problem_mark=mark
            )
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key.value} stands here twice; keep one of them",
                    problem_mark=key.start_mark,
                )
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def _whole(text: str) -> int:
    """A whole number that a float can hold; ValueError of one that is longer."""
    if len(text) > LONGEST_WHOLE:
        raise ValueError(f"a whole number of {len(text)} digits")
    return int(text)


_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.inf$|\.nan$")
for _tag, _pattern, _first, _construct in (
    ("null", re.compile(r"~$|null$|Null$|NULL$|$"), ["~", "n", "N", ""], lambda text: None),
    (
        "bool",
        re.compile(r"(true|True|TRUE|false|False|FALSE)$"),
        list("tTfF"),
        lambda text: text.lower() == "true",
    ),
    ("int", re.compile(r"[-+]?[0-9]+$"), list("-+0123456789"), lambda text: _whole(text)),
    ("float", _FLOAT, list("-+.0123456789"), lambda t: float(re.sub(r"\.(inf|nan)", r"\1", t))),
    ("merge", re.compile(r"<<$"), ["<"], None),
):
    _StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, _first)
    if _construct:
        _StrictLoader.add_constructor(
            f"tag:yaml.org,2002:{_tag}",
            lambda loader, node, construct=_construct: construct(loader.construct_scalar(node)),
        )


_FastLoader = _StrictLoader
if yaml.__with_libyaml__:

    class _FastLoader(yaml.cyaml.CParser, _StrictLoader):  # libyaml's, five times as fast
        get_single_node = _StrictLoader.get_single_node

        def __init__(self, text: str) -> None:
            super().__init__(text)
            for part in (composer.Composer, constructor.SafeConstructor, resolver.Resolver):
                part.__init__(self)


_FAULTS = (yaml.YAMLError, ValueError, TypeError, RecursionError)


def read_yaml(path: str | Path) -> tuple[Any, Marks]:
    """Read one YAML document, with the line of every key for later complaints.

    Raises InputError where the file is missing, is no YAML, has a key twice in one mapping, or
    would take far more memory than its size: by its aliases, its depth, or its length.
    """
    text = read_text(path, LARGEST_YAML)
    with suppress(*_FAULTS):  # what is wrong is said in PyYAML's own words, below
        return _parsed(path, text, _FastLoader)
    try:
        return _parsed(path, text, _StrictLoader)
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{path}{line}: {error.problem}") from None
    except InputError:
        raise
    except _FAULTS as error:
        raise InputError(f"{path} is not YAML text: {str(error).splitlines()[0]}") from None


def _parsed(path: str | Path, text: str, kind: type[_StrictLoader]) -> tuple[Any, Marks]:
    loader = kind(text)
    try:
        node = loader.get_single_node()
        _refuse_aliases(path, node, len(text))
        data = loader.construct_document(node) if node else None
        return data, dict(_lines(node, ()))
    finally:
        loader.dispose()


def _refuse_aliases(path: str | Path, node: yaml.Node | None, length: int) -> None:
    """Raise InputError where aliases make more of a document than its text could hold without."""
    sizes: dict[int, int] = {}

    def size(node: yaml.Node) -> int:
        if id(node) not in sizes:
            sizes[id(node)] = sys.maxsize  # of one that holds itself
            parts = getattr(node, "value", ()) if not isinstance(node, yaml.ScalarNode) else ()
            pairs = isinstance(node, yaml.MappingNode)
            inner = (each for part in parts for each in (part if pairs else (part,)))
            sizes[id(node)] = 1 + sum(map(size, inner))
        return sizes[id(node)]

    if node is not None and size(node) > max(length, FEW_NODES):
        raise InputError(
            f"{path}: its aliases (*name) stand for more than {max(length, FEW_NODES)} values; "
            f"write out what is meant"
        )


def _lines(node: yaml.Node | None, path: tuple) -> Iterator[tuple[tuple, int]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield (*path, key.value), key.start_mark.line + 1
            yield from _lines(value, (*path, key.value))
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            yield (*path, i), value.start_mark.line + 1
            yield from _lines(value, (*path, i))


def read_json(path: str | Path) -> Any:
    """Read a JSON document; InputError where the file is missing or is none."""
    return parse_json(read_text(path), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """The data of a JSON text; InputError, which names `where` it stands, where it is none."""
    try:
        return json.loads(text, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        why = "nested too deep" if isinstance(error, RecursionError) else error
        raise InputError(f"{where} is no JSON: {why}") from None


def read_text(path: str | Path, largest: int = LARGEST_TEXT) -> str:
    """Read a UTF-8 text file; InputError names the file that is missing, is no text, or has more
    bytes than `largest`."""
    try:
        facts = os.stat(path)
        if not stat.S_ISREG(facts.st_mode):
            raise InputError(f"{path} cannot be read: it is no file")
        if (size := facts.st_size) > largest:
            most = f"at most {largest / 1e6:.0f} MB of such a file are read"
            raise InputError(f"{path} has {size / 1e6:.0f} MB; {most}")
        text = Path(path).read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise InputError(f"{path} is not UTF-8 text: it holds bytes of 0")
        return text
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text") from None


# ------------------------------------------------------------------------------------- validating


@dataclass(frozen=True)
class Format:
    """The format numbers of a kind of folder: which of them this version reads.

    Args:
        kind: what the folder is called.
        newest: the number that this version writes, and the newest that it reads.
        former: numbers that it reads no longer -> the last version of rigcal that does.
    """

    kind: str
    newest: int
    former: Mapping[int, str] = field(default_factory=dict)

    def check(self, document: Any, path: str | Path, written_by: str = "") -> None:
        """Raise InputError for a document of a format that is not read.

        Args:
            document: its data, with the number under ``format``; without one it is of format 1.
            path: where it stands.
            written_by: the version of rigcal that wrote it, where that is known.
        """
        found = document.get("format", 1) if isinstance(document, Mapping) else 1
        if type(found) is not int or found < 1:
            raise InputError(f"{path}: format: a whole number from 1 is wanted, not {found!r}")
        if found in self.former:
            raise InputError(
                f"{path}: this {self.kind} is of format {found}, which is read by rigcal "
                f"{self.former[found]} and earlier; open it with that version"
            )
        if found > self.newest:
            wanted = f"rigcal {written_by}, which wrote it" if written_by else "a newer rigcal"
            raise InputError(
                f"{path}: this {self.kind} is of format {found}, and this version of rigcal reads "
                f"formats up to {self.newest}; open it with {wanted}"
            )


def validate(model: type[Model], data: Any, path: str | Path, marks: Marks) -> Model:
    """Turn a document's data into `model`.

    The first thing wrong is raised as InputError, one sentence with file, line and key; an unknown
    key comes first, with the nearest known one, because it explains the key that is missing.
    """
    try:
        return model.model_validate(data if data is not None else {})
    except pydantic.ValidationError as error:
        problems = sorted(error.errors(), key=lambda p: p["type"] != "extra_forbidden")
        raise InputError(_sentence(problems[0], model, path, marks)) from None


def _sentence(problem: dict, model: type, path: str | Path, marks: Marks) -> str:
    loc = problem["loc"]
    known_part = next((loc[:n] for n in range(len(loc), 0, -1) if loc[:n] in marks), ())
    where = f"{path}:{marks[known_part]}" if known_part else str(path)
    key = ".".join(map(str, loc))
    if problem["type"] == "extra_forbidden":
        return f"{where}: unknown key {key}{nearest(str(loc[-1]), _keys(model, loc[:-1]))}"
    if problem["type"] == "missing":
        return f"{where}: {key} is missing"
    if problem["type"] == "model_type":
        return f"{where}: {key or 'the document'} should be a mapping of keys to values"
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "value_error":
        return f"{where}: {key + ': ' if key else ''}{message}"
    return f"{where}: {key}: {message[0].lower()}{message[1:]}, not {problem['input']!r}"


def _keys(model: Any, loc: tuple) -> list[str]:
    """Names of the fields that the model has at a place in the document."""
    for step in loc:
        if isinstance(model, type) and issubclass(model, pydantic.BaseModel):
            field = model.model_fields.get(str(step))
            model = field.annotation if field else None
        else:
            model = typing.get_args(model)[-1]
        options = [a for a in typing.get_args(model) if a is not type(None)]
        if options and typing.get_origin(model) is not dict:
            model = options[0]
    return list(model.model_fields) if hasattr(model, "model_fields") else []


# ---------------------------------------------------------------------------------------- writing


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to, moved into place when all went well."""
    path = Path(path)
    _make_folder(path.parent, path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _make_folder(folder: Path, wanted: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{wanted} cannot be written ({error.strerror}); give another") from None


class _Dumper(yaml.SafeDumper):
    """Quotes every text that either YAML 1.1 or 1.2 would take for something else."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def write_yaml(path: str | Path, data: Any, head: Iterable[str] = ()) -> None:
    """Write a YAML document as `yaml_text` gives it, below the lines of `head` as comments; whole
    or not at all."""
    comments = "".join(f"# {escape.line(line)}\n" for line in head)
    with write_atomically(path) as temporary:
        temporary.write_text(comments + yaml_text(data), encoding="utf-8")


def yaml_text(data: Any) -> str:
    """The data as a YAML document: numpy values as plain numbers, lists of numbers on one line."""
    return yaml.dump(
        plain(data), None, _Dumper, sort_keys=False, allow_unicode=True, width=1000,
        default_flow_style=None,
    )  # fmt: skip


def write_json(path: str | Path, data: Any) -> None:
    """Write a JSON document; a number that is not finite becomes null, as JSON has none."""
    with write_atomically(path) as temporary:
        temporary.write_text(json_text(data) + "\n", encoding="utf-8")


def json_text(data: Any) -> str:
    """The data as a JSON document; a number that is not finite becomes null."""
    try:
        text = to_json(data, indent=1, inf_nan_mode="null", fallback=plain).decode("utf-8")
    except PydanticSerializationError:  # names of files that are no UTF-8
        finite = json.loads(json.dumps(plain(data)), parse_constant=lambda _: None)
        text = json.dumps(finite, indent=1, ensure_ascii=False)
    return escape.json(text)


def plain(data: Any) -> Any:
    """Turn numpy values, tuples and paths, however deep, into plain Python."""
    if isinstance(data, Mapping):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, np.ndarray | np.generic):
        return data.tolist()
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    return str(data) if isinstance(data, Path) else data
