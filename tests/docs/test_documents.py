"""The code, commands and names of the pages run and exist; the site builds strictly; what a public project has."""

from __future__ import annotations

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML

import yid_ocp
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings
from yid_ocp.data.channel_checks import ISSUE_CAUSE_DESCRIPTIONS
from yid_ocp.effects import EFFECTS
from yid_ocp.effects.base import EffectBase
from yid_ocp.export.equations import _MAX_JACOBIAN_OPERATIONS
from yid_ocp.files import file_sha256
from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.solvers.nonlinear_program import NonlinearProgram
from yid_ocp.workflow.build import build_system


@pytest.fixture
def page(repository):
    """Text of a page by its name alone."""

    def text(name: str) -> str:
        [file] = repository.glob(f"docs/*/{name}.md")
        return file.read_text(encoding="utf-8")

    return text


@pytest.fixture
def run_script(repository):
    """Run code in a process of its own, whose registered kinds are no other test's; returns what it printed."""

    def run(code: str, folder, *arguments: str) -> str:
        code = f"import sys\nsys.path[:0] = [{str(repository)!r}, '']\n{code}"
        command = [sys.executable, "-c", code, *arguments]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def printed_commands(text: str) -> list[list[str]]:
    """Words of every command that a page prints, continued lines joined, and loops over `run` unrolled."""
    found, lines, runs = [], iter(text.splitlines()), [""]
    for line in lines:
        if loop := re.match(r"\s*for run in (.*); do", line):
            runs = loop[1].split()
        begin = re.match(r"\s*(?:\$ |python -m pip install [^&]*&& )?(yid-ocp .*)", line)
        if begin is None:
            continue
        command = begin[1]
        while True:
            if command.endswith("\\"):
                command = command[:-1] + next(lines).strip()
                continue
            try:
                words = shlex.split(command, comments=True)
                break
            except ValueError:  # a quote that a later line closes
                command += next(lines).strip()
        for part in " ".join(map(shlex.quote, words)).replace("'&&'", "|").replace("'|'", "|").split(" | "):
            for run in runs if "$run" in part else [""]:
                found += [shlex.split(part.replace("$run", run))] if part.startswith("yid-ocp ") else []
    return found


def test_names_in_the_pages_exist(repository):
    """What stands in backticks with an underscore is a name of the code, of a setting or of a file."""
    # attributes of a group are its quantity and an ending, and one page makes an effect of its own
    known = {"current_bias_std", "joint_churning", *(file.stem for file in repository.glob("docs/**/*"))}
    code = ("yid_ocp/**/*.py", "yid_ocp/**/*.html", "benchmarks/**/*.py", "tests/**/*.py")
    for pattern in (*code, "configs/*.yaml", "yid_ocp/**/*.json"):
        for file in repository.glob(pattern):
            known |= {file.stem, *re.findall(r"\w+", file.read_text(encoding="utf-8"))}
    absent = {}
    for file in (*repository.glob("*.md"), *repository.glob("docs/**/*.md")):
        if file.name != "CHANGELOG.md":
            text = re.sub(r"```.*?```", "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
            spans = re.findall(r"`([^`]+)`", text)
            words = {word for span in spans for word in re.findall(r"(?<![\w$])[a-z]+_[a-z_]+(?!\w)", span)}
            absent |= {file.name: sorted(words - known)} if words - known else {}
    assert not absent


def test_the_page_of_checks_lists_every_issue_with_its_description(page):
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", page("data_checks"), re.MULTILINE)
    assert dict(rows[3:]) == dict(ISSUE_CAUSE_DESCRIPTIONS)  # behind the three severities


def test_the_tutorial_runs(page, run_script, repository, shipped_optimization):
    run_script("\n".join(blocks(page("tutorial"), "python")), repository)


CHECKS = """
values = ca.Function("k", [mine.w], [k])(found["x"])
assert solver.stats()["success"]
assert abs(float(values[1] / values[0]) - 1.4) < 1e-6, values
plain = nlp.make_solver("ipopt", hessian="exact", ipopt={"print_level": 0, "sb": "yes"})
free = plain(**nlp.solver_arguments)
assert abs(float(free["x"][0]) - 199.459) < 0.01
assert float(found["f"]) > float(free["f"])
assert planner.stats()["success"]
angle, *lengths = np.array(ca.Function("end", [w], [q[:, -1]])(motion["x"])).ravel()
pull = np.array([0.505, 0.5]) * 9.81 * np.sin(0.3)  # weight along the rail, beyond each spring
assert abs(angle - 0.3) < 1e-9
assert np.allclose(lengths, pull / [199.459, 299.75], rtol=1e-3)
"""


def test_the_program_runs(page, run_script, repository):
    code = blocks(page("program"), "python")
    assert len(code) == 3
    assert sum(bool(line.strip()) for line in code[1].splitlines()) <= 6, "five lines of one's own, and one to print"
    printed = run_script("\n".join([*code, CHECKS]), repository)
    assert "theta (2, 1) ('spring_1.stiffness', 'spring_2.stiffness')" in printed
    assert "q[springs_series] (3, 401)" in printed
    named = set(re.findall(r"`nlp\.(\w+)", page("program")))
    assert {"w", "p", "f", "g", "hessian", "solver_arguments"} <= named
    assert named <= {*NonlinearProgram.__dataclass_fields__, *vars(NonlinearProgram)}


def test_entries_and_names_are_those_of_the_equations(page, repository):
    system = build_system(load_config(repository / "configs/dual_arm_vision.yaml"))
    symbols = NamedStepEquations.from_equations(discrete_equations(system))
    text = page("inspection")
    [commands] = blocks(text, "sh")
    for entry in re.findall(r"--entry '(.*?)'", commands):
        title = symbols.equation_or_derivative_by_name(entry).title
        assert title.split(" / ")[0].removeprefix("d ") == entry.split(",")[0]
    lines = symbols.equation_or_derivative_by_name("del[T2_3_z], T2.twist").text_lines
    assert "\n".join(f"    {line}" for line in lines) in text
    listed = re.findall(r"`((?:del|constraint|p1|q0|p0|u|q1|lam)\[[\w.]+\])`", text)
    assert len(listed) > 6
    assert set(listed) <= {*symbols.row_names, *symbols.all_variable_names}
    assert f"{_MAX_JACOBIAN_OPERATIONS:_}".replace("_", " ") in text


def test_the_script_of_the_inspection_runs(page, repository, monkeypatch, capsys):
    [script] = blocks(page("inspection"), "python")
    monkeypatch.chdir(repository)
    exec(compile(script, "inspection.md", "exec"), {})
    assert "d del[T1_0_x] / d T1.bend = -h/2*0.5*(q0[T1_0_x] + q1[T1_0_x])" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "first"), [("extending", "churning.py"), ("own_object", "strip.py"), ("own_sensor", "passive_angles.py")]
)
def test_the_worked_example_of_an_extension_runs(page, run_script, tmp_path, name, first):
    named = re.findall(r"```python ?(\S*)\n(.*?)```", page(name), re.DOTALL)
    assert named[0][0] == first
    for name, block in named:
        if name:
            (tmp_path / name).write_text(block, encoding="utf-8")
    run_script("\n".join(block for name, block in named if not name), tmp_path)


