"""Attacks on runs: killed at any moment, with files that may not grow, and with damaged files."""

from __future__ import annotations

import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from examples.reliability.attempt import (
    LIFE,
    Found,
    command,
    found,
    frames_of,
    leading,
    problem,
    same,
    signalled,
    timed,
    told,
)
from examples.reliability.damage import damaged

SCENE = """
format = 1
name = "attacked"
duration = 1.2e-3
frames = 60
[flagella]
length = 3.0
"""
SWEEP = """
base = "scene.toml"
[axes]
"motor.torque" = [1.0, 2.0]
"""
CHECKPOINTS = ("--checkpoint-interval", "0.05")


class Base:
    """What attacks on runs compare with and damage, made once in a folder.

    Args:
        folder: where it is made, or found again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene, self.whole = folder, folder / "scene.toml", folder / "whole"
        if not (self.whole / "movie.usdc").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            self.scene.write_text(SCENE)
            ended = command(*self.arguments(self.whole))
            assert ended.returncode == 0, ended.stderr
            line = [sys.executable, "-m", "warpflag", *self.arguments(folder / "half")]
            begun = subprocess.Popen(line, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
            while not (folder / "half" / "checkpoint-000002.npz").exists() and begun.poll() is None:
                time.sleep(0.002)
            begun.kill()
            begun.wait()
            (folder / "sweep.toml").write_text(SWEEP.replace("scene.toml", str(self.scene)))
            ended = command("sweep", str(folder / "sweep.toml"), "-o", str(folder / "sweep"), "--set", "duration=1e-4")
            assert ended.returncode == 0, ended.stderr
        self.frames = frames_of(self.whole)
        _, self.seconds = timed(*self.arguments(folder / "timed"))
        shutil.rmtree(folder / "timed", ignore_errors=True)

    def arguments(self, directory: Path) -> list[str]:
        """Of the command that runs the scene into a directory."""
        return ["run", str(self.scene), "-o", str(directory), *CHECKPOINTS]


def _completed(base: Base, directory: Path, done: str) -> Found:
    """A run that was cut short is resumed to its end, and compared."""
    if not (directory / "scene.toml").exists():
        return found("right", f"{done}: nothing was begun")
    for _ in range(2):
        ended = command("run", "--resume", str(directory))
        if wrong := problem(ended):
            return found("traceback", f"{done}: resume {wrong}")
        if ended.returncode == 0:
            break
    else:
        return found("lost", f"{done}: resume ends {ended.returncode}: {told(ended)}")
    if not same(frames_of(directory), base.frames):
        return found("wrong", f"{done}: resumed to other numbers")
    return found("right", done)


def kill(base: Base, seed: int, folder: Path) -> Found:
    """A run killed at a random moment from its first millisecond to its last, by KILL, INT or TERM; then resumed."""
    chance, directory = random.Random(f"kill {seed}"), folder / "killed"
    number = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)[seed % 3]
    after = chance.random() * base.seconds * LIFE
    ended = signalled(base.arguments(directory), number, after)
    if ended is None:
        return found("traceback", f"{number.name} after {after:.2f} s: goes on")
    done = f"{number.name} after {after:.2f} of {base.seconds:.2f} s" + (", ended before" if ended.before else "")
    if number == signal.SIGINT and not directory.exists() and "KeyboardInterrupt" in ended.said:
        return found("right", f"{done}: before the program began")
    if "Traceback" in ended.said:
        return found("traceback", f"{done}: {ended.said.strip().splitlines()[-1]}")
    if (directory / "run.h5").exists():
        try:
            if not leading(frames_of(directory), base.frames):
                return found("wrong", f"{done}: other frames")
        except Exception as error:
            if "no frame" not in str(error) and (directory / "checkpoint-000000.npz").exists():
                return found("lost", f"{done}: {error}")
    return _completed(base, directory, done)


def limit(base: Base, seed: int, folder: Path) -> Found:
    """A run whose files may not grow beyond a random size up to that of its record; then resumed without the limit."""
    chance, directory = random.Random(f"limit {seed}"), folder / "limited"
    size = int((base.whole / "run.h5").stat().st_size * (seed % 10 + chance.random()) / 10)

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    ended = command(*base.arguments(directory), preexec_fn=limited)
    done = f"files of at most {size} bytes: status {ended.returncode}"
    if wrong := problem(ended):
        return found("traceback", f"{done}: {wrong}")
    if ended.returncode not in (0, 1):
        return found("wrong", f"{done}: {told(ended)}")
    if (directory / "checkpoint-000000.npz").exists():
        try:
            if not leading(frames_of(directory), base.frames):
                return found("wrong", f"{done}: other frames")
        except Exception as error:
            return found("lost", f"{done}: {error}")
    return _completed(base, directory, done)


def damage(base: Base, seed: int, folder: Path) -> Found:
    """One damaged file of a run: the record, a checkpoint, the movie, summary, scene, or the table of a sweep."""
    kinds = ("record", "record", "record", "checkpoint", "checkpoint", "movie", "summary", "scene", "table", "cache")
    kind = kinds[seed % len(kinds)]
    chance = random.Random(f"damage {seed}")
    if kind == "cache":
        return _damaged_cache(base, seed, folder)
    source = {"table": base.folder / "sweep", "checkpoint": base.folder / "half"}.get(kind, base.whole)
    directory = folder / "damaged"
    shutil.copytree(source, directory)
    names = {
        "record": "run.h5",
        "movie": "movie.usdc",
        "summary": "summary.json",
        "scene": "scene.toml",
        "checkpoint": chance.choice(sorted(p.name for p in directory.glob("checkpoint-*.npz")) or ["run.h5"]),
        "table": chance.choice(sorted(p.name for p in directory.iterdir() if p.is_file() and p.stat().st_size)),
    }
    path = directory / names[kind]
    how, content = damaged(path.read_bytes(), seed)
    path.write_bytes(content)
    asked = {
        "record": ("export", str(directory), "--to", "csv", "-o", str(folder / "out.csv")),
        "movie": ("render", str(directory), "-o", str(folder / "out.png"), "--size", "96x54"),
        "summary": ("plot", str(directory), "-o", str(folder / "out.png")),
        "scene": ("run", "--resume", str(directory), "--set", "duration=1.6e-3"),
        "checkpoint": ("run", "--resume", str(directory)),
        "table": ("plot", str(directory), "-o", str(folder / "out.png")),
    }[kind]
    ended = command(*asked)
    done = f"{kind} {path.name}: {how}; {' '.join(asked[:2])} ended {ended.returncode}"
    if wrong := problem(ended):
        return found("traceback", f"{done}: {wrong}")
    if ended.returncode:
        return found("refused", f"{done}: {told(ended)[0]}")
    if kind == "checkpoint" and not same(frames_of(directory), base.frames):
        return found("wrong", f"{done}: other numbers")
    if kind == "record":
        reference = base.folder / "reference.csv"
        if not reference.exists():
            command("export", str(base.whole), "--to", "csv", "-o", str(reference))
        if reference.read_bytes() != (folder / "out.csv").read_bytes():
            return found("wrong", f"{done}: other numbers")
    if kind == "movie":
        reference = base.folder / "reference.png"
        if not reference.exists():
            command("render", str(base.whole), "-o", str(reference), "--size", "96x54")
        if reference.read_bytes() != (folder / "out.png").read_bytes():
            return found("wrong", f"{done}: another picture")
    if kind == "scene" and not leading(base.frames, frames_of(directory)):
        return found("wrong", f"{done}: other numbers")
    return found("right", done)


def _damaged_cache(base: Base, seed: int, folder: Path) -> Found:
    """A damaged object file in the kernel cache; the cache is a copy that holds what the scene needs."""
    kept = base.folder / "cache"
    own = {"WARP_CACHE_PATH": str(kept)}
    if not kept.exists():
        command("run", str(base.scene), "-o", str(folder / "filled"), env=own, timeout=600.0)
    cache = folder / "cache"
    shutil.copytree(kept, cache)
    objects = sorted(p for p in cache.rglob("*") if p.is_file() and p.suffix in (".o", ".meta"))
    path = random.Random(f"cache {seed}").choice(objects)
    how, content = damaged(path.read_bytes(), seed)
    path.write_bytes(content)
    directory = folder / "run"
    ended = command("run", str(base.scene), "-o", str(directory), env={"WARP_CACHE_PATH": str(cache)}, timeout=600.0)
    done = f"cache {path.name}: {how}; run ended {ended.returncode}"
    if wrong := problem(ended):
        return found("traceback", f"{done}: {wrong}")
    if ended.returncode:
        return found("refused", f"{done}: {told(ended)[0]}")
    return found("right" if same(frames_of(directory), base.frames) else "wrong", done)
