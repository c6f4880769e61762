"""Signals end a run: at once, where they were swallowed, and where a call does not come back."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from yid_ocp import interruption

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as on POSIX")

HEAD = """
import signal, sys, time
from pathlib import Path
from yid_ocp import interruption
interruption._RERAISE_INTERVAL, interruption._FORCED_EXIT_DELAY = 0.2, {last}
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored, as nohup has SIGHUP
signal.signal(signal.SIGHUP, signal.SIG_DFL)
folder = Path(sys.argv[1])
folder.mkdir()
try:
    with interruption.raise_on_termination_signals(), interruption.remove_folder_on_forced_exit(folder):
{body}
except interruption.InterruptedBySignal as error:
    print("ENDED", error, flush=True)
    sys.exit(128 + error.signal_number)
"""


READY = "print('READY', flush=True)"


def ended(tmp_path, body, number, last=5.0):
    """Exit code, what was printed, and whether the folder is still there."""
    text = HEAD.format(body="\n".join(" " * 8 + line for line in body.splitlines()), last=last)
    folder = tmp_path / "folder"
    process = subprocess.Popen([sys.executable, "-c", text, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().strip() == "READY"
    process.send_signal(number)
    out, _ = process.communicate(timeout=30)
    return process.returncode, out.strip(), folder.exists()


SWALLOWING = f"try:\n    {READY}\n    time.sleep(20)\nexcept BaseException:\n    pass\n"


@pytest.mark.parametrize(
    ("body", "name"),
    [
        *((f"{READY}\ntime.sleep(20)", name) for name in ("SIGINT", "SIGTERM", "SIGHUP")),
        pytest.param(f"{SWALLOWING}time.sleep(20)", "SIGINT", id="swallowed, raised again"),
        pytest.param(f"{SWALLOWING}interruption.raise_if_interrupted()\nprint('LOST')", "SIGTERM", id="looked for"),
    ],
)
def test_a_signal_is_raised_by_its_name_also_where_it_was_swallowed(tmp_path, body, name):
    number = getattr(signal, name)
    assert ended(tmp_path, body, number) == (128 + number, f"ENDED {name}", True)


def test_a_call_that_does_not_come_back_is_ended_by_force(tmp_path):
    stuck = f"while True:\n    try:\n        {READY}\n        time.sleep(20)\n    except BaseException:\n        pass"
    code, out, there = ended(tmp_path, stuck, signal.SIGTERM, last=0.8)
    assert (code, set(out.split()), there) == (143, {"READY"}, False)


@pytest.mark.parametrize("late", [0.0, 0.5])
def test_a_deferred_block_ends_first_also_where_the_signal_is_repeated_late(tmp_path, late):
    slow = f"kill = signal.pthread_kill\nsignal.pthread_kill = lambda *to: (time.sleep({late}), kill(*to))\n"
    deferring = f"with interruption.defer_interruption():\n    {READY}\n    time.sleep(1)\n    print('WHOLE', flush=1)"
    code, out, _ = ended(tmp_path, f"{slow}{deferring}\ntime.sleep(20)", signal.SIGINT)
    assert (code, out.split("\n")) == (130, ["WHOLE", "ENDED SIGINT"])


def test_handlers_are_put_back_and_a_second_use_is_new():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for _ in range(2):
        with pytest.raises(interruption.InterruptedBySignal), interruption.raise_on_termination_signals():
            signal.raise_signal(signal.SIGTERM)
        interruption.raise_if_interrupted()
    assert {number: signal.getsignal(number) for number in before} == before
    assert signal.set_wakeup_fd(-1) == -1


def test_other_threads_do_without():
    done = []

    def work():
        with interruption.raise_on_termination_signals():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]