def test_the_effect_of_the_page_is_used_like_any_other(page):
    [block] = blocks(page("extending"), "yaml")
    [entry] = YAML(typ="safe", pure=True).load(block)["model"]["effects"]
    said = EffectSettings(**entry)
    assert (said.kind, said.location, said.values) == ("joint_churning", "left_e1", {"c": 0.3})


def test_the_plugins_run_from_a_configuration(page, run_script, pendulum_data, tmp_path):
    files = dict(re.findall(r"```python (\S+)\n(.*?)```", page("extending"), re.DOTALL))
    [block] = blocks(page("extending"), "yaml plugins")
    said = YAML(typ="safe", pure=True).load(block)
    for name in said["plugins"]:
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    assert [(e["kind"], e["location"]) for e in said["model"]["effects"]] == [("pole", "w_rod")]
    effects = "[{kind: pole, location: tip, values: {strength: 0.02}}, {kind: thrust, location: tip}]"
    given = pendulum_data.text.replace("model:\n", f"plugins: {said['plugins']}\nmodel:\n  measured_points: [tip]\n", 1)
    text = given.replace("  joint_springs:", f"  effects: {effects}\n  joint_springs:")
    (tmp_path / "drawn.yaml").write_text(text, encoding="utf-8")
    code = "from yid_ocp.cli import main; sys.exit(main())"
    run_script(code, tmp_path, "solve", "drawn.yaml", "--out", "run", "--set", "output.write_report=false")
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    assert result["parameters"]["shoulder.stiffness"]["verdict"] == "identifiable"
    assert result["inputs"][str(tmp_path / "magnet.py")] == file_sha256(tmp_path / "magnet.py")
    assert set(result["inputs"]) >= {str(tmp_path / name) for name in said["plugins"]}


def test_the_methods_of_an_effect_that_the_page_names_exist(page):
    rows = re.findall(r"^\| `(\w+)\((.*?)\)` \|.*\| (.*?) \|$", page("extending"), re.MULTILINE)
    of_data = {"reading_from_true_value", "true_value_from_reading", "added_channel_delay"}
    assert {name for name, _, _ in rows} >= {"apply_to_system", "step_terms"} | of_data
    for name, arguments, examples in rows:
        code = getattr(EffectBase, name).__code__
        assert list(code.co_varnames[1 : code.co_argcount]) == arguments.split(", ")
        for kind in re.findall(r"`(\w+)`", examples):
            assert kind in EFFECTS
            assert getattr(EFFECTS[kind], name) is not getattr(EffectBase, name)


