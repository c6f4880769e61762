"""The documentation as a site: every page has its place, every public object a page, and it builds strictly."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys

import pytest

import yid_ocp

pytest.importorskip("mkdocstrings_handlers.python")
pytest.importorskip("material")


@pytest.fixture
def site(repository):
    """The hooks of the site."""
    spec = importlib.util.spec_from_file_location("site_hooks", repository / "docs" / "site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_page_and_every_public_object_has_its_place(repository, site) -> None:
    listed = {page for pages in site.SECTIONS.values() for page in pages}
    assert listed == {path.name for path in (repository / "docs").glob("*.md")} | {"index.md"}
    assert set(site.public()) == set(yid_ocp.__all__) - {"__version__"}


def test_links_out_of_the_folder_become_words(site) -> None:
    text = (
        "[a](../configs/x.yaml), [b](theory.md#start), [c](https://example.org), [d](#here), [e](LICENSE), ![f](f.png)"
    )
    said = "a, [b](theory.md#start), [c](https://example.org), [d](#here), e, ![f](f.png)"
    assert site.on_page_markdown(text) == said


@pytest.mark.slow
def test_it_builds_strictly(repository, tmp_path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", repository / "mkdocs.yml", "-d", tmp_path]
    done = subprocess.run(list(map(str, command)), cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in sorted(set(yid_ocp.__all__) - {"__version__"}):
        page = (tmp_path / "api" / name / "index.html").read_text(encoding="utf-8")
        assert re.search(rf'class="doc doc-heading"[^>]*>\s*<span class="doc[^>]*>{name}<', page), name
