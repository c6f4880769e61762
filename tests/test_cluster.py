"""Tasks on a Dask cluster of this machine: a killed worker, workers that are not fit, schedulers that are not there."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import pytest
from light_tasks import deadly, squared

from yid_ocp.config.reader import load_config
from yid_ocp.display import Progress
from yid_ocp.errors import ParallelWorkError
from yid_ocp.parallel import InlineExecutor, Task, WorkerConfig, run_tasks
from yid_ocp.version import software_fingerprint
from yid_ocp.workflow.blind import run_blind


@pytest.fixture(scope="module", autouse=True)
def distributed():
    """The package, which takes half a second to import."""
    return pytest.importorskip("distributed", reason="clusters need Dask: pip install '.[cluster]'")


def tasks(marks: Path, count: int = 12) -> list[Task]:
    marks.mkdir(exist_ok=True)
    return [Task(f"task {i}", {"number": i, "marks": str(marks)}) for i in range(count)]


@pytest.fixture(scope="module")
def scheduler(distributed):
    """Address of a scheduler with two workers of one thread each, and the cluster itself."""
    where = {"dashboard_address": None, "host": "127.0.0.1", "scheduler_kwargs": {"allowed_failures": 1}}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **where) as cluster:
        cluster.wait_for_workers(2, timeout=60)
        address = cluster.scheduler_address
        yield SimpleNamespace(package=distributed, address=address, cluster=cluster, config=WorkerConfig(None, address))


def processes(scheduler: Any) -> list[int]:
    with scheduler.package.Client(scheduler.address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


def test_a_killed_worker_loses_nothing_and_nothing_counts_twice(scheduler, tmp_path):
    marks = tmp_path / "marks"
    workers = processes(scheduler)
    killed: list[int] = []

    def kill_one(done: int, total: int, name: str) -> None:
        """Once four are done, end a worker that is at a task."""
        if done < 4 or killed:
            return
        until = time.monotonic() + 20
        while time.monotonic() < until:
            begun, ended = ({path.stem for path in marks.glob(f"*.{what}")} for what in ("begun", "ended"))
            at_work = {int(stem.partition(".")[2]) for stem in begun - ended} & set(workers)
            if at_work:
                killed.append(at_work.pop())
                os.kill(killed[0], signal.SIGKILL)
                return

    found = run_tasks(squared, tasks(marks), tmp_path / "there", scheduler.config, kill_one)
    assert len(killed) == 1
    assert [entry.error for entry in found] == [""] * 12
    begun, ended = ([path.stem.partition(".")[0] for path in marks.glob(f"*.{what}")] for what in ("begun", "ended"))
    assert len(begun) > 12  # what the killed worker was at began again
    assert set(ended) == {str(i) for i in range(12)}
    with ThreadPoolExecutor(12) as pool:
        here = run_tasks(squared, tasks(tmp_path / "more"), tmp_path / "here", pool)
    assert [entry.value for entry in found] == [entry.value for entry in here] == [i**2 for i in range(12)]
    files = {path.name: json.loads(path.read_text()) for path in (tmp_path / "there").iterdir()}
    assert sorted(entry["name"] for entry in files.values()) == sorted(entry.name for entry in found)
    # whoever did them, they are done
    again = run_tasks(squared, [Task("", task.arguments) for task in tasks(marks)], tmp_path / "there")
    assert all(entry.was_resumed for entry in again)


def test_a_task_that_ends_every_worker_fails_alone(scheduler, tmp_path):
    tasks_of_three = [Task(str(i), {"number": i}) for i in range(3)]
    found = run_tasks(deadly, tasks_of_three, tmp_path, scheduler.config)
    if found[0].error or found[2].error:  # on a busy machine Dask blames a task that waits at a worker that ends
        found = run_tasks(deadly, tasks_of_three, tmp_path, scheduler.config)
    assert [entry.value for entry in found] == [0, None, 2]
    assert "ended abruptly" in found[1].error
    try:
        scheduler.cluster.wait_for_workers(2, timeout=30)
    except TimeoutError:  # one that could not be started again in time, on a busy machine, is replaced
        scheduler.cluster.scale(0)
        scheduler.cluster.scale(2)
        scheduler.cluster.wait_for_workers(2, timeout=60)


OLD = {"yid-ocp": "99.0", "code": "b" * 64}, r"version: yid-ocp \S+ instead of 99.0, code \w+ instead of bbb"


@pytest.mark.parametrize(
    ("other", "words"), [OLD, ({"python": "2.7"}, r"of another version: python 3\.\S+ instead of 2.7")]
)
def test_a_worker_of_another_version_is_refused(scheduler, monkeypatch, other, words):
    here = software_fingerprint() | other
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks.software_fingerprint", lambda: here)
    with pytest.raises(ParallelWorkError, match=words):
        scheduler.config.check_scheduler_available()


def test_what_a_worker_cannot_import_or_see_is_said(scheduler, tmp_path, monkeypatch):
    elsewhere, tasks = FunctionType(squared.__code__, {}), [Task("", {"number": 3})]
    elsewhere.__module__ = "nowhere.to_be_found"
    with pytest.raises(ParallelWorkError, match="ModuleNotFoundError: No module named 'nowhere'"):
        run_tasks(elsewhere, tasks, tmp_path, scheduler.config)
    unseen = nullcontext(SimpleNamespace(name=str(tmp_path / "unseen")))
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks.tempfile.NamedTemporaryFile", lambda **_: unseen)
    with pytest.raises(ParallelWorkError, match=f"does not see {tmp_path}"):
        run_tasks(squared, tasks, tmp_path, scheduler.config)


def test_workers_of_several_threads_are_refused(distributed):
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
        pytest.raises(ParallelWorkError, match="2 tasks at once in one process"),
    ):
        WorkerConfig(scheduler_address=cluster.scheduler_address).check_scheduler_available()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "a:b:c"])
def test_a_scheduler_that_is_not_there_is_said(address, monkeypatch, refused_with):
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks._CONNECT_TIMEOUT", 0.5)
    with refused_with(ParallelWorkError, ("no scheduler answers", address, "dask scheduler")):
        WorkerConfig(scheduler_address=address).check_scheduler_available()


def test_dask_is_optional(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ParallelWorkError, match=r"pip install '\.\[cluster\]'"):
        WorkerConfig(scheduler_address="localhost:8786").check_scheduler_available()


def test_a_scheduler_file_will_do(scheduler, tmp_path):
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"type": "Scheduler", "address": scheduler.address}))
    [found] = run_tasks(deadly, [Task("", {"number": 5})], tmp_path / "results", WorkerConfig(None, str(file)))
    assert found.value == 5


@pytest.mark.parametrize(("failures", "refused"), [(2, False), (3, True)])
def test_an_event_loop_that_has_no_time_to_start_is_tried_again(
    scheduler, distributed, monkeypatch, tmp_path, failures, refused
):
    """Dask asserts that it runs after ten seconds."""
    real, asked = distributed.Client, []

    def busy(**where: Any) -> Any:
        asked.append(where)
        assert len(asked) > failures
        return real(**where)

    monkeypatch.setattr(distributed, "Client", busy)
    answer = pytest.raises(ParallelWorkError, match="event loop of Dask did not start") if refused else nullcontext()
    with answer:
        assert run_tasks(deadly, [Task("", {"number": 3})], tmp_path, scheduler.config)[0].value == 3
    assert len(asked) == 3


CASES = 12


class Killing(Progress):
    """Ends a worker in the middle of the diagnoses, as soon as a third of them is done."""

    def __init__(self, scheduler: Any) -> None:
        self.scheduler, self.diagnosing, self.killed = scheduler, False, 0

    def begin_stage(self, text: str, work: float = 0.0, ahead: float | None = None) -> None:
        self.diagnosing = text.startswith("diagnosing")

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        if self.diagnosing and not self.killed and 3 * done >= total:
            self.killed = processes(self.scheduler)[0]
            os.kill(self.killed, signal.SIGKILL)


@pytest.mark.slow
def test_a_blind_proof_survives_a_killed_worker(scheduler, pendulum, tmp_path):
    pytest.importorskip("mujoco", reason="blind proofs need MuJoCo: pip install '.[blind]'")
    settings = ("recordings.held_out=[]", "output.write_report=false", "problem.use_compiler=true")
    candidates = "diagnosis.candidates=[joint_viscous, joint_coulomb]"
    run = load_config(pendulum, ("model.arms.mode=driven", *settings, candidates))
    killing = Killing(scheduler)
    there = run_blind([run], tmp_path / "there", CASES, 3, killing, scheduler.config)
    assert killing.killed
    here = run_blind([run], tmp_path / "here", CASES, 3, workers=InlineExecutor())
    for own in (there.result, here.result):
        own.pop("seconds")
        for entry in own["marks"]:
            entry.pop("seconds")
    assert there.result == here.result
    for folder in ("there", "here"):
        answers = [json.loads(path.read_text())["name"] for path in (tmp_path / folder / "answers").glob("*.json")]
        assert sorted(answers) == [f"case_{i:03d}" for i in range(CASES)]
