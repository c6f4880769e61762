"""Breaks lines on purpose, one at a time, and asks whether the tests notice.

    python benchmarks/mutation [--mutants N] [--seed S] [--in PACKAGE] [--file NAME] [--jobs N] [--rules] [--again]

First the named breaks of `breaks.yaml`, each against the tests named beside it; then so many mutants, drawn by the seed
over diagnosis/, analysis/, problem/, inference/ and what all solvers share (see `PACKAGES` and `places.py`), each
against those tests of its package's folders (`TEST_FOLDERS`) that run the changed statement, those of its own folder
first, tests of rules before others, then file by file, the quickest first, up to the first failure or three times the
time that they take without a change. Tests marked `slow` stay out.

What was found goes to a JSON file as it is found; an interrupted run goes on from there as long as sources and tests
are the same. `--again` is for the time in which tests are being written: what was killed counts as killed, whatever was
changed since, and survivors are tried once more.
Exit status 0: every named break and at least 85 % of the mutants were killed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from places import Mutant, drawn
from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[2]
PACKAGES: dict[str, tuple[str, ...]] = {name: (name,) for name in ("diagnosis", "analysis", "problem", "inference")} | {
    "solvers": ("solvers.base",),
}
"""Package and what of it is broken."""
TEST_FOLDERS = {"inference": ("inference", "problem", "solvers", "diagnosis")}
"""Folders of `tests` that guard a package, where not the one of its name alone: what is said of fits needs fits."""
WANTED = 0.85


@dataclass(frozen=True)
class Job:
    """A changed file and the tests that should notice.

    Attributes
    ----------
    package : str
        Below `yid_ocp`.
    name : str
        Place and change in words.
    file, text : str
    tests : tuple of str
    seconds : float
        Time limit.
    """

    package: str
    name: str
    file: str
    text: str
    tests: tuple[str, ...]
    seconds: float

    @property
    def key(self) -> str:
        """Hash of the changed text."""
        return hashlib.sha256("\0".join([self.name, self.file, self.text]).encode()).hexdigest()


class Worker:
    """A copy of the repository and the process that runs tests in it."""

    def __init__(self, folder: Path) -> None:
        self._tree = folder / "checkout"
        files = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.splitlines()
        for file in files:
            if (ROOT / file).is_file():
                (self._tree / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / file, self._tree / file)
        # reference data stands beside a repository
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
        self._package = ""
        self._server: subprocess.Popen[str] | None = None

    def ask(self, package: str, job: dict[str, Any]) -> dict[str, Any]:
        """The server's answer, from one that has everything beside the package in memory."""
        if package != self._package or self._server is None:
            self.close()
            environment = os.environ | {
                "PYTHONPATH": str(self._tree),
                "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
                "PYTHONDONTWRITEBYTECODE": "1",
                "OPENBLAS_NUM_THREADS": "1",
                "OMP_NUM_THREADS": "1",
            }
            if "YID_OCP_CACHE" not in environment:
                environment["YID_OCP_CACHE"] = str(_private(ROOT / "build" / "mutation" / "compiled"))
            command = [sys.executable, str(Path(__file__).with_name("server.py")), str(self._tree), package]
            self._server = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
            )
            self._package = package
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps(job) + "\n")
        self._server.stdin.flush()
        answer = self._server.stdout.readline()
        if not answer:
            raise SystemExit(f"the server of {package} ended with status {self._server.wait()}")
        found = dict(json.loads(answer))
        if "error" in found:
            raise SystemExit(str(found["error"]))
        return found

    def close(self) -> None:
        """End the process."""
        if self._server is not None:
            assert self._server.stdin is not None
            self._server.stdin.close()
            self._server.wait()
            self._server = None


def _private(folder: Path) -> Path:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


# -- what to try ------------------------------------------------------------------------------------------------------


def tree_digest() -> str:
    """Hash of all sources and tests."""
    files = sorted(file for folder in ("yid_ocp", "tests") for file in (ROOT / folder).rglob("*.py"))
    return hashlib.sha256(b"\0".join([file.read_bytes() for file in files])).hexdigest()[:16]


