"""Documents: what YAML 1.2 says is read, what is wrong is named, what is written is whole."""

import json
from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.documents import (
    Document,
    Number,
    Triple,
    json_text,
    read_yaml,
    validate,
    write_atomically,
    write_json,
    write_yaml,
)
from sensors.numbers import read_csv


class Leaf(Document):
    size: Number
    xyz: Triple = (0, 0, 0)


class Tree(Document):
    name: str
    leaf: Leaf | None = None
    leaves: dict[str, Leaf] = {}  # noqa: RUF012


@pytest.fixture
def write(tmp_path):
    """A function that writes text to a file and returns its path."""

    def write_text(text, name="tree.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write_text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("1.5E+2", 150.0),
        (".5", 0.5),
        ("-2.", -2.0),
        ("-.inf", -np.inf),
        ("012", 12),
        ("-7", -7),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("0x1F", "0x1F"),
        ("2026-11-21", "2026-11-21"),
        ("on", "on"),
        ("no", "no"),
        ("true", True),
        ("False", False),
        ("~", None),
        ("", None),
        ("'1e-3'", "1e-3"),
    ],
)
def test_scalars_are_those_of_yaml_1_2(write, text, value):
    data, _ = read_yaml(write(f"a: {text}\n"))
    assert data["a"] == value and type(data["a"]) is type(value)


def test_nan_is_read(write):
    assert np.isnan(read_yaml(write("a: .nan\n"))[0]["a"])


def test_a_key_that_stands_twice_is_named_with_its_line(write):
    with pytest.raises(InputError, match=r"tree\.yaml:4: key b stands here twice"):
        read_yaml(write("a:\n  b: 1\n  c: 2\n  b: 3\n"))


def test_what_is_no_yaml_is_named_with_its_line(write):
    with pytest.raises(InputError, match=r"tree\.yaml:2"):
        read_yaml(write("a: [1, 2\nb: 3\n"))


def test_what_is_not_there_or_no_text_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml does not exist"):
        read_yaml(tmp_path / "none.yaml")
    (tmp_path / "blob.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"blob\.yaml is not UTF-8 text"):
        read_yaml(tmp_path / "blob.yaml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name: a\nleaf:\n  sise: 1\n", r":3: unknown key leaf\.sise; did you mean size\?$"),
        (
            "name: a\nleaves:\n  b: {sise: 1}\n",
            r":3: unknown key leaves\.b\.sise; did you mean size",
        ),
        ("name: a\nqqqq: 1\n", r":2: unknown key qqqq; known are name, leaf, leaves$"),
        ("name: a\nleaf:\n  xyz: 1\n", r":2: leaf\.size is missing$"),
        ("leaf: {size: 1}\n", r"tree\.yaml: name is missing$"),
        ("", r"tree\.yaml: name is missing$"),
        ("- 1\n", r"tree\.yaml: the document should be a mapping"),
        ("name: a\nleaf: 3\n", r":2: leaf should be a mapping"),
        ("name: a\nleaf:\n  size: '1'\n", r":3: leaf\.size: .*valid number, not '1'$"),
        ("name: a\nleaf:\n  size: true\n", r":3: leaf\.size: .*number, not True$"),
        ("name: a\nleaf:\n  size: .nan\n", r":3: leaf\.size: .*finite"),
        ("name: a\nleaf:\n  size: 1\n  xyz: [1, 2, x]\n", r":4: leaf\.xyz\.2: .*number, not 'x'$"),
        ("name: a\nleaf:\n  size: 1\n  xyz: [1, 2]\n", r":4: leaf\.xyz\.2 is missing$"),
    ],
)
def test_every_complaint_has_file_line_and_key(write, text, sentence):
    path = write(text)
    with pytest.raises(InputError, match=sentence) as error:
        validate(Tree, *_swap(read_yaml(path), path))
    assert "\n" not in str(error.value)


def _swap(read, path):
    data, marks = read
    return data, path, marks


def test_one_number_stands_for_three(write):
    path = write("name: a\nleaf: {size: 1, xyz: 2}\n")
    assert validate(Tree, *_swap(read_yaml(path), path)).leaf.xyz == (2, 2, 2)


def test_what_is_written_is_read_back(tmp_path):
    data = {
        "float": np.float64(1e-9),
        "int": np.int64(3),
        "list": np.array([0.1, -2e-7, 1e22]),
        "texts": ["1e-3", "on", "012", "1:30", "null", "", "a: b", "é"],
        "deep": [{"a": (1, 2)}, {"b": tmp_path}],
        "nothing": None,
    }
    write_yaml(tmp_path / "a.yaml", data)
    back, _ = read_yaml(tmp_path / "a.yaml")
    assert back["float"] == 1e-9 and back["int"] == 3 and back["list"] == [0.1, -2e-7, 1e22]
    assert back["texts"] == data["texts"] and back["nothing"] is None
    assert back["deep"] == [{"a": [1, 2]}, {"b": str(tmp_path)}]
    assert "list: [0.1, -2.0e-07, 1.0e+22]" in (tmp_path / "a.yaml").read_text()


def test_names_that_are_no_utf_8_are_escaped():
    """As of a folder from another machine: JSON cannot hold what stands for such a byte."""
    text = json_text({"\udcff": [np.nan, np.float64(1.5), Path("a/\udcff")]})
    assert json.loads(text) == {"\udcff": [None, 1.5, "a/\udcff"]}
    text.encode("utf-8")


def test_json_has_null_where_a_number_is_not_finite(tmp_path):
    write_json(tmp_path / "a.json", {"a": [np.nan, 1.5, np.inf], "n": np.int64(2), "b": np.True_})
    assert json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail) == {
        "a": [None, 1.5, None],
        "n": 2,
        "b": True,
    }


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), write_atomically(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"] and path.read_text() == "old"
    with write_atomically(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == path.suffix
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"] and path.read_text() == "new"


def test_csv_columns_are_numbers_where_all_cells_are(write):
    path = write('\ufeffname,x, y ,stop\na,1,,007\n"b, c",-2e3,nan,8\n\n', "a.csv")
    columns = read_csv(path, text=("stop",))
    assert list(columns) == ["name", "x", "y", "stop"]
    assert columns["name"].tolist() == ["a", "b, c"] and columns["stop"].tolist() == ["007", "8"]
    np.testing.assert_array_equal(columns["x"], [1, -2000])
    np.testing.assert_array_equal(columns["y"], [np.nan, np.nan])


def test_csv_without_rows_has_empty_columns(write):
    assert {n: c.size for n, c in read_csv(write("a,b\n", "a.csv")).items()} == {"a": 0, "b": 0}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a,b\n1,2\n3\n", r"a\.csv:3: 1 cells where the header names 2 columns"),
        ("a,b\n1,2,3\n", r"a\.csv:2: 3 cells"),
        ("a,b,a\n1,2,3\n", r"a\.csv:1: every column needs its own name, and 'a'"),
        ("a,,b\n1,2,3\n", r"a\.csv:1: every column needs its own name, and ''"),
        ("a;b\n1;2\n", r"a\.csv:1: columns are separated by ';'"),
        ("a\tb\n1\t2\n", r"a\.csv:1: columns are separated by tabs here; .* commas"),
        ("", r"a\.csv: the file is empty"),
        (" \n\n", r"a\.csv: the file is empty"),
    ],
)
def test_csv_complaints_name_the_line(write, text, sentence):
    with pytest.raises(InputError, match=sentence):
        read_csv(write(text, "a.csv"))
