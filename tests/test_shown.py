"""Who holds pages against what is printed sees a stale figure, and no difference that is none."""

import pytest

from .shown import blocks, unlike

SAID = """verdict: an effect is missing
p = 3e-05; error  7.71 mm, of 46 known effects, 4 s
error 1.42 mm on 2024-05-02"""


@pytest.mark.parametrize(
    ("shown", "differs"),
    [
        ("p = 3e-05; error 7.71 mm", []),
        ("p = 2.5e-05;\nerror 7.70 mm,", []),
        ("p = 1e-05; error 7.69 mm,", ["1e-05 -> 3e-05", "7.69 -> 7.71"]),
        ("of 45 known effects", ["45 -> 46"]),
        ("known effects, 9 s", []),
        ("error 1.41 mm", []),
        ("mm on 2023-01-02", []),
        ("of many known effects", ["not printed: of many known effects"]),
    ],
)
def test_figures_agree_to_their_last_digit_and_whole_ones_wholly(shown, differs):
    assert unlike(shown, SAID) == differs


def test_blocks_are_of_their_language():
    assert blocks("text", "```text\na\n```\n```sh\nb\n```\n```text\nc\n```\n") == ["a\n", "c\n"]