def breaks(chosen: Sequence[str]) -> list[Job]:
    """The named breaks, every text of which must be found once."""
    entries = YAML(typ="safe").load(Path(__file__).with_name("breaks.yaml").read_text(encoding="utf-8"))
    jobs, wrong = [], []
    for entry in entries:
        file = f"yid_ocp/{entry['file']}"
        package = Path(entry["file"]).with_suffix("").parts[0]
        if chosen and package not in chosen:
            continue
        path = ROOT / file
        source = path.read_text(encoding="utf-8") if path.is_file() else ""
        if source.count(entry["old"]) != 1:
            wrong.append(f"{entry['what']}: {source.count(entry['old'])} times in {file}: {entry['old']!r}")
            continue
        tests = entry["tests"] if isinstance(entry["tests"], list) else [entry["tests"]]
        text = source.replace(entry["old"], entry["new"])
        jobs.append(Job(package, entry["what"], file, text, tuple(tests), 300.0))
    if wrong:
        raise SystemExit("named breaks that fit no line:\n  " + "\n  ".join(wrong))
    return jobs


def files_of(module: str) -> list[str]:
    """Files of a package or module, below the repository."""
    place = ROOT / "yid_ocp" / Path(*module.split("."))
    found = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    return [str(file.relative_to(ROOT)) for file in found if file.name != "__init__.py"]


def job_of(mutant: Mutant, package: str, covered: dict[str, Any], rules: bool) -> Job:
    """A mutant with the tests that run its statement, the quickest files first."""
    lines = covered["lines"].get(mutant.file, {})
    wanted = lines if mutant.at_import else [str(line) for line in range(mutant.first, mutant.last + 1)]
    callers = {who for line in wanted for who in lines.get(line, ()) if who}
    tests = [
        name
        for name, entry in covered["tests"].items()
        if name in callers or any(f"fixture {fixture}" in callers for fixture in entry["fixtures"])
        if not rules or _of_rules(name)
    ]
    seconds: dict[str, float] = {}
    for name in tests:
        file = name.partition("::")[0]
        seconds[file] = seconds.get(file, 0.0) + covered["tests"][name]["seconds"]

    def order(name: str) -> tuple[bool, bool, float, str]:
        file = name.partition("::")[0]
        return not file.startswith(f"tests/{package}/"), not _of_rules(name), seconds[file], file

    name = f"{mutant.file}:{mutant.line}: {mutant.was}  ->  {mutant.becomes}"
    limit = 3 * sum(seconds.values()) + 20
    return Job(package, name, mutant.file, mutant.text(ROOT), tuple(sorted(tests, key=order)), limit)


def _of_rules(test: str) -> bool:
    return Path(test.partition("::")[0]).name.startswith("test_rules")


# -- running ----------------------------------------------------------------------------------------------------------


class Results:
    """What was found, by the job's key; written whole after each."""

    def __init__(self, file: Path, tree: str) -> None:
        self._file, self._tree, self._lock = file, tree, threading.Lock()
        self.known: dict[str, dict[str, Any]] = {}
        if file.is_file():
            self.known = json.loads(file.read_text(encoding="utf-8")).get("known", {})
        self.asked: list[tuple[str, str]] = []

    def is_open(self, job: Job, again: bool) -> bool:
        """Whether a job is still to be tried."""
        known = self.known.get(job.key)
        if known is None:
            return True
        return bool(known["status"] != "killed") if again else bool(known["tree"] != self._tree)

    def add(self, key: str, entry: dict[str, Any]) -> None:
        """Keep a result."""
        with self._lock:
            self.known[key] = entry | {"tree": self._tree}
            self.write()

    def write(self) -> None:
        """Survivors first, as they are what a reader wants."""
        own = [(kind, self.known[key]) for kind, key in self.asked if key in self.known]
        summary = {}
        for kind in dict.fromkeys(kind for kind, _ in own):
            found = [entry for k, entry in own if k == kind]
            killed = sum(entry["status"] == "killed" for entry in found)
            summary[kind] = {
                "tried": len(found),
                "killed": killed,
                "rate": round(killed / len(found), 4),
                "survived": sorted(entry["name"] for entry in found if entry["status"] != "killed"),
            }
        text = json.dumps({"summary": summary, "known": self.known}, indent=1, ensure_ascii=False)
        part = self._file.with_suffix(".part")
        part.write_text(text, encoding="utf-8")
        os.replace(part, self._file)


