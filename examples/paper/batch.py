"""Runs scenes in parallel processes, each in a directory of its own; what is there already is not run again."""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from warpflag.scene import Scene


def run_missing(scenes: dict[str, Scene], directory: Path, processes: int | None = None) -> None:
    """Runs what has no finished run in `directory`/NAME; a run that was interrupted goes on where it stopped.

    processes: default: one per core. Prints one line per run. A run that a guard stopped counts as finished.
    """
    missing = {name: scene for name, scene in scenes.items() if not _finished(directory / name)}
    if not missing:
        return
    directory.mkdir(parents=True, exist_ok=True)
    # The longest first, so that no process is left with one at the end.
    order = sorted(missing, key=lambda name: -missing[name].duration / missing[name].motor.torque)
    with ProcessPoolExecutor(processes or os.cpu_count(), mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_run, missing[name], directory / name) for name in order]
        for done, job in enumerate(as_completed(jobs), start=1):
            print(f"[{done}/{len(jobs)}] {job.result()}", flush=True)


def _finished(directory: Path) -> bool:
    try:
        return json.loads((directory / "summary.json").read_text())["status"] in ("done", "stopped")
    except FileNotFoundError:
        return False


def _run(scene: Scene, directory: Path) -> str:
    import warp as wp

    wp.config.quiet = True
    from warpflag.run import run

    started = (directory / "scene.toml").exists()
    job = run.resume(str(directory)) if started else run.start(scene, str(directory), "cpu")
    return job.execute(quiet=True).message


if __name__ == "__main__":
    raise SystemExit("run figures.py")
