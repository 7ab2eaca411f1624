"""The workers of a sweep as seen from the sweep: processes that take batches one after another."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any

from warpflag.base.forked import Forked, Starter
from warpflag.base.threads import ONE_THREAD
from warpflag.run.member import Outcome
from warpflag.run.stop import Stop
from warpflag.run.sweep.batches import Batch
from warpflag.scene import Scene, dumps

__all__ = ["HANDED_BACK", "WORTH_SHARING", "Pool", "Worker"]

_SECONDS_PER_LOOK = 0.1  # at the workers: a moment for a person, nothing beside a member
_MODULE = "warpflag.run.sweep.worker"
HANDED_BACK = "handed back"
"""Status of members that a worker has given up so that others can take them."""
WORTH_SHARING = 2.0
"""Seconds that a batch still takes from which on it is shared with a worker that has none left: what that costs,
four times."""


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Processes that are started meanwhile begin with SIGINT blocked, on systems that can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Worker:
    """One worker: the process, and the thread that talks with it.

    Args:
        device: of its runs.
        starter: what forks its process; None: it is started anew.

    Attributes:
        reached: simulated time that the members of its batch have reached together [s].
        members_left: of its batch that still go on.
        seconds_left: wall time that they will take [s]; 0 while that is not known.
        thread: that talks with the process.
        batch: number of the batch that it runs; None: it has nothing to do.
        asked: whether it was asked to hand that back.
    """

    def __init__(self, device: str, starter: Starter | None) -> None:
        self.device, self.reached, self.members_left, self.seconds_left = device, 0.0, 0, 0.0
        self.thread: threading.Thread | None = None
        self.batch: int | None = None
        self.asked = False
        self._starter = starter
        self.process = self._started()

    def _started(self) -> Forked | subprocess.Popen[str]:
        if self._starter is not None:
            with contextlib.suppress(OSError):
                return self._starter.fork()
        # In a session of its own: Ctrl-C reaches the sweep alone, which then ends its workers in order. An interrupt
        # waits until the worker can take it: Python would answer it with a traceback before.
        with _interrupts_blocked():
            return subprocess.Popen(
                [sys.executable, "-m", _MODULE],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                env={**ONE_THREAD, **os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
                start_new_session=True,
            )

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request; {"outcomes": None} where the process has ended."""
        process = self.process
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                answer = json.loads(line)
                if "reached" not in answer:
                    return answer
                self.reached, self.members_left = answer["reached"], answer["members_left"]
                self.seconds_left = answer["seconds_left"]
        except (BrokenPipeError, ValueError):
            pass
        return {"outcomes": None}

    def hand_back(self) -> None:
        """Has it end its batch resumable, the members that are done excepted."""
        self.asked = True
        with contextlib.suppress(OSError, ValueError):  # it has ended, which its thread finds as well
            assert self.process.stdin is not None
            self.process.stdin.write(json.dumps({"hand_back": self.batch}) + "\n")
            self.process.stdin.flush()

    def restart(self) -> str:
        """Starts a process anew; returns how the one before it ended."""
        status = self.process.wait()
        self.process = self._started()
        return f"its worker ended with status {status}" if status >= 0 else f"its worker ended by signal {-status}"

    def close(self) -> None:
        """Ends the process."""
        process = self.process
        if process.stdin is not None:
            process.stdin.close()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


