"""A sweep on a real Slurm, by hand: starts one on the loopback of this machine, runs a sweep of eight, and stops it.

    python tests/run/sweep/real_slurm.py [--script]

Needs root, slurmctld, slurmd and munged (apt: slurm-wlm, munge), and submitit unless --script is given, which submits
what `warpflag sweep --slurm-script` prints. The jobs have a minute each, which their members do not fit into, so that
they are requeued; the records and the table must be those of a sweep that was never stopped.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT), str(ROOT / "kernels")]

from tests.runs import assert_same_frames, small  # noqa: E402
from warpflag.scene import dumps  # noqa: E402

CONFIGURATION = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
CryptoType=crypto/munge
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
ReturnToService=2
KillWait=5
MessageTimeout=60
SelectType=select/cons_tres
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
SlurmctldPort=46817
SlurmdPort=46818
JobRequeue=1
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def started(folder: Path) -> list[subprocess.Popen]:
    """Munge, the controller and the node, on the loopback."""
    host = subprocess.run(["hostname", "-s"], capture_output=True, text=True, check=True).stdout.strip()
    for name in ("munge", "state", "spool"):
        (folder / name).mkdir()
    key = folder / "munge" / "key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    subprocess.run(["chown", "-R", "munge:munge", str(folder / "munge")], check=True)
    folder.chmod(0o755)
    (folder / "munge").chmod(0o755)
    (folder / "slurm.conf").write_text(CONFIGURATION.format(host=host, folder=folder))
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    place = folder / "munge"
    munge = ["munged", "-F", f"--key-file={key}", f"--socket={place}/socket", f"--pid-file={place}/pid"]
    munge += [f"--log-file={place}/log", f"--seed-file={place}/seed", "--num-threads=2"]
    commands = [["setpriv", "--reuid=munge", "--regid=munge", "--clear-groups", *munge]]
    commands += [["slurmctld", "-D", "-c"], ["slurmd", "-D", "-N", host]]
    processes = []
    for command in commands:
        log = open(folder / f"{command[0]}.out", "w")  # noqa: SIM115
        processes.append(subprocess.Popen(command, stdout=log, stderr=log))
        time.sleep(3.0)
    until = time.monotonic() + 60
    while "idle" not in said("sinfo", "-h", "-o", "%T"):
        assert time.monotonic() < until, f"Slurm did not come up: see {folder}"
        time.sleep(1.0)
    return processes


def said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, env=environment()).stdout


def environment() -> dict[str, str]:
    paths = os.pathsep.join([str(ROOT), str(ROOT / "kernels")])
    return {**os.environ, "PYTHONPATH": paths}


def sweep(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "warpflag", "sweep", *arguments]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment())
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    print(folder, flush=True)
    # Two jobs of four members each; a member takes some twenty seconds of a core.
    (folder / "base.toml").write_text(
        dumps(small({"duration": float(os.environ.get("SECONDS_SIMULATED", "1.0")), "frames": 2000}))
    )
    (folder / "sweep.toml").write_text(
        'base = "base.toml"\n[axes]\nmotor.torque = { from = 0.5, to = 3.0, count = 8 }\n'
    )
    processes = started(folder)
    try:
        options = ("--jobs", "2", "--time", "1:00")
        if "--script" in sys.argv:
            (folder / "job.sh").write_text(sweep(folder, "sweep.toml", "-o", "jobs", "--slurm-script", *options))
            print(said("sbatch", str(folder / "job.sh")), end="", flush=True)
        else:
            print(sweep(folder, "sweep.toml", "-o", "jobs", "--slurm", *options), end="", flush=True)
        restarts: set[str] = set()
        began = time.monotonic()
        while said("squeue", "-h").strip():
            restarts |= set(re.findall(r"JobId=(\d+).*?Restarts=([1-9]\d*)", said("scontrol", "show", "job", "-o")))
            time.sleep(2.0)
            assert time.monotonic() - began < 1800, "the jobs did not end"
        print(f"the jobs took {time.monotonic() - began:.0f} s; requeued: {sorted(restarts)}", flush=True)
        print(sweep(folder, "--resume", "jobs"), end="", flush=True)
    finally:
        for process in reversed(processes):
            process.send_signal(signal.SIGTERM)
            process.wait()
    print(sweep(folder, "sweep.toml", "-o", "undisturbed", "--workers", "2", "--quiet"), end="")
    for k in range(8):
        assert_same_frames(folder / "undisturbed" / f"{k:04d}", folder / "jobs" / f"{k:04d}")
    assert (folder / "undisturbed/table.csv").read_bytes() == (folder / "jobs/table.csv").read_bytes()
    assert restarts, "no job met its time limit"
    print("records and table are those of the undisturbed sweep")


if __name__ == "__main__":
    main()
