"""Runs the tests of a folder against one changed file after the other, each in a forked process.

    python server.py TREE PACKAGE

TREE is a copy of the repository that belongs to this process alone. Everything that the changed package does not reach
(libraries, packages to its left) is imported once, so that a child only imports the package itself and runs its tests.
Jobs come as lines of JSON, answers go out as such:

- `{"cover": FOLDERS, "of": [...]}`: the tests of folders as they are, with the lines of these modules that each runs;
- `{"file": ..., "text": ..., "tests": [...], "seconds": ...}`: tests against a file with that text, up to the first
  failure, and no longer than so.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

LAYERS = (
    "model",
    "effects",
    "sensors",
    "integrator",
    "data",
    "vision",
    "virtual",
    "problem",
    "inference",
    "solvers",
    "analysis",
)
LAYERS = (*LAYERS, "diagnosis", "planning", "export", "report", "config", "workflow")
"""Packages from left to right; those to the left of the changed one are imported once."""
LIBRARIES = (
    "numpy",
    "scipy.optimize",
    "scipy.stats",
    "scipy.signal",
    "scipy.interpolate",
    "casadi",
    "h5py",
    "pydantic",
)
LIBRARIES = (*LIBRARIES, "ruamel.yaml", "hypothesis", "jsonschema", "pinocchio", "mujoco", "yourdfpy", "threadpoolctl")
MEMORY = 8 * 2**30
ARGUMENTS = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", "-m", "not slow", "--no-header", "--tb=line"]


class Selected:
    """Keeps the wanted tests, in the wanted order, and remembers the first one that fails."""

    def __init__(self, wanted: list[str]) -> None:
        self._order = {name: i for i, name in enumerate(wanted)}
        self.failed = ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        files = {name.partition("::")[0]: i for i, name in reversed(list(enumerate(self._order)))}
        kept = [item for item in items if item.nodeid in self._order or item.nodeid.partition("::")[0] in self._order]
        items[:] = sorted(kept, key=lambda item: files[item.nodeid.partition("::")[0]])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


class Covering:
    """Notes which lines each test runs, fixtures among them, and how long it takes."""

    def __init__(self, coverage: Any) -> None:
        self._coverage = coverage
        self._context = [""]
        self.tests: dict[str, dict[str, Any]] = {}

    @contextmanager
    def _within(self, name: str) -> Iterator[None]:
        self._context.append(name)
        self._coverage.switch_context(name)
        yield
        self._context.pop()
        self._coverage.switch_context(self._context[-1])

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        with self._within(f"fixture {fixturedef.argname}"):
            yield

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        with self._within(item.nodeid):
            yield

    def pytest_itemcollected(self, item: pytest.Item) -> None:
        self.tests[item.nodeid] = {"seconds": 0.0, "fixtures": list(getattr(item, "fixturenames", ()))}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.tests[report.nodeid]["seconds"] += report.duration


def forked(work: Callable[[], int], seconds: float) -> int | None:
    """Exit status of work done in a forked process of its own group; None where it took longer than so."""
    child = os.fork()
    if child == 0:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        silence = os.open(os.environ.get("MUTATION_LOG", os.devnull), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        status = 3
        try:
            status = work()
        finally:
            os._exit(status)
    end = time.monotonic() + seconds
    status: int | None = None
    while status is None and time.monotonic() < end:
        done, code = os.waitpid(child, os.WNOHANG)
        status = os.waitstatus_to_exitcode(code) if done else None
        time.sleep(0.02)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    if status is None:
        os.waitpid(child, 0)
    return status


def cover(tree: Path, folders: list[str], modules: list[str]) -> dict[str, Any]:
    """Tests of folders: `tests` {name: seconds and fixtures} and `lines` {file: {line: who runs it}}."""
    import coverage

    target = tree / "covered.json"

    def work() -> int:
        own = [tree / "yid_ocp" / Path(*module.split(".")) for module in modules]
        include = [pattern for place in own for pattern in (f"{place}/*", f"{place}.py")]
        measured = coverage.Coverage(data_file=None, include=include, concurrency="thread")
        plugin = Covering(measured)
        measured.start()
        status = pytest.main([*ARGUMENTS, *folders], plugins=[plugin])
        measured.stop()
        data = measured.get_data()
        lines = {
            str(Path(file).relative_to(tree)): {
                str(line): sorted(contexts) for line, contexts in data.contexts_by_lineno(file).items()
            }
            for file in data.measured_files()
        }
        target.write_text(json.dumps({"tests": plugin.tests, "lines": lines}), encoding="utf-8")
        return int(status)

    status = forked(work, 1800.0)
    if status != 0:
        return {"error": f"the tests of {', '.join(folders)} fail as they are (status {status})"}
    return dict(json.loads(target.read_text(encoding="utf-8")))


def judged(tree: Path, file: str, text: str, tests: list[str], seconds: float) -> dict[str, Any]:
    """Whether tests notice that a file has another text: `status` killed or survived, and by what."""
    target, said = tree / file, tree / "failed.txt"
    before = target.read_text(encoding="utf-8")
    said.write_text("", encoding="utf-8")

    def work() -> int:
        selected = Selected(tests)
        files = list(dict.fromkeys(name.partition("::")[0] for name in tests))
        status = pytest.main([*ARGUMENTS, *files], plugins=[selected])
        said.write_text(selected.failed, encoding="utf-8")
        return int(status)

    begun = time.monotonic()
    target.write_text(text, encoding="utf-8")
    try:
        status = forked(work, seconds)
    finally:
        target.write_text(before, encoding="utf-8")
    if status is None:
        by = "time limit"
    elif status < 0:
        by = f"signal {-status}"
    else:
        by = said.read_text(encoding="utf-8") or f"status {status}"
    if status in (int(pytest.ExitCode.USAGE_ERROR), int(pytest.ExitCode.NO_TESTS_COLLECTED)):
        return {"error": f"pytest found nothing to run for {file}: {', '.join(tests)}"}
    killed = status != 0
    return {
        "status": "killed" if killed else "survived",
        "by": by if killed else "",
        "seconds": time.monotonic() - begun,
    }


def main() -> None:
    """Answer jobs until there are no more."""
    tree, package = Path(sys.argv[1]), sys.argv[2]
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    sys.dont_write_bytecode = True
    for name in (*LIBRARIES, *(f"yid_ocp.{layer}" for layer in LAYERS[: LAYERS.index(package)])):
        try:
            importlib.import_module(name)
        except ImportError:
            continue
    assert f"yid_ocp.{package}" not in sys.modules
    for line in sys.stdin:
        job = json.loads(line)
        answer = cover(tree, job["cover"], job["of"]) if "cover" in job else judged(tree, **job)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
