"""Which blunders are left out, where an effect explains as much as they do."""

from types import SimpleNamespace

import pytest

from calib.diagnosis.search import mishaps
from calib.residuals.groups import MESH, SCAN, Group


class ScriptedLook:
    """A look of which it is written what it finds, by how many blunders were left out."""

    converged = True

    def __init__(self, script, count=0):
        self.count, self.script = count, script
        estimate = SimpleNamespace(problem=None, values=None, converged=self.converged)
        self.stand = SimpleNamespace(estimate=estimate, without=self.without)
        self.checked, self.blunders = set(), []
        self.wild, self.outdone, self.quiet = script[count]

    def without(self, groups, progress):
        after = type(self)(self.script, self.count + len(groups))
        return SimpleNamespace(look=lambda progress: after)


@pytest.fixture
def left_out(monkeypatch):
    """How many blunders are left out, by a script of looks: those to leave out, whether an effect
    outdoes them, and whether nothing stands out."""
    monkeypatch.setattr(mishaps, "stray_scans", lambda problem, values, checked: [])
    monkeypatch.setattr(mishaps, "_wild", lambda look: look.wild)
    monkeypatch.setattr(mishaps, "_outdone", lambda look, by: look.outdone)
    monkeypatch.setattr(mishaps, "_quiet", lambda look: look.quiet)

    def run(*script):
        left = []
        look = mishaps.adapted(
            ScriptedLook(script), left, lambda what, done, total: None, named=False
        )
        assert look.count == len(left), "the look is that of what was left out"
        return len(left)

    return run


PART = Group("surface", MESH, "surface_4")
ONE = [SimpleNamespace(group=PART, evidence=9.0)]
QUIET = ([], False, True)


def test_a_blunder_that_leads_is_left_out(left_out):
    assert left_out((ONE, False, False), QUIET) == 1


def test_one_that_an_effect_outdoes_is_left_out_if_nothing_stands_out_after(left_out):
    assert left_out((ONE, True, False), QUIET) == 1


def test_two_that_look_like_an_effect_together_are_left_out_together(left_out):
    assert left_out((ONE, True, False), (ONE, False, False), QUIET) == 2


def test_none_is_left_out_where_the_effect_still_outdoes_the_next(left_out):
    assert left_out((ONE, True, False), (ONE, True, False), QUIET) == 0


def test_none_is_left_out_where_something_stands_out_after_all(left_out):
    assert left_out((ONE, True, False), (ONE, False, False), ([], False, False)) == 0


def test_what_leads_stays_left_out_when_a_trial_after_it_fails(left_out):
    looks = (ONE, False, False), (ONE, True, False), (ONE, True, False), QUIET
    assert left_out(*looks) == 1


def test_a_fit_without_optimum_is_mended_in_two_rounds_or_not_at_all(left_out, monkeypatch):
    looks = [(ONE, False, False)] * 5 + [QUIET]
    assert left_out(*looks) == 5
    monkeypatch.setattr(ScriptedLook, "converged", False)
    assert left_out(*looks) == mishaps.MENDED == 2


@pytest.mark.parametrize("innocent", [True, False])
def test_parts_of_the_mesh_that_a_scan_made_stand_out_are_kept(innocent):
    """Where the part stands out no more once the scan is left out, it is none of those left out."""
    scan = Group("scan", "L00P01", SCAN)
    before, part, wrong = (
        SimpleNamespace(blunder=SimpleNamespace(group=g, found=True)) for g in (PART, PART, scan)
    )
    after = SimpleNamespace(blunders=[] if innocent else [part.blunder])

    def without(groups, progress):
        assert groups == [scan]
        stand = SimpleNamespace(estimate=SimpleNamespace(converged=True))
        stand.look = lambda progress: after
        return stand

    first = SimpleNamespace(stand=SimpleNamespace(without=without))
    left, last = [before, part, wrong], object()
    found = mishaps._blamed_on_others(first, last, left, 1, lambda what, done, total: None)
    assert found is (after if innocent else last)
    assert left == ([before, wrong] if innocent else [before, part, wrong])
