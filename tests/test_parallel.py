"""Tasks that keep what they finished, failing and dying ones that take no other with them; threads and processes."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from yid_ocp.errors import ConfigError, DataError, OutputError, ParallelWorkError
from yid_ocp.parallel import (
    InlineExecutor,
    Task,
    TaskResult,
    WorkerConfig,
    call_merged_with_other_threads,
    map_in_threads,
    map_with_merged_calls,
    require_task_values,
    run_tasks,
)
from yid_ocp.parallel import resumable_tasks as parallel_tasks
from yid_ocp.parallel.threads_and_processes import available_processor_count, process_pool
from yid_ocp.version import software_fingerprint


def counted(number: int, calls: Path | str) -> dict[str, Any]:
    """Twice a number; every call leaves a line in a file that does not count as an input."""
    with Path(calls).open("a", encoding="utf-8") as file:
        file.write(f"{number}\n")
    return {"twice": 2 * number, "pair": (number, None)}


def length(file: Path, unit: str = "characters") -> str:
    return f"{file.name}: {len(file.read_text())} {unit}"


def place(file: Path, more: list[Path]) -> list[str]:
    return [str(file), *map(str, more)]


def fragile(number: int, broken: str = "") -> int:
    if number == 3 or Path(broken).is_file():
        raise ZeroDivisionError(f"no {number}")
    return number


def lethal(number: int, deadly: int) -> int:
    if number == deadly:
        os._exit(7)
    time.sleep(0.05)
    return 10 * number


def slow(number: int) -> int:
    time.sleep(0.02 * (5 - number))
    return number


def strange(number: int) -> Any:
    return {"set": {number}} if number else float("nan")


def process_name_and_threads(number: int) -> tuple[str, int]:
    def thread(item: int) -> int:
        time.sleep(0.01)
        return threading.get_ident()

    del number
    return multiprocessing.current_process().name, len(set(map_in_threads(thread, range(8))))


def tasks_of(count: int, **arguments: Any) -> list[Task]:
    return [Task(f"task {i}", {"number": i, **arguments}) for i in range(count)]


@pytest.fixture
def threads(monkeypatch):
    monkeypatch.setattr(parallel_tasks.gc, "collect", lambda: 0)  # of the many objects of a test run
    with ThreadPoolExecutor(max_workers=2) as pool:
        yield pool


def test_results_come_in_the_order_of_the_tasks_and_progress_is_told_of_each(tmp_path, threads):
    told: list[tuple[int, int, str]] = []
    run_tasks(slow, tasks_of(1), tmp_path, threads)
    found = run_tasks(slow, tasks_of(5), tmp_path, threads, lambda *what: told.append(what))
    assert [(entry.name, entry.value, entry.error) for entry in found] == [(f"task {i}", i, "") for i in range(5)]
    assert [entry.was_resumed for entry in found] == [True, False, False, False, False]
    assert found[0].seconds >= 0.1
    assert [entry[:2] for entry in told] == [(i, 5) for i in range(1, 6)]
    assert {entry[2] for entry in told[1:]} == {f"task {i}" for i in range(1, 5)}


def test_what_is_done_is_not_done_again(tmp_path, threads):
    calls, folder = tmp_path / "calls", tmp_path / "results"
    first = run_tasks(counted, tasks_of(3, calls=str(calls)), folder, threads)
    again = run_tasks(counted, tasks_of(4, calls=str(calls)), folder, threads)
    assert sorted(calls.read_text().split()) == ["0", "1", "2", "3"]
    assert [entry.was_resumed for entry in again] == [True, True, True, False]
    assert [(entry.value, entry.seconds) for entry in again[:3]] == [(entry.value, entry.seconds) for entry in first]
    assert again[2].value == {"twice": 4, "pair": [2, None]}
    # the name does not count, and equal tasks are done once
    pair = [Task(name, {"number": 7, "calls": str(calls)}) for name in ("a", "b")]
    found = run_tasks(counted, pair, folder, threads)
    assert [(entry.name, entry.value["twice"]) for entry in found] == [("a", 14), ("b", 14)]
    assert calls.read_text().split().count("7") == 1


@pytest.mark.parametrize(
    "spoiled",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[1]",
        lambda text: text.replace('"number": 0', '"number": 9'),
        lambda text: text.replace("yid-task/1", "yid-task/0"),
    ],
)
def test_a_result_that_is_not_whole_is_not_taken(tmp_path, threads, spoiled):
    tasks, folder = tasks_of(2, calls=str(tmp_path / "calls")), tmp_path / "results"
    run_tasks(counted, tasks, folder, threads)
    (file,) = (path for path in folder.iterdir() if '"number": 0' in path.read_text())
    file.write_text(spoiled(file.read_text()))
    (folder / f".{file.name}.1234.tmp").write_text("{")
    again = run_tasks(counted, tasks, folder, threads)
    assert [(entry.was_resumed, entry.value["twice"]) for entry in again] == [(False, 0), (True, 2)]


def test_a_changed_input_is_done_again(tmp_path, threads):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    file = tmp_path / "a" / "text"
    file.write_text("four")

    def resumed(file: Path, **arguments: Any) -> bool:
        (result,) = run_tasks(length, [Task("", {"file": file, **arguments})], tmp_path / "results", threads)
        assert result.value == f"{file.name}: {len(file.read_text())} {arguments.get('unit', 'characters')}"
        return result.was_resumed

    assert [resumed(file), resumed(file)] == [False, True]
    file.write_text("five!")
    assert [resumed(file), resumed(file)] == [False, True]
    assert not resumed(file, unit="letters")
    # the same file elsewhere is the same, under another name it is not
    moved = file.rename(tmp_path / "b" / "text")
    assert resumed(moved)
    assert not resumed(moved.rename(tmp_path / "b" / "other"))


@pytest.mark.parametrize("code", [None, "of a folder"])
def test_results_depend_on_the_function_and_on_the_sources_that_are_named(tmp_path, threads, monkeypatch, code):
    def resumed(function: Any, code: str | None) -> bool:
        (result,) = run_tasks(function, tasks_of(1), tmp_path, threads, code=code)
        return result.was_resumed

    assert [resumed(slow, code), resumed(slow, code), resumed(fragile, code)] == [False, True, False]
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks.package_source_hash", lambda: "99")
    assert resumed(slow, code) is (code is not None)
    assert not resumed(slow, "of another folder")


def test_a_worker_of_other_sources_does_nothing(tmp_path, threads, monkeypatch):
    here, asker = software_fingerprint(), threading.current_thread()

    def fingerprint():
        return {**here, "code": "a" * 64} if threading.current_thread() is asker else here

    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks.software_fingerprint", fingerprint)
    (found,) = run_tasks(counted, tasks_of(1, calls=str(tmp_path / "calls")), tmp_path / "results", threads)
    assert f"is of another version: code {here['code'][:12]} instead of aaaaaaaaaaaa" in found.error
    assert not (tmp_path / "calls").exists()
    assert not list((tmp_path / "results").iterdir())


def test_paths_are_absolute_for_workers_elsewhere(tmp_path, threads, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("text").write_text("four")
    (found,) = run_tasks(place, [Task("", {"file": Path("text"), "more": [Path("text")]})], Path("results"), threads)
    assert found.value == [str(tmp_path / "text")] * 2


def test_a_failing_task_is_recorded_tried_again_and_the_others_go_on(tmp_path, threads, caplog):
    broken, folder = tmp_path / "broken", tmp_path / "results"
    found = run_tasks(fragile, tasks_of(5, broken=str(broken)), folder, threads)
    assert [entry.value for entry in found] == [0, 1, 2, None, 4]
    assert [entry.error for entry in found] == ["", "", "", "ZeroDivisionError: no 3", ""]
    [warned] = caplog.messages
    assert all(fact in warned for fact in ("task 3", "ZeroDivisionError", "no 3"))
    (file,) = folder.glob("*.error.json")
    kept = json.loads(file.read_text())
    assert (kept["name"], kept["error"]) == ("task 3", "ZeroDivisionError: no 3")
    other = tmp_path / "other"
    broken.write_text("")
    (failed,) = run_tasks(fragile, tasks_of(1, broken=str(broken)), other, threads)
    assert failed.error
    broken.unlink()
    (done,) = run_tasks(fragile, tasks_of(1, broken=str(broken)), other, threads)
    assert (done.value, done.error, done.was_resumed) == (0, "", False)
    assert [path.name.count(".") for path in other.iterdir()] == [1], "the record of the failure goes"


def test_a_result_that_json_cannot_hold_is_a_failure(tmp_path, threads):
    found = run_tasks(strange, tasks_of(2), tmp_path, threads)
    assert "not JSON compliant" in found[0].error
    assert "not JSON serializable" in found[1].error
    assert len(list(tmp_path.iterdir())) == 2


def test_what_all_tasks_found_or_why_one_did_not():
    good = TaskResult("a", 1)
    assert require_task_values([good, good]) == [1, 1]
    with pytest.raises(RuntimeError, match=r"1 of 2 tasks failed; .* b: ZeroDivisionError: no b; the same command"):
        require_task_values([good, TaskResult("b", error="ZeroDivisionError: no b")])
    with pytest.raises(ParallelWorkError, match=r"of c: no such file\n.* 'c': here\n(.|\n)*try: there\. Th"):
        require_task_values([good, TaskResult("c", error="no such file\n  where: here\n  try: there")])


def test_what_cannot_be_a_task_is_refused_before_any_runs(tmp_path, threads):
    calls = tmp_path / "calls"
    good = Task("", {"number": 1, "calls": str(calls)})
    with pytest.raises(TypeError, match="of type set"):
        run_tasks(counted, [good, Task("", {"number": {1}, "calls": ""})], tmp_path, threads)
    with pytest.raises(DataError, match="no such file"):
        run_tasks(counted, [good, Task("", {"number": 1, "calls": tmp_path / "absent"})], tmp_path, threads)
    with pytest.raises(ValueError, match="top of a module"):
        run_tasks(lambda number: number, tasks_of(1), tmp_path, threads)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be made"):
        run_tasks(counted, [good], tmp_path / "file" / "results", threads)
    assert not calls.exists()


class Breaking(InlineExecutor):
    """Does one task, then breaks."""

    left = 1

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        if self.left == 0:
            raise BrokenExecutor
        self.left -= 1
        return super().submit(function, *arguments, **named)


def test_an_executor_that_breaks_leaves_what_was_done(tmp_path):
    found = run_tasks(slow, tasks_of(3), tmp_path, Breaking())
    assert [(entry.value, entry.error) for entry in found] == [(0, ""), *[(None, "the workers were lost")] * 2]


def test_one_process_and_two_find_the_same(tmp_path):
    here = multiprocessing.current_process().name
    for workers in (1, 2):
        with process_pool(workers) as pool:
            found = run_tasks(process_name_and_threads, tasks_of(4), tmp_path / str(workers), pool)
        assert 1 <= len({entry.value[0] for entry in found} - {here}) <= workers
    one, two = (sorted(path.name for path in (tmp_path / folder).iterdir()) for folder in ("1", "2"))
    assert one == two
    assert len(one) == 4


def test_processes_share_the_threads_of_the_machine_and_threads_keep_the_order(tmp_path, monkeypatch):
    monkeypatch.setenv("YID_OCP_THREADS", "4")
    found = run_tasks(process_name_and_threads, tasks_of(2), tmp_path, WorkerConfig(n_processes=2))
    assert [entry.value[1] for entry in found] == [2, 2]
    assert map_in_threads(lambda x: x * x, range(7)) == [x * x for x in range(7)]


@pytest.mark.parametrize("said", ["0", "-1", "two", "1.5"])
def test_a_wrong_number_of_threads_is_refused(said, monkeypatch):
    monkeypatch.setenv("YID_OCP_THREADS", said)
    with pytest.raises(ConfigError, match=f"number of threads is .{said}"):
        map_in_threads(abs, [1, 2])


def test_no_workers_and_workers_in_two_places_are_refused():
    assert available_processor_count() >= 1
    with pytest.raises(ConfigError, match="0 workers"):
        WorkerConfig(n_processes=0)
    with pytest.raises(ConfigError, match="together with a scheduler"):
        WorkerConfig(n_processes=2, scheduler_address="localhost:8786")


def test_a_task_that_ends_its_process_takes_no_other_with_it(tmp_path, caplog):
    assert [entry.value for entry in run_tasks(lethal, tasks_of(5, deadly=1), tmp_path)] == [0, None, 20, 30, 40]
    assert [("task 1" in text, "abruptly" in text) for text in caplog.messages] == [(True, True)]


SLEEPERS = """
import signal, sys, time
from pathlib import Path
from yid_ocp.parallel import Task, run_tasks