def run(jobs: Sequence[tuple[str, Job]], workers: Sequence[Worker], results: Results, again: bool) -> None:
    """Try all jobs that have no result yet (or survivors), as many at a time as there are workers."""
    results.asked = [(kind, job.key) for kind, job in jobs]
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    todo = [job for _, job in jobs if results.is_open(job, again)]
    for job in sorted(todo, key=lambda job: job.package):
        waiting.put(job)
    done = [0]

    def work(worker: Worker) -> None:
        while True:
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                return
            if job.tests:
                question = {"file": job.file, "text": job.text, "tests": list(job.tests), "seconds": job.seconds}
                answer = worker.ask(job.package, question)
            else:
                answer = {"status": "survived", "by": "no test runs it", "seconds": 0.0}
            results.add(job.key, {"name": job.name, "package": job.package, **answer})
            done[0] += 1
            if answer["status"] != "killed":
                print(f"[{done[0]}/{len(todo)}] survived: {job.name} {answer['by']}", flush=True)

    threads = [threading.Thread(target=work, args=(worker,)) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    results.write()


def covering(worker: Worker, package: str, store: Path, digest: str) -> dict[str, Any]:
    """Which tests of a package run which lines; from an earlier run where sources and tests are the same."""
    file = store / f"covered_{package}.json"
    if file.is_file():
        known = json.loads(file.read_text(encoding="utf-8"))
        if known["digest"] == digest:
            return dict(known)
    folders = [f"tests/{folder}" for folder in TEST_FOLDERS.get(package, (package,))]
    print(f"running {', '.join(folders)} as they are", flush=True)
    found = worker.ask(package, {"cover": folders, "of": PACKAGES[package]}) | {"digest": digest}
    file.write_text(json.dumps(found), encoding="utf-8")
    return found


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mutants", type=int, default=600, help="how many to draw (0: named breaks only)")
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--in", dest="chosen", action="append", default=[], help="only this package; may be repeated")
    parser.add_argument("--file", action="append", default=[], help="only files of this name; may be repeated")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    parser.add_argument("--rules", action="store_true", help="only against tests of rules, which are quick")
    parser.add_argument("--no-breaks", action="store_true", help="leave the named breaks out")
    parser.add_argument("--again", action="store_true", help="try known survivors once more")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutation" / "results.json")
    return parser.parse_args()


def as_they_are(worker: Worker, jobs: Sequence[Job]) -> None:
    """Stop where tests of named breaks fail without any break."""
    for package, tests, file in sorted({(job.package, job.tests, job.file) for job in jobs}):
        text = (ROOT / file).read_text(encoding="utf-8")
        found = worker.ask(package, {"file": file, "text": text, "tests": list(tests), "seconds": 600.0})
        if found["status"] != "survived":
            raise SystemExit(f"{', '.join(tests)} fail as they are: {found['by']}")


def jobs_of(given: argparse.Namespace, worker: Worker, store: Path, tree: str) -> Iterator[tuple[str, Job]]:
    """All jobs, each with the part of the summary that it belongs to."""
    if not given.no_breaks:
        named = breaks(given.chosen)
        as_they_are(worker, named)
        yield from (("named breaks", job) for job in named)
    if not given.mutants:
        return
    packages = [package for package in PACKAGES if not given.chosen or package in given.chosen]
    owner = {file: package for package in packages for module in PACKAGES[package] for file in files_of(module)}
    files = [file for file in owner if not given.file or Path(file).name in given.file]
    covered = {package: covering(worker, package, store, tree) for package in packages}
    print(f"drawing {given.mutants} mutants", flush=True)
    for mutant in drawn(ROOT, files, given.seed, given.mutants):
        package = owner[mutant.file]
        yield "mutants", job_of(mutant, package, covered[package], given.rules)


def main() -> int:
    """Run what the arguments say and print the rates."""
    given = arguments()
    store = given.out.parent
    store.mkdir(parents=True, exist_ok=True)
    tree = tree_digest()
    results = Results(given.out, tree)
    with tempfile.TemporaryDirectory() as folder:
        workers = [Worker(Path(folder) / str(i)) for i in range(given.jobs)]
        try:
            run(list(jobs_of(given, workers[0], store, tree)), workers, results, given.again)
        finally:
            for worker in workers:
                worker.close()
    summary = json.loads(given.out.read_text(encoding="utf-8"))["summary"]
    good = True
    for kind, entry in summary.items():
        needed = WANTED if kind == "mutants" else 1.0
        good = good and entry["rate"] >= needed
        print(f"{kind}: {entry['killed']} of {entry['tried']} killed ({100 * entry['rate']:.1f} %)")
    print(f"survivors: {given.out}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
