"""The documentation as a site, which builds strictly, and files that a public project has."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML

import yid_ocp


@pytest.fixture
def site(repository):
    """The hooks of the site."""
    pytest.importorskip("mkdocstrings_handlers.python")
    pytest.importorskip("material")
    return SimpleNamespace(**runpy.run_path(str(repository / "docs" / "site.py")))


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
def test_it_builds_strictly(repository, site, tmp_path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", repository / "mkdocs.yml", "-d", tmp_path]
    done = subprocess.run(list(map(str, command)), cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for name in sorted(set(yid_ocp.__all__) - {"__version__"}):
        page = (tmp_path / "api" / name / "index.html").read_text(encoding="utf-8")
        assert re.search(rf'class="doc doc-heading"[^>]*>\s*<span class="doc[^>]*>{name}<', page), name


def read(repository, name):
    return (repository / name).read_text(encoding="utf-8")


def loaded(repository, name):
    return YAML(typ="safe", pure=True).load(read(repository, name))


def test_licence_and_citation(repository) -> None:
    project = read(repository, "pyproject.toml")
    citation = loaded(repository, "CITATION.cff")
    assert f'license = "{citation["license"]}"' in project
    assert f'version = "{citation["version"]}"' in project
    licence = read(repository, "LICENSE")
    assert "Version 2.0, January 2004" in licence
    assert "END OF TERMS AND CONDITIONS" in licence


def test_the_workflow_runs_what_is_there_on_every_python_that_is_claimed(repository) -> None:
    jobs = loaded(repository, ".github/workflows/tests.yml")["jobs"]
    claimed = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', read(repository, "pyproject.toml"))
    assert jobs["clean-checkout"]["strategy"]["matrix"]["python"] == claimed
    assert f'requires-python = ">={claimed[0]}"' in read(repository, "pyproject.toml")
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    scripts = [command for command in commands if command.startswith(".ci/")]
    assert scripts == [".ci/run", ".ci/lowest", ".ci/wheel"]
    assert all(os.access(repository / script, os.X_OK) for script in scripts)
    # the lowest versions on the oldest Python
    assert jobs["lowest-versions"]["steps"][1]["with"]["python-version"] == claimed[0]


def test_the_picture_of_the_readme_is_there(repository) -> None:
    [picture] = re.findall(r"^!\[.*?\]\((.*?)\)$", read(repository, "README.md"), re.MULTILINE)
    assert (repository / picture).stat().st_size < 200_000
    assert f"benchmarks/diagnosis_picture.py RUN {picture}" in read(repository, "README.md")