def sleeping(seconds, mark):
    Path(mark).with_suffix(".begun").write_text("")
    time.sleep(seconds)
    return seconds

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
    folder = Path(sys.argv[1])
    tasks = [Task(str(s), {"seconds": s, "mark": str(folder / str(i))}) for i, s in enumerate((0.0, 60.0, 60.0))]
    try:
        run_tasks(sleeping, tasks, folder / "results")
    except KeyboardInterrupt:
        sys.exit(130)
"""


def wait_until(reached: Any, seconds: float = 60) -> bool:
    until = time.monotonic() + seconds
    while not reached() and time.monotonic() < until:
        time.sleep(0.05)
    return reached()


def workers_of(parent: int) -> set[int]:
    found = set()
    for status in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = status.read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent and fields[0] != "Z":
                found.add(int(status.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_or_killed_run_leaves_its_results_and_no_process(tmp_path, how):
    (tmp_path / "sleepers.py").write_text(textwrap.dedent(SLEEPERS))
    process = subprocess.Popen([sys.executable, str(tmp_path / "sleepers.py"), str(tmp_path)])
    assert wait_until(lambda: list(tmp_path.glob("results/*.json")) and len(list(tmp_path.glob("*.begun"))) > 1)
    workers = workers_of(process.pid)
    assert workers
    process.send_signal(how)
    assert process.wait(timeout=20) == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 20)
    assert [json.loads(path.read_text())["name"] for path in (tmp_path / "results").glob("*.json")] == ["0.0"]


class Answers:
    """Squares, and who asked for them together."""

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def __call__(self, questions: list[int]) -> list[int]:
        self.asked.append(list(questions))
        return [x * x for x in questions]


def test_questions_of_all_items_meet():
    squares = Answers()

    def item(i: int) -> int:
        """Asks i + 1 times, one question more every time."""
        return sum(
            sum(call_merged_with_other_threads(squares, [10 * i + k for k in range(turn + 1)])) for turn in range(i + 1)
        )

    found = map_with_merged_calls(item, range(3))
    assert squares.asked == [[0, 10, 20], [10, 11, 20, 21], [20, 21, 22]]
    assert found == [0, 100 + 100 + 121, 400 + 400 + 441 + 400 + 441 + 484]


def test_more_items_than_are_at_work_at_once_and_two_functions():
    squares, others = Answers(), Answers()
    found = map_with_merged_calls(
        lambda i: call_merged_with_other_threads(others if i % 2 else squares, [i])[0], range(20)
    )
    assert found == [i * i for i in range(20)]
    assert (squares.asked[0], others.asked[0]) == ([0, 2, 4, 6], [1, 3, 5, 7])
    assert sorted(x for group in squares.asked + others.asked for x in group) == list(range(20))


def test_items_with_many_questions_do_not_all_wait_at_once():
    squares = Answers()
    map_with_merged_calls(lambda i: call_merged_with_other_threads(squares, 6 * [i]), range(9), 6)
    assert squares.asked == [6 * [i] + 6 * [i + 1] + 6 * [i + 2] for i in (0, 3, 6)]


def test_outside_and_within_an_item_one_asks_as_usual():
    squares = Answers()
    assert call_merged_with_other_threads(squares, [3]) == [9]

    def inner(_: int) -> list[int]:
        return map_with_merged_calls(lambda j: call_merged_with_other_threads(squares, [j])[0], range(2))

    assert map_with_merged_calls(inner, range(2)) == [[0, 1], [0, 1]]
    assert squares.asked == [[3], [0, 0], [1, 1]]
    assert map_with_merged_calls(str, []) == []


@pytest.mark.parametrize("kind", [KeyError, KeyboardInterrupt])
def test_what_goes_wrong_is_said_where_the_map_was_called_and_leaves_nobody_waiting(kind):
    ended = []

    def refuses(questions: list[int]) -> list[int]:
        raise kind

    def item(i: int) -> None:
        try:
            call_merged_with_other_threads(refuses, [i])
        finally:
            ended.append(i)

    with pytest.raises(kind):
        map_with_merged_calls(item, range(3))
    assert sorted(ended) == [0, 1, 2]

    def fails(i: int) -> int:
        return call_merged_with_other_threads(Answers(), [i])[0] if i != 1 else int("item 1")

    with pytest.raises(ValueError, match="item 1"):
        map_with_merged_calls(fails, range(3))
