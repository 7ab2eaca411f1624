"""A sweep on a cluster: one job array of Slurm, whose jobs run a share of the members each and are requeued in time."""

from __future__ import annotations

import contextlib
import math
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from warpflag.base.exit_status import TERMINATED
from warpflag.base.output import missing
from warpflag.run.run_directory import RunError
from warpflag.run.stop import Stop
from warpflag.run.sweep.sweep import FINISHED, SweepRun, counted_members

__all__ = ["Jobs", "Share"]

# Share of a job's wall time that the members' measured times may fill: the rest is for those that take longer.
_USED = 0.8
_MOST_REQUEUES = 1000  # times a job may be requeued: no limit in practice


@dataclass(frozen=True)
class Jobs:
    """The job array of a sweep.

    Attributes:
        sweep: what it runs.
        seconds: wall time of a job [s].
        count: jobs; None: as many as keep the members' measured times within the wall time.
        workers: processes of a job; None: 1.
        device: of all workers; None: every GPU of the job in turn, or the CPU.
        movies: whether each member gets a movie.
        checkpoint_seconds: wall time between two checkpoints of a member [s]; None: that of `Run`.
        further: options of sbatch by name without dashes, such as partition or gres.
    """

    sweep: SweepRun
    seconds: float
    count: int | None = None
    workers: int | None = None
    device: str | None = None
    movies: bool = False
    checkpoint_seconds: float | None = None
    further: Mapping[str, str] = field(default_factory=dict)

    @property
    def notice(self) -> int:
        """How long before the end of a job's wall time it is told to end [s]."""
        return max(10, min(120, round(0.1 * self.seconds)))

    def jobs(self) -> int:
        """Jobs of the array, at most one per member."""
        pending = [k for k, status in enumerate(self.sweep.statuses()) if status not in FINISHED]
        count = self.count
        if count is None and pending:
            with Stop() as stop:
                cost = self.sweep.seconds_per_member(pending, self.device, stop)
            count = math.ceil(len(pending) * cost / ((self.workers or 1) * _USED * self.seconds))
        return max(1, min(count or 1, len(self.sweep.members)))

    def command(self, share: str) -> list[str]:
        """What a job runs.

        Args:
            share: K/N, its share of the members.
        """
        given: list[str] = ["--workers", str(self.workers or 1)]
        given += ["--device", self.device] if self.device else []
        given += ["--movies"] if self.movies else []
        if self.checkpoint_seconds is not None:
            given += ["--checkpoint-interval", f"{self.checkpoint_seconds:g}"]
        directory = str(self.sweep.directory.resolve())
        return [sys.executable, "-m", "warpflag", "sweep", "--resume", directory, "--share", share, "--quiet", *given]

    def script(self) -> str:
        """The script for sbatch.

        It is told to end by USR1 in time and requeued with what is left; so is a job that is preempted.
        """
        count = self.jobs()
        directory = self.sweep.directory.resolve()
        options = {
            "job-name": self.sweep.sweep.name,
            "array": f"0-{count - 1}",
            "time": slurm_time(self.seconds),
            "signal": f"B:USR1@{self.notice}",
            "cpus-per-task": str(self.workers or 1),
            "output": str(directory).replace("%", "%%") + "/slurm-%A_%a.log",
            "open-mode": "append",
            **self.further,
        }
        lines = [f"#SBATCH --{name}={shlex.quote(value)}" for name, value in options.items()]
        share = f'--share "$SLURM_ARRAY_TASK_ID/{count}" --quiet'
        command = shlex.join(self.command("SHARE")).replace("--share SHARE --quiet", share)
        return "\n".join(
            [
                "#!/bin/bash",
                *lines,
                "#SBATCH --requeue",
                "",
                f"{command} &",
                "sweep=$!",
                "trap 'kill -USR1 $sweep' USR1 TERM",
                "wait $sweep; status=$?",
                "while kill -0 $sweep 2> /dev/null; do wait $sweep; status=$?; done",
                f'[ $status = {TERMINATED} ] && scontrol requeue "$SLURM_JOB_ID"',
                "exit $status",
                "",
            ]
        )

    def submit(self) -> str:
        """Submits the array through submitit; returns what to tell the user.

        Raises:
            RunError: submitit is missing, or Slurm refuses the jobs.
        """
        try:
            import submitit  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise RunError(f"--slurm needs submitit: {missing('submitit', 'slurm')}") from None
        directory, count = self.sweep.directory, self.jobs()
        options: dict[str, Any] = {
            "name": self.sweep.sweep.name,
            "timeout_min": max(1, math.ceil(self.seconds / 60)),
            "cpus_per_task": self.workers or 1,
            "slurm_signal_delay_s": self.notice,
            "slurm_additional_parameters": {"requeue": True, **self.further},
        }
        try:
            executor = submitit.AutoExecutor(
                folder=str(directory.resolve() / "slurm"), cluster="slurm", slurm_max_num_timeout=_MOST_REQUEUES
            )
            executor.update_parameters(**options)
            with executor.batch():
                jobs = [executor.submit(Share(tuple(self.command(f"{k}/{count}")))) for k in range(count)]
            name = jobs[0].job_id.split("_")[0]
        except (RuntimeError, OSError, subprocess.CalledProcessError) as error:  # FailedJobError is of the first
            raise RunError(f"--slurm: {' '.join(str(error).split())}") from None
        members = f"{self.sweep.sweep.name}: {counted_members(len(self.sweep.members))}"
        return (
            f"{members} in {count} jobs of {slurm_time(self.seconds)}, array {name}; "
            f"when they are done, warpflag sweep --resume {directory} writes the table"
        )


@dataclass
class Share:
    """What a job of submitit runs: a share of a sweep in a process of its own.

    Attributes:
        command: of the process.
    """

    command: tuple[str, ...]

    def __call__(self) -> int:
        """Runs the share; returns its exit status."""
        self._process = subprocess.Popen(self.command, start_new_session=True)
        status = self._process.wait()
        if status not in (0, 3):
            raise RuntimeError(f"the sweep ended with status {status}")
        return status

    def checkpoint(self) -> Any:
        """Called by submitit shortly before the end of the wall time: what is to be queued again."""
        import submitit  # pyright: ignore[reportMissingImports]

        # Called from a signal handler while `__call__` waits: the process is watched past Popen, whose lock it holds.
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(self._process.pid, signal.SIGTERM)
            os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        return submitit.helpers.DelayedSubmission(Share(self.command))


def slurm_time(seconds: float) -> str:
    """A wall time as sbatch takes it, whole minutes up: days-hours:minutes:00."""
    minutes = math.ceil(seconds / 60)
    days, rest = divmod(minutes, 1440)
    return f"{days}-{rest // 60:02d}:{rest % 60:02d}:00" if days else f"{rest // 60:02d}:{rest % 60:02d}:00"
