"""The notebook runs as it stands, and what it shows is what it was made with."""

from __future__ import annotations

import os

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("pandas")


def test_the_notebook_runs(repository, monkeypatch) -> None:
    path = [str(repository), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, path)))
    kept = nbformat.read(repository / "docs" / "first_steps.ipynb", as_version=4)
    nbformat.validate(kept)
    made = nbformat.from_dict(kept)
    nbclient.NotebookClient(made, timeout=600, kernel_name="python3").execute(cwd=str(repository))
    cells = [(old, new) for old, new in zip(kept.cells, made.cells, strict=True) if old.cell_type == "code"]
    assert len(cells) >= 6
    for old, new in cells:
        kinds = [sorted(output.get("data", ())) for output in old.outputs]
        assert kinds == [sorted(output.get("data", ())) for output in new.outputs], old.source
        shown = [output["data"]["text/html"] for output in new.outputs if "text/html" in output.get("data", {})]
        assert all("<table" in text for text in shown)
