"""Text of strangers for each destination, held against what reads it there."""

import csv
import io
import json
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from chains import escape
from sensors.documents import json_text, read_yaml
from sensors.numbers import read_csv
from sensors.stops import write_columns

EVIL = [
    "<img src=x onerror=alert(1)>",
    '"><script>alert(1)</script>',
    "'-alert(1)-'",
    "\x1b]0;x\x07 \x9b31m \x7f",
    "a\nb\rc\x85d\u2028e\u2029f",
    "\u202egnp.exe \ud800",
    "[bold]red[/bold]",
    "-->",
    "--!>-",
    r"\input{x} \write18{id} %",
    "$(touch x) ${x} `id`",
    "plain_name 1.2 é 日本",
]


@pytest.mark.parametrize("text", EVIL)
def test_nothing_controls_a_terminal(text):
    said = escape.terminal(text)
    assert all(c.isprintable() or c == "\n" for c in said) and said.encode()
    line = escape.line(text)
    assert line.isprintable() and line.splitlines() == [line]
    assert escape.terminal(said) == said


def test_what_is_harmless_stays():
    for text in ("faro.z ± 0.3 mm → x", "Größe_1 (Ω)", "日本 語", "a-b.c:d/e"):
        assert escape.terminal(text) == escape.line(text) == escape.csv_cell(text) == text
    assert escape.identifier("residual-near-ir") == "residual-near-ir"


class _Parsed(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, attributes))

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("text", EVIL)
def test_html_and_xml_hold_it_as_text_and_as_a_value(text):
    parsed = _Parsed(f'<b title="{escape.html(text)}">{escape.html(text)}</b>')
    shown = escape.terminal(text)
    assert parsed.tags == [("b", [("title", shown)])] and parsed.text == shown
    xml = f"<a b={escape.xml_attribute(text)}><!-- {escape.xml_comment(text)} --></a>"
    root = ElementTree.fromstring(xml)
    assert root.attrib == {"b": escape.line(text)} and not len(root)


@pytest.mark.parametrize("text", EVIL)
def test_an_identifier_is_one(text):
    assert escape.identifier(text).replace("-", "").replace("_", "").isalnum()
    assert len({escape.identifier(each) for each in EVIL}) == len(EVIL)


@pytest.mark.parametrize("text", EVIL)
def test_json_is_the_same_and_prints(text):
    said = json_text({"name": text})
    assert json.loads(said) == {"name": text}
    assert all(c.isprintable() or c == "\n" for c in said)


def test_comments_stay_comments(tmp_path):
    from calib.exporters.written import commented

    (tmp_path / "x.yaml").write_text(commented(EVIL) + "a: 1\n")
    assert read_yaml(tmp_path / "x.yaml")[0] == {"a": 1}
    scope = {}
    exec(commented(EVIL) + "a = 1\n", scope)
    assert scope["a"] == 1


@pytest.mark.parametrize("text", EVIL)
def test_latex_has_no_command_of_its_own(text):
    said = escape.latex(text)
    known = (r"\textbackslash{}", r"\textasciitilde{}", r"\textasciicircum{}", r"$\pm$", r"$\to$")
    known += ("$<$", "$>$", "{[}", "{]}", "{*}", *(f"\\{c}" for c in "&%$#_{}"))
    for command in known:
        said = said.replace(command, "")
    assert not set(said) & set("\\%$#&_{}~^[]*")


@pytest.mark.parametrize("text", EVIL)
def test_markdown_has_one_cell_and_no_html(text):
    said = escape.markdown(text)
    assert "<" not in said and len(said.replace("\\|", "").split("|")) == 1


FORMULAS = ["=cmd|' /C calc'!A0", "+1+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", " =1", "=1\t"]


@pytest.mark.parametrize("text", FORMULAS)
def test_a_spreadsheet_runs_no_formula(text):
    assert escape.csv_cell(text)[0] not in "=+-@\t\r "


@pytest.mark.parametrize("number", ["-1", "-0.5", "+3", "-1e-9", "-inf", "-3.5E+2"])
def test_a_negative_number_stays_a_number(number):
    assert escape.csv_cell(number) == number


def test_tables_are_read_back_as_they_were(tmp_path):
    names = ["=cmd|' /C calc'!A0", "@x", "-j", "plain", "'quoted", "+1"]
    columns = {"stop": names, "=x": [-1.5, 2.0, float("nan"), -0.0, 1e-9, 3.0], "-joint": [1.0] * 6}
    write_columns(tmp_path / "stops.csv", columns)
    rows = list(csv.reader(io.StringIO((tmp_path / "stops.csv").read_text())))
    for row in rows:
        for cell in row:
            assert not cell.startswith(("=", "@", "-j", "-c")), cell
    assert rows[1][1] == "-1.5"
    read = read_csv(tmp_path / "stops.csv", {"stop"})
    assert list(read) == list(columns) and read["stop"].tolist() == names
    assert read["=x"][:2].tolist() == [-1.5, 2.0] and read["-joint"].tolist() == [1.0] * 6
