"""How Sphinx makes the site of these pages: ``make docs``."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from calib.effects import CATALOGUE, Effect  # noqa: E402
from calib.report import plots  # noqa: E402
from calib.report.effects import effect_figure, example_rig  # noqa: E402
from calib.rig import Rig  # noqa: E402
from calib.show.tables import effect_page  # noqa: E402

project, author, copyright = "rigcal", "the rigcal authors", "the rigcal authors"
# githubpages: .nojekyll, without which Pages leaves out folders that begin with _.
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.githubpages", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "rigcal"
html_copy_source = False
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3
nb_execution_mode = "cache"  # notebooks are run, again only where they have changed
nb_execution_timeout = 600
nb_execution_in_temp = True
nb_execution_raise_on_error = True
autodoc_typehints = "none"
autodoc_preserve_defaults = True
# Pages link to files beside the site, as they do where the repository shows them.
suppress_warnings = ["myst.xref_missing"]

SITES = {
    "beam": "The LiDAR's beams",
    "arm": "The arm",
    "base": "What carries the arm",
    "mount": "The mount",
    "tracker": "The tracker",
    "target": "The targets",
    "reference": "The room's scan",
    "noise": "The scatter of ranges",
}
ROWS = ("formula", "shape", "unit", "typical", "covariates", "confounded_with", "source")


def write_catalogue() -> None:
    """A page for every effect, and their list by where they act; of the effects themselves."""
    folder = HERE / "catalogue"
    folder.mkdir(exist_ok=True)
    sites: dict[str, list[str]] = {}
    rig = example_rig()
    for effect in CATALOGUE:
        page = effect_page(effect)
        sites.setdefault(page["site"], []).append(page["name"])
        _write(folder / f"{page['name']}.md", _effect(page) + _picture(effect, rig, folder))
    lines = ["# The catalogue", "", "Every effect that rigcal tests, by where it acts.", ""]
    for site, names in sites.items():
        lines += [f"## {SITES.get(site, site.capitalize())}", "", "```{toctree}"]
        lines += [":maxdepth: 1", "", *names, "```", ""]
    _write(folder / "index.md", "\n".join(lines))


def _effect(page: dict) -> str:
    rows = []
    for key in ROWS:
        value = page[key]
        if key == "confounded_with":
            value = ", ".join(f"[{name}]({name}.md)" for name in value)
        elif key == "covariates":
            value = ", ".join(f"`{name}`" for name in value)
        elif key == "formula":
            value = f"`{value}`"
        if value:
            rows.append(f"{key.replace('_', ' ').capitalize()}\n: {value}\n")
    return "\n".join([f"# {page['name']}", "", page["what"], "", page["notes"], "", *rows])


def _picture(effect: Effect, rig: Rig, folder: Path) -> str:
    """The picture of what an effect does, and the line that shows it; of some there is none."""
    figure = effect_figure(effect, rig)
    if figure is None:
        return ""
    _write(folder / f"{effect.name}.svg", plots.svg(figure, effect.name))
    return (
        "\nWhat it does, each parameter at the sigma of its prior, and of several shapes one; "
        "where every ring, material or stop has a parameter, a draw from their priors:"
        f"\n\n![What {effect.name} does]({effect.name}.svg)\n"
    )


def _write(path: Path, text: str) -> None:
    """A page, unless it is there as it should be: Sphinx builds anew what is newer."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


write_catalogue()