def printed_without_numbers(cell) -> str:
    """What a cell of a notebook prints and shows as text, with # for numbers, whose widths columns follow."""
    texts = [output.get("text", "") for output in cell.outputs]  # printed lines come in any number of pieces
    texts += [text for output in cell.outputs for kind, text in output.get("data", {}).items() if kind == "text/plain"]
    masked = re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", "".join(texts))
    return re.sub(r"-{2,}", "--", re.sub(r" {2,}", " ", masked))


@pytest.mark.parametrize("name", [pytest.param("first_steps", marks=pytest.mark.slow), "lab_day"])
def test_the_notebook_runs_and_shows_what_it_was_made_with(repository, monkeypatch, name):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    path = [str(repository), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, path)))
    kept = nbformat.read(repository / "docs" / "start" / f"{name}.ipynb", as_version=4)
    nbformat.validate(kept)
    made = nbformat.from_dict(kept)
    nbclient.NotebookClient(made, timeout=600, kernel_name="python3").execute(cwd=str(repository))
    cells = [(old, new) for old, new in zip(kept.cells, made.cells, strict=True) if old.cell_type == "code"]
    assert len(cells) >= 6
    for old, new in cells:
        kinds, made_kinds = ([sorted(o["data"]) for o in cell.outputs if "data" in o] for cell in (old, new))
        assert kinds == made_kinds, old.source
        assert printed_without_numbers(old) == printed_without_numbers(new), old.source
        shown = [output["data"]["text/html"] for output in new.outputs if "text/html" in output.get("data", {})]
        assert all("<table" in text for text in shown)


def anchors(text: str) -> set[str]:
    """Anchors of the headings of a page."""
    heads = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def test_every_relative_link_leads_somewhere(repository):
    """Links of all pages and notebooks, with their anchors, and pages that code and settings name."""
    lost = []
    for file in [*repository.glob("*.md"), *repository.glob("docs/**/*.md"), *repository.glob("docs/**/*.ipynb")]:
        text = re.sub(r"```.*?```", "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
        for link in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", text):
            path, _, anchor = link.partition("#")
            target = file.parent / path if path else file
            if not target.exists() or (anchor and anchor not in anchors(target.read_text(encoding="utf-8"))):
                lost.append((file.name, link))
    files = [path for path in repository.glob("*.*") if path.is_file()]
    for folder in ("docs", "yid_ocp", "tests", "benchmarks", "configs"):
        files += repository.glob(f"{folder}/**/*.*")
    for file in files:
        if file.suffix in (".py", ".c", ".md", ".yaml", ".yml", ".toml", ".cff"):
            named = re.findall(r"(?<![\w/])docs/[\w/]+\.(?:md|py|ipynb|png|gif)\b", file.read_text(encoding="utf-8"))
            lost += [(file.name, name) for name in named if not (repository / name).exists()]
    assert not lost


@pytest.fixture
def site(repository):
    """The hooks of the site."""
    pytest.importorskip("mkdocstrings_handlers.python")
    pytest.importorskip("material")
    return SimpleNamespace(**runpy.run_path(str(repository / "docs" / "site.py")))


def test_every_page_and_every_public_object_has_its_place(repository, site) -> None:
    for folder in site.SHELVES.values():
        there = (repository / "docs" / folder).glob("*.md")
        assert set(site.pages(folder)) == {f"{folder}/{path.name}" for path in there}
    shelves = {path.name for path in (repository / "docs").iterdir() if path.is_dir() and path.name[0] != "_"}
    assert shelves == {*site.SHELVES.values(), "design", "pictures"}
    assert set(site.public()) == set(yid_ocp.__all__) - {"__version__"}


def test_links_out_of_the_folder_become_words(site) -> None:
    page = SimpleNamespace(file=SimpleNamespace(src_uri="howto/plan.md"))
    kept = "[b](../explain/theory.md#start), [c](https://a.org), [d](#here), ![f](../pictures/f.gif)"
    text = f"[a](../../configs/x.yaml), [e](../../SECURITY.md), [g](../README.md), [h](../start/day.ipynb), {kept}"
    assert site.on_page_markdown(text, page) == f"a, e, g, h, {kept}"


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
    entry = read(repository, "yid_ocp/data/defaults/citation.bib")
    assert f"```bibtex\n{entry}```" in read(repository, "README.md")
    assert f"version = {{{citation['version']}}}" in entry
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


def test_the_pictures_of_the_readme_are_there_with_their_commands(repository) -> None:
    readme = read(repository, "README.md")
    pictures = re.findall(r"^!\[.*?\]\((.*?)\)$", readme, re.MULTILINE)
    for picture, limit in zip(pictures, (1.5e6, 2e5), strict=True):
        assert (repository / picture).stat().st_size < limit
    for picture in pictures:
        [command] = re.findall(rf"python (benchmarks/\w+\.py) [A-Z ]+ {picture}", readme)
        assert picture in read(repository, command)
    # a GIF of several frames
    moving = (repository / pictures[0]).read_bytes()
    assert moving[:6] == b"GIF89a"
    assert moving.count(b"\x21\xf9\x04") > 20