class Pool:
    """Workers, one per device given; `start` starts them, and the end of a `with` block ends them.

    Args:
        devices: of the workers.
        options: of the runs: movies and checkpoint_seconds.
        starter: what forks workers on the CPU; ended with the block, too.
        worker: makes one of a device and a starter.
    """

    def __init__(
        self,
        devices: Sequence[str],
        options: Mapping[str, Any],
        starter: Starter | None = None,
        worker: Callable[[str, Starter | None], Any] = Worker,
    ) -> None:
        self.devices, self._options, self._starter, self._worker = list(devices), dict(options), starter, worker
        self._queue: queue.Queue[tuple[int, Batch]] = queue.Queue()
        self._finished: queue.Queue[tuple[Batch, list[Outcome], float]] = queue.Queue()
        self._open, self._submitted, self._done_time, self._ending = 0, 0, 0.0, ""
        self._workers: list[Worker] = []
        self._batch_ended = threading.Event()

    def __enter__(self) -> Pool:
        return self

    def start(self, scene: Scene, stop: Stop, quiet: bool = False) -> None:
        """Starts the workers; those on the CPU begin with the kernels of a scene loaded.

        Args:
            scene: of one of the members.
            stop: what may end it before its time.
            quiet: say nothing while kernels are compiled.
        """
        starter = None
        if set(self.devices) == {"cpu"} and Starter.works():
            starter = self._starter = self._starter or Starter(_MODULE)
            stop.at_once = True
            try:
                starter.prepare({"scene": dumps(scene), "quiet": quiet})
            except OSError:  # each worker by itself, which tells what is wrong
                starter = None
            finally:
                stop.at_once = False
        self._workers = [self._worker(device, starter) for device in self.devices]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.is_done:
            self.end("terminated")
        self._ending = self._ending or "done"
        for worker in self._workers:
            worker.close()
        if self._starter is not None:
            self._starter.close()

    @property
    def is_done(self) -> bool:
        """Whether every batch that was submitted has been handed out by `finished`."""
        return self._open == 0

    @property
    def idle(self) -> int:
        """How many workers have nothing to do."""
        return sum(worker.batch is None for worker in self._workers)

    @property
    def reached(self) -> float:
        """Simulated time that all members have reached [s]."""
        return self._done_time + sum(worker.reached for worker in self._workers)

    def measure(self, sample: Sequence[Scene], stop: Stop) -> float:
        """Time per cell of its start and of its run [s], of scenes advanced together.

        On the CPU it is computing time, which what else the machine does leaves alone. A sample that can't be run
        costs nothing: one by one, each member tells what is wrong.
        """
        worker = self._workers[0]
        request = {"measure": [dumps(scene) for scene in sample], "device": worker.device, "quiet": False}
        stop.at_once = True
        try:
            return worker.ask(request).get("seconds", 0.0)
        finally:
            stop.at_once = False

    def submit(self, batch: Batch) -> None:
        """Queues a batch; the workers begin with the first."""
        self._open += 1
        self._submitted += 1
        self._queue.put((self._submitted, batch))
        for worker in self._workers:
            if worker.thread is None:
                worker.thread = threading.Thread(target=self._serve, args=(worker,), daemon=True)
                worker.thread.start()

    def finished(self) -> list[tuple[Batch, list[Outcome]]]:
        """Batches that have ended since the last call, and how each of their members ended.

        Members that are `HANDED_BACK` go on where they were once they are submitted again.
        """
        found = []
        while not self._finished.empty():
            batch, outcomes, reached = self._finished.get()
            found.append((batch, outcomes))
            done = [scene.duration for scene, own in zip(batch.scenes, outcomes, strict=True) if own.status == "done"]
            self._done_time += max(sum(done), reached)  # a member that was stopped has come as far as it was seen
            self._open -= 1
        return found

    def balance(self) -> None:
        """Has the batch that will end last handed back, where a worker has nothing left to do and that is worth it.

        Only then: a batch loses what starts and ends it, some tenths of a second, and nothing is lost where all
        workers end together.
        """
        if not self.idle or not self._queue.empty() or any(w.asked and w.batch is not None for w in self._workers):
            return
        shared = [w for w in self._workers if w.members_left > 1 and w.seconds_left > WORTH_SHARING]
        if shared:
            max(shared, key=lambda worker: worker.seconds_left).hand_back()

    def wait(self) -> None:
        """Waits for a moment, or until a batch has ended."""
        self._batch_ended.wait(_SECONDS_PER_LOOK)
        self._batch_ended.clear()

    def end(self, status: str) -> None:
        """Ends all workers resumable.

        Args:
            status: interrupted or terminated.
        """
        self._ending = status
        number = signal.SIGINT if status == "interrupted" else signal.SIGTERM
        for worker in self._workers:
            worker.process.send_signal(number)
        for worker in self._workers:
            if worker.thread is not None:
                worker.thread.join()

    def _serve(self, worker: Worker) -> None:
        """Hands batches to a worker until none is left."""
        while not self._ending:
            try:
                worker.batch, batch = self._queue.get(timeout=_SECONDS_PER_LOOK)
            except queue.Empty:
                continue
            worker.asked = False
            request = {
                "batch": worker.batch,
                "directories": [str(directory) for directory in batch.directories],
                "scenes": [dumps(scene) for scene in batch.scenes],
                "device": worker.device,
                "options": self._options,
            }
            outcomes = worker.ask(request)["outcomes"]
            if outcomes is None and not self._ending:
                outcomes = [["failed", worker.restart()]] * len(batch.members)
            elif outcomes is None:
                outcomes = [[self._ending, ""]] * len(batch.members)
            reached = worker.reached
            if worker.asked and not self._ending:
                outcomes = [[HANDED_BACK, ""] if own[0] == "terminated" else own for own in outcomes]
                reached = 0.0  # those who take them up tell how far they are
            worker.reached, worker.members_left, worker.seconds_left, worker.asked = 0.0, 0, 0.0, False
            worker.batch = None
            self._finished.put((batch, [Outcome(*outcome) for outcome in outcomes], reached))
            self._batch_ended.set()
