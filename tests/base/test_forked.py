"""Processes that are forked from one that is prepared."""

from __future__ import annotations

import os
import select
import signal
import threading
import time

import pytest

from warpflag.base.forked import Starter

pytestmark = pytest.mark.skipif(not Starter.works(), reason="a system without fork")
MODULE = """
import os, sys
loaded = []

def prepare(given):
    if given is None:
        os._exit(1)
    loaded.append((given, os.getpid()))

def main():
    for line in sys.stdin:
        if line.startswith("end"):
            sys.exit(int(line.split()[1]))
        print(line.strip(), os.getpid(), loaded, os.environ["CUDA_VISIBLE_DEVICES"] == "", flush=True)
"""


@pytest.fixture
def starter(tmp_path, monkeypatch):
    (tmp_path / "some_work.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    made = Starter("some_work")
    yield made
    made.close()


def soon(read):
    """What a call returns that reads from a pipe, which has to be before half a minute is over."""
    found = []
    reader = threading.Thread(target=lambda: found.append(read()), daemon=True)
    reader.start()
    reader.join(30.0)
    assert found, "nothing comes, and the pipe does not end"
    return found[0]


def ask(process, text):
    process.stdin.write(text + "\n")
    process.stdin.flush()
    return soon(process.stdout.readline)


def test_processes_share_what_was_prepared_once_and_end_by_themselves(starter):
    starter.prepare({"a": [1.5, "µm"] * 3000})  # longer than a buffer
    first, second = starter.fork(), starter.fork()
    answers = [ask(process, "here").split(maxsplit=2) for process in (first, second, first)]
    assert [int(answer[1]) for answer in answers] == [first.pid, second.pid, first.pid]
    assert len({answer[2] for answer in answers}) == 1 and "µm" in answers[0][2] and answers[0][2].endswith("True\n")
    ask(first, "end 7")
    assert first.wait() == 7 and first.wait() == 7
    second.send_signal(signal.SIGKILL)
    assert second.wait() == -signal.SIGKILL
    second.send_signal(signal.SIGKILL)  # nobody is there any more
    third = starter.fork()
    third.stdin.close()  # of the end of its input a process learns, though others were forked meanwhile
    assert third.wait() == 0 and soon(third.stdout.read) == ""


def test_what_it_has_begun_to_prepare_is_not_prepared_again(starter):
    starter.begin("early")
    starter.prepare("late")
    process = starter.fork()
    assert "early" in (said := ask(process, "here")) and "late" not in said
    starter.prepare("later")
    assert "later" in ask(starter.fork(), "here")


def test_a_process_outlives_its_starter_and_the_starter_no_signal_but_its_end(starter):
    process = starter.fork()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(starter.process.pid, number)
    other = starter.fork()  # it still starts processes
    process.send_signal(signal.SIGTERM)  # which take signals again
    assert process.wait() == -signal.SIGTERM
    starter.close()
    assert ask(other, "still").startswith("still")
    other.stdin.close()
    assert soon(other.stdout.read) == "" and other.wait() == 1  # nobody knows any more


def test_it_ends_in_order_when_who_asked_is_killed_before_it_took_the_answer(starter):
    starter.begin("early")
    assert select.select([starter.connection], [], [], 30.0)[0]
    starter.connection.close()  # as the end of the process does
    assert starter.process.wait(30.0) == 0


def test_a_starter_that_ended_is_an_error_of_the_machine(starter):
    with pytest.raises(OSError, match=r"ended|Connection"):
        starter.prepare(None)
    with pytest.raises(OSError, match=r"ended|Broken|Connection"):
        starter.fork()


def test_a_starter_ends_with_the_process_that_made_it(starter):
    starter.fork()
    starter.connection.close()
    for _ in range(100):
        if starter.process.poll() is not None:
            break
        time.sleep(0.05)
    assert starter.process.poll() == 0
