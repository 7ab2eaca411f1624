"""The workers of a sweep: how they end, and batches that they hand back so that idle ones can share them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.runs import assert_same_frames, small, summary
from warpflag.run import run, sweep
from warpflag.run.stop import Stop
from warpflag.run.sweep import Sweep, batches, pool, worker
from warpflag.scene import dumps


class Scripted:
    """A worker whose batches run until they are handed back or let go; of each the last member is then not done."""

    def __init__(self, device, starter):
        self.device, self.reached, self.members_left, self.seconds_left = device, 0.0, 0, 0.0
        self.thread, self.batch, self.asked, self.process = None, None, False, SimpleNamespace(send_signal=self.let_go)
        self.begun, self.ended, self.takes = threading.Event(), threading.Event(), []

    def ask(self, request):
        self.takes.append(request["directories"])
        self.begun.set()
        self.ended.wait(30.0)
        self.ended.clear()
        self.begun.clear()
        last = "terminated" if self.asked else "done"
        return {"outcomes": [["done", ""]] * (len(request["directories"]) - 1) + [[last, ""]]}

    def hand_back(self):
        self.asked = True
        self.ended.set()

    def let_go(self, _number=0):
        self.ended.set()

    def close(self):
        self.ended.set()


def batch(*members: int) -> batches.Batch:
    return batches.Batch(members, [Path(str(k)) for k in members], [small()] * len(members))


def until_idle(workers: pool.Pool, count: int) -> list:
    """What has finished once so many workers have nothing to do."""
    found = []
    while workers.idle != count:
        workers.wait()
    while not (ended := workers.finished()):
        workers.wait()
    return found + ended


def test_members_that_one_simulation_can_advance_are_of_one_group(tmp_path):
    """Those that differ in precision, stepper or terms, or that have begun, are of others."""
    values = [{}, {"motor.torque": 1.0}, {"numerics.precision": "float32"}, {"numerics.stepper": "rkc"}]
    scenes = [small(own) for own in (*values, {"steric.enabled": False}, {})]
    directories = [tmp_path / str(k) for k in range(6)]
    directories[5].mkdir()
    (directories[5] / "scene.toml").write_text(dumps(scenes[5]))
    assert batches.groups(scenes, directories, range(6)) == [[0, 1], [2], [3], [4], [5]]


def test_the_batch_that_ends_last_is_handed_back_where_it_is_worth_it():
    made: list[Scripted] = []

    def worker(device, starter):
        made.append(Scripted(device, starter))
        return made[-1]

    with pool.Pool(["here", "there", "elsewhere"], {}, worker=worker) as workers, Stop() as stop:
        workers.start(small(), stop)
        for members in ((0, 1), (2, 3), (4, 5)):
            workers.submit(batch(*members))
        for own in made:
            assert own.begun.wait(30.0)
            own.members_left, own.seconds_left = 2, 3.0 * pool.WORTH_SHARING
        workers.balance()
        assert not any(own.asked for own in made)  # every worker has something to do
        short, longer, longest = made
        short.let_go()
        assert [outcome.status for outcome in until_idle(workers, 1)[0][1]] == ["done", "done"]
        longer.seconds_left, longest.seconds_left = 0.9 * pool.WORTH_SHARING, 0.5 * pool.WORTH_SHARING
        workers.balance()
        assert not any(own.asked for own in made)  # they end soon
        longer.seconds_left = 2.0 * pool.WORTH_SHARING
        longest.members_left, longest.seconds_left = 1, 9.0 * pool.WORTH_SHARING
        workers.balance()  # a single member can't be shared
        ((given, outcomes),) = until_idle(workers, 2)
        assert given.directories == [Path(name) for name in longer.takes[0]]
        assert [outcome.status for outcome in outcomes] == ["done", pool.HANDED_BACK]
        assert not longer.asked and longer.members_left == 0 and not workers.is_done
        workers.submit(batch(given.members[-1]))
        while workers.idle != 1:
            workers.wait()
        for own in (short, longer, longest):
            own.let_go()
        while not workers.is_done:
            workers.wait()
            workers.finished()
        taken = {tuple(names) for own in made for names in own.takes}
        assert taken == {("0", "1"), ("2", "3"), ("4", "5"), (given.directories[-1].name,)}


def test_members_that_are_handed_back_and_dealt_out_anew_end_as_in_one_process(tmp_path, monkeypatch):
    asked = []
    hand_back = pool.Worker.hand_back
    monkeypatch.setattr(pool.Worker, "hand_back", lambda self: asked.append(self.members_left) or hand_back(self))
    monkeypatch.setattr(pool, "WORTH_SHARING", -1.0)  # whatever it takes
    axes = {"duration": [8e-3, 4e-5, 8e-5, 9e-3]}  # one worker gets the first and the last
    base = small({"frames": 100})
    outcome = sweep.start(Sweep(base, axes), str(tmp_path / "two")).execute(workers=2, quiet=True)
    assert outcome.status == "done" and asked and set(asked) == {2}
    monkeypatch.setattr(pool, "WORTH_SHARING", 1e9)
    asked.clear()
    assert sweep.start(Sweep(base, axes), str(tmp_path / "one")).execute(workers=1, quiet=True).status == "done"
    assert not asked
    assert (tmp_path / "two/table.csv").read_bytes() == (tmp_path / "one/table.csv").read_bytes()
    for name in ("0000", "0003"):
        assert_same_frames(tmp_path / "two" / name, tmp_path / "one" / name)


def test_a_worker_hands_back_what_is_not_done_with_the_bits_of_single_runs(tmp_path):
    scenes = [
        small({"duration": d, "frames": 200, "motor.torque": t}) for d, t in ((8e-5, 2.0), (60e-3, 3.0), (55e-3, 1.0))
    ]
    directories = [tmp_path / f"{k}" for k in range(3)]
    process = subprocess.Popen(
        [sys.executable, "-m", "warpflag.run.sweep.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None and process.stdout is not None

    def say(request) -> None:
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()

    def ended(members, batch) -> list[str]:
        given = {"directories": [str(directories[k]) for k in members], "scenes": [dumps(scenes[k]) for k in members]}
        options = {"strict": True, "movies": False, "checkpoint_seconds": None}
        say({"batch": batch, "device": "cpu", "options": options, **given})
        for line in process.stdout:
            answer = json.loads(line)
            if "outcomes" in answer:
                return [status for status, _ in answer["outcomes"]]
            assert 0 <= answer["members_left"] <= 3 and answer["seconds_left"] >= 0.0
            if answer["members_left"] == 2 and batch == 1:
                say({"hand_back": 7})  # another batch
                say({"hand_back": 1})
        raise AssertionError("the worker has ended")

    assert ended((0, 1, 2), 1) == ["done", "terminated", "terminated"]
    assert ended((1,), 2) == ["done"]
    assert ended((2,), 3) == ["done"]
    process.stdin.close()
    process.wait()
    process.stdout.close()
    for scene, directory in zip(scenes, directories, strict=True):
        alone = tmp_path / f"alone-{directory.name}"
        run.start_batch([scene], [alone], "cpu", strict=True, movies=False).execute_all(quiet=True)
        assert_same_frames(alone, directory)
        for name in ("steps", "rejected_steps", "evaluations", "observables", "rates", "accuracy"):
            assert summary(alone)[name] == summary(directory)[name]


def test_a_worker_ends_with_a_sweep_that_is_killed_in_the_middle_of_a_request():
    """A batch is longer than a pipe holds, so that a killed sweep may leave a part of one."""
    worker = [sys.executable, "-m", "warpflag.run.sweep.worker"]
    subprocess.run(worker, input='{"batch": 1, "directories": ["a', text=True, stdout=subprocess.PIPE, timeout=120.0)


@pytest.mark.parametrize(("seen", "expected"), [(0.0, 8e-5), (5e-5, 8e-5), (1.2e-4, 1.2e-4)])
def test_members_that_ended_count_with_all_that_they_reached(seen, expected):
    """Whatever their worker last said of a batch: one is done, the other was stopped."""

    class Instant:
        """A worker that ends a batch at once."""

        def __init__(self, device, starter):
            self.device, self.reached, self.thread, self.batch, self.asked = device, 0.0, None, None, False

        def ask(self, request):
            self.reached = seen
            return {"outcomes": [["done", ""], ["stopped", "by a guard"]]}

        def close(self):
            pass

    scenes = [small(), small()]
    with pool.Pool(["somewhere"], {}, worker=Instant) as workers, Stop() as stop:
        workers.start(scenes[0], stop)
        workers.submit(batches.Batch([0, 1], [Path("0"), Path("1")], scenes))
        ended = []
        while not workers.is_done:
            workers.wait()
            ended += workers.finished()
        assert [outcome.status for outcome in ended[0][1]] == ["done", "stopped"]
        assert workers.reached == pytest.approx(expected)


@pytest.mark.parametrize(("status", "number"), [("interrupted", signal.SIGINT), ("terminated", signal.SIGTERM)])
def test_workers_end_as_the_sweep_does(status, number):
    """By the signal that makes their members say the same."""
    made = []

    class Running:
        """A worker that runs a batch until it gets a signal."""

        def __init__(self, device, starter):
            self.device, self.reached, self.thread, self.process = device, 0.0, None, self
            self.batch, self.asked, self.begun, self.ended, self.signals = (
                None,
                False,
                threading.Event(),
                threading.Event(),
                [],
            )
            made.append(self)

        def ask(self, request):
            self.begun.set()
            self.ended.wait(30.0)
            return {"outcomes": None}

        def send_signal(self, number):
            self.signals.append(number)
            self.ended.set()

        def close(self):
            pass

    with pool.Pool(["somewhere"], {}, worker=Running) as workers, Stop() as stop:
        workers.start(small(), stop)
        workers.submit(batches.Batch([0], [Path("0")], [small()]))
        assert made[0].begun.wait(30.0)
        workers.end(status)
        ((_, outcomes),) = workers.finished()
    assert made[0].signals == [number] and [outcome.status for outcome in outcomes] == [status]


def test_a_batch_costs_what_its_longest_member_takes(monkeypatch):
    """A simulation that takes a second to begin and one for every 10 us; told per member."""
    clock = [0.0]

    class Timed:
        def __init__(self, *_, **__):
            self.time = 0.0

        def prepare(self):
            clock[0] += 1.0

        def advance(self, until):
            clock[0] += (until - self.time) / 1e-5
            self.time = until

    monkeypatch.setattr(worker, "Simulation", Timed)
    monkeypatch.setattr(worker, "process_time", lambda: clock[0])
    scenes = [small({"duration": duration}) for duration in (4e-5, 2e-4)]
    assert worker.cost(scenes, "cpu") == pytest.approx((1.0 + 20.0) / 2)
