"""Files that a public project has agree with each other."""

from __future__ import annotations

import os
import re

from ruamel.yaml import YAML


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
