"""Processes that begin prepared: one process imports a module and loads its kernels, and is forked for each of them.

A worker on the CPU is ready 2 s earlier than one that is started anew, and shares the memory of what was loaded. The
process that is forked has one thread and sees no GPU, whose driver does not survive a fork.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from typing import IO, Any

from warpflag.base.threads import ONE_THREAD

__all__ = ["Forked", "Starter"]

_SIGNALS = [
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")
    if hasattr(signal, name)
]
_LONGEST_ANSWER = 1 << 16  # bytes of an answer
_LENGTH_DIGITS = 12  # of the length of a request


class Starter:
    """A process that imports a module and forks processes that run the module's `main`.

    It starts to import at once, beside whatever this process does meanwhile.

    Args:
        module: name of the module. Its `prepare`, of what `prepare` below is given, loads what all processes need.

    Attributes:
        process: that forks.
        connection: the socket on which it is asked; it ends when that is closed.
    """

    def __init__(self, module: str) -> None:
        own, other = socket.socketpair()
        command = [sys.executable, "-m", "warpflag.base.forked", module]
        hidden = {"CUDA_VISIBLE_DEVICES": ""}
        path = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        self.process = subprocess.Popen(
            command,
            stdin=other.fileno(),
            stdout=2,
            env={**ONE_THREAD, **os.environ, **path, **hidden},
            start_new_session=True,
        )
        other.close()
        self.connection, self._lock, self._preparing = own, threading.Lock(), False

    @staticmethod
    def works() -> bool:
        """Whether this system forks processes and passes them open files."""
        return hasattr(os, "fork") and hasattr(socket, "send_fds")

    def begin(self, given: Any) -> None:
        """Has the process call the module's `prepare` as soon as it is imported, and does not wait for it.

        Args:
            given: what JSON can hold.

        Raises:
            OSError: the process has ended.
        """
        with self._lock:
            self._send({"prepare": given})
            self._preparing = True

    def prepare(self, given: Any) -> None:
        """Returns once the module's `prepare` is through: of what `begin` was given, or else of this.

        Raises:
            OSError: the process has ended.
        """
        if not self._preparing:
            self.begin(given)
        with self._lock:
            self._preparing = False
            self._answer()

    def fork(self) -> Forked:
        """A new process, with pipes for its standard input and output.

        Raises:
            OSError: the process that is forked has ended.
        """
        (its_input, requests), (answers, its_output) = os.pipe(), os.pipe()
        try:
            number = self._ask({"fork": None}, (its_input, its_output))
        except BaseException:
            os.close(requests)
            os.close(answers)
            raise
        finally:
            os.close(its_input)
            os.close(its_output)
        return Forked(self, int(number), requests, answers)

    def waited(self, number: int) -> int:
        """Waits for a process that `fork` gave; its exit status, or minus the signal that ended it."""
        return int(self._ask({"wait": number}))

    def close(self) -> None:
        """Ends the process; those that it has started go on."""
        with contextlib.suppress(OSError):
            self.process.kill()  # before its answer can find the socket closed
        self.process.wait()
        self.connection.close()

    def _ask(self, request: dict[str, Any], files: tuple[int, ...] = ()) -> Any:
        with self._lock:
            self._send(request, files)
            return self._answer()

    def _send(self, request: dict[str, Any], files: tuple[int, ...] = ()) -> None:
        content = json.dumps(request).encode()
        socket.send_fds(self.connection, [f"{len(content):{_LENGTH_DIGITS}d}".encode()], files)
        self.connection.sendall(content)

    def _answer(self) -> Any:
        if not (answer := self.connection.recv(_LONGEST_ANSWER)):
            raise ConnectionError("the process that starts workers has ended")
        return json.loads(answer)


class Forked:
    """A process that a `Starter` has forked, as `subprocess.Popen` has it.

    Attributes:
        pid: of the process.
        stdin: its standard input, to write text to.
        stdout: its standard output, to read text from.
    """

    def __init__(self, starter: Starter, pid: int, requests: int, answers: int) -> None:
        self._starter, self.pid = starter, pid
        self.stdin: IO[str] | None = os.fdopen(requests, "w", encoding="utf-8")
        self.stdout: IO[str] | None = os.fdopen(answers, encoding="utf-8")
        self._status: int | None = None

    def wait(self) -> int:
        """Its exit status, or minus the signal that ended it."""
        if self._status is None:
            try:
                self._status = self._starter.waited(self.pid)
            except OSError:  # with the starter goes what it knew
                self._status = 1
        return self._status

    def send_signal(self, number: int) -> None:
        """Sends it a signal, unless it was waited for already."""
        if self._status is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)


def _serve(module: Any) -> None:
    """Answers requests on the standard input, a socket, until it is closed; returns in the processes forked."""
    own = socket.socket(fileno=os.dup(0))
    while True:
        try:
            size, files, _, _ = socket.recv_fds(own, _LENGTH_DIGITS, 2)
            content = b""
            while size and len(content) < int(size):
                content += own.recv(int(size) - len(content)) or os._exit(0)
        except ConnectionResetError:  # the process that asks was killed before it took an answer
            os._exit(0)
        if not size:
            os._exit(0)
        request = json.loads(content)
        answer: Any = None
        if "prepare" in request:
            module.prepare(request["prepare"])
            gc.freeze()  # what was loaded is never copied for the collector's sake
        elif "wait" in request:
            _, status = os.waitpid(request["wait"], 0)
            answer = os.waitstatus_to_exitcode(status)
        elif (answer := _fork()) == 0:
            own.close()
            for number, file in enumerate(files):
                os.dup2(file, number)
            for file in files:
                os.close(file)
            os.setsid()
            for signum in _SIGNALS:
                signal.signal(signum, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
            gc.enable()
            return
        for file in files:
            os.close(file)
        try:
            own.sendall(json.dumps(answer).encode())
        except OSError:  # the process that asked has ended
            os._exit(0)


def _fork() -> int:
    """As `os.fork`, of this thread alone; signals are blocked in the new process."""
    for thread in threading.enumerate():
        if thread is not threading.current_thread():
            thread.join()  # what compiled kernels is about to end
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # until the new process can take them
    number = os.fork()
    if number:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    return number


def main() -> None:
    """The process of a `Starter`; the processes that it forks leave it and run the module's `main`."""
    for number in _SIGNALS:  # it ends with the process that started it, and by nothing else
        signal.signal(number, lambda *_: None)
    gc.disable()  # what is imported stays
    module = importlib.import_module(sys.argv[1])
    _serve(module)
    module.main()
    sys.stdout.flush()
    os._exit(0)  # its work is done; taking apart what was loaded takes a tenth of a second


if __name__ == "__main__":
    main()
