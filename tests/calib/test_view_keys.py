"""Keys of the workbench: N and P work wherever the focus is, unless text is being typed."""

from __future__ import annotations

import re

import pytest

from calib.runs.run import Run
from tests.calib.viewed import small_run
from tests.calib.workbench import button, choose, field, shown, until, value

pytestmark = pytest.mark.slow
# Two fields used and a key pressed, all before the browser has told of any.
AT_ONCE = """fields => {
  const write = (field, text) => {
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, text);
    field.dispatchEvent(new Event("input", {bubbles: true}));
  };
  write(fields[0], "ring > 2");
  write(fields[1], "10 to 90");
  const key = {key: "n", code: "KeyN", bubbles: true};
  document.body.dispatchEvent(new KeyboardEvent("keydown", key));
}"""

# A menu that is slow to close, and has the focus again, when an option was chosen.
SLOW = 'menu => { menu.focus(); menu.setAttribute("aria-expanded", "true"); }'


@pytest.fixture(scope="module")
def run(once) -> Run:
    return Run.open(once(small_run) / "run")


@pytest.mark.long
def test_keys_go_to_the_next_stop_wherever_the_focus_is(run):
    with shown(run.folder) as (watched, page):
        tab, stops = watched.page, list(page.picture.menu.stop.options)
        at = stops.index(page.picture.menu.stop.value)

        def goes(key: str, step: int) -> None:
            nonlocal at
            at = (at + step) % len(stops)
            tab.keyboard.press(key)
            tab.wait_for_url(re.compile(f"stop={stops[at]}&"))

        goes("n", 1)
        field(watched, "Keep scales").focus()
        goes("n", 1)
        button(watched, "Refit").focus()
        goes("p", -1)
        choose(watched, "Colour", "ring")
        goes("n", 1)
        menu = tab.get_by_label("Colour", exact=True)
        menu.evaluate(SLOW)
        goes("n", 1)
        menu.click()
        options = tab.get_by_role("option")
        options.first.wait_for()
        tab.keyboard.press("Escape")  # shut: no text is typed into it
        options.first.wait_for(state="hidden")
        goes("p", -1)
        menu.fill("")
        tab.keyboard.type("n")  # searches the options that are shown
        until(watched, lambda: "range, m" in options.all_inner_texts())
        until(watched, lambda: "label" in options.all_inner_texts(), False)
        until(watched, menu.input_value, "n")
        tab.keyboard.press("Escape")
        assert page.picture.menu.stop.value == stops[at]


@pytest.mark.long
def test_letters_go_into_the_field_that_is_being_written(run):
    with shown(run.folder) as (watched, page):
        tab = watched.page
        box = field(watched, "Only where")
        box.click()
        tab.keyboard.type("ring > -1")
        assert value(watched, "Only where") == "ring > -1"
        tab.wait_for_url(re.compile("only=ring"))
        assert page.picture.menu.stop.value == "L00P00"
        tab.keyboard.press("Enter")  # what was written is done
        tab.keyboard.press("n")
        tab.wait_for_url(re.compile("stop=L00P01&"))
        assert value(watched, "Only where") == "ring > -1"


@pytest.mark.long
def test_a_key_comes_after_what_was_used_before_it(run):
    """Also where the page tells of that later than it would of the key."""
    with shown(run.folder) as (watched, page):
        panel, submit, told = page.picture.panel, page._worker.submit, []

        def arrived(*what: object) -> object:
            told.append((panel.only.value, panel.light.value))
            return submit(*what)

        page._worker.submit = arrived
        fields = [field(watched, each).element_handle() for each in ("Only where", "Light up")]
        watched.page.evaluate(AT_ONCE, fields)
        watched.page.wait_for_url(re.compile("stop=L00P01&.*only=ring.*lit=10"))
        assert told == [("ring > 2", ""), *[("ring > 2", "10 to 90")] * 2]
