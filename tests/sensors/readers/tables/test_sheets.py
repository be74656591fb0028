"""Tables as other programs write them: separators, decimal commas, encodings, what is broken."""

import numpy as np
import pytest

from chains.errors import InputError
from sensors.readers.tables.sheets import open_sheet, seconds, split_unit

ROWS = [[0.5, -1.25e-3, 3.0], [1.5, 2.0, -4.75]]


def text(separator, comma, head="a,b,c"):
    lines = [separator.join(map(repr, row)) for row in ROWS]
    if comma:
        lines = [line.replace(".", ",") for line in lines]
    return "\n".join([head.replace(",", separator), *lines, ""])


@pytest.mark.parametrize(
    ("separator", "comma"), [(",", False), (";", True), (";", False), ("\t", True), (" ", False)]
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_numbers_are_those_written(tmp_path, separator, comma, encoding):
    path = tmp_path / "t.csv"
    path.write_text(text(separator, comma), encoding=encoding)
    sheet, _ = open_sheet(path)
    values, odd = sheet.numbers([2, 0], skip=1)
    assert odd == ()
    np.testing.assert_array_equal(values, np.array(ROWS)[:, [2, 0]])


def test_cells_such_as_spreadsheets_leave_are_read(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("a;b\n1,7453299999999998;2,02011E+13\n;-3\n")
    values, _ = open_sheet(path)[0].numbers([0, 1], skip=1)
    np.testing.assert_array_equal(values, [[1.7453299999999998, 2.02011e13], [np.nan, -3]])


def test_comments_windows_lines_zeros_and_latin_names(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes("# größe\r\na,b\r\n\r\n1,2\0\r\n3,4\0".encode("latin-1"))
    sheet, _ = open_sheet(path)
    np.testing.assert_array_equal(sheet.numbers([0, 1], skip=2)[0], [[1, 2], [3, 4]])


def test_a_last_line_that_breaks_off_is_left_out_and_said(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("a,b\n1,2\n3")
    values, odd = open_sheet(path)[0].numbers([0, 1], skip=1)
    assert values.tolist() == [[1, 2]] and "line 3" in odd[0]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"\n \n", "is empty"),
        (bytes(range(256)) * 40, "not a text file"),
        (b"a,b\n1,2\n3\n5,6\n", ":3: cells are missing"),
        (b"a,b\n1,2\n3,x\n", ":3: could not convert"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, content, said):
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        open_sheet(path)[0].numbers([0, 1], skip=1)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("x [mm]", "x", "mm"),
        ("x(m)", "x", "m"),
        ("q1_deg", "q1", "deg"),
        ("timestamp [ns]", "timestamp", "ns"),
        ("temperature_c", "temperature_c", None),
        ("speed [rpm]", "speed [rpm]", None),
        ("arm", "arm", None),
    ],
)
def test_units_stand_in_headers(header, name, unit):
    assert split_unit(header) == (name, unit)


@pytest.mark.parametrize("factor", [1, 1e3, 1e6, 1e9])
def test_times_since_1970_are_told_by_their_size(factor):
    time_s = np.array([1.6e9, 1.6e9 + 0.5])
    np.testing.assert_allclose(seconds(time_s * factor, None)[0], time_s, atol=1e-6)


def test_stamps_that_are_dates():
    found, said = seconds(np.array([20200714163904.0, 20200714164004.0]), None)
    assert np.diff(found) == [60.0] and "dates" in said
