"""The notebooks of docs/: each runs from its first cell to its last, and shows what it says."""

import nbformat
import pytest
from nbclient import NotebookClient

from .programs import ROOT

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
SHOWN = {  # what the outputs of each hold, beside figures
    "factor_graph": ["factors over", "sigmas after, mm"],
    "first_calibration": ["run: held-out error: ", "sigmas</th>"],
    "residuals": ["incidence_rad", "mount_markers"],
    "what_is_missing": [
        "verdict: an effect is missing",
        "verdict: the model is adequate",
        "ring_range_offset differs by",
    ],
    "your_own_effect": ["humid_air is missing", "<td>amount</td>"],
}


def test_every_notebook_is_known_and_kept_without_outputs():
    assert {path.stem for path in NOTEBOOKS} == set(SHOWN)
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert cells and not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs_and_shows_what_it_says(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert not [o for o in outputs if o.output_type == "error"]
    shown = "\n".join(
        text
        for output in outputs
        for text in (output.get("text", ""), output.get("data", {}).get("text/html", ""))
    )
    assert all(words in shown for words in SHOWN[path.stem])
    assert "\x1b" not in shown and "Open3D" not in shown
    figures = [cell for cell in notebook.cells if ".plot(" in cell.source]
    for cell in figures:
        assert "image/png" in cell.outputs[-1].get("data", {})
