"""The notebooks of the guide run, cell by cell, from the folder that they lie in."""

import json

import conftest
import matplotlib
import pytest

matplotlib.use("Agg")

NOTEBOOKS = sorted((conftest.ROOT / "docs/notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, monkeypatch):
    import matplotlib.pyplot as plt

    monkeypatch.chdir(path.parent)
    notebook = json.loads(path.read_text(encoding="utf-8"))
    names = {"display": print}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells and all(not cell["outputs"] for cell in cells), "they are kept without outputs"
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"{path.name}, code cell {number}", "exec"), names)
    plt.close("all")


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= {"compressor", "game", "published", "ten_minutes", "two_sheets"}
