"""The whole attack on this program: kills, signals, write limits, damage, malformed scenes, random scenes, extremes.

    uv run examples/reliability/attack.py                          everything: hours on one core
    uv run examples/reliability/attack.py --minutes 20 --seed 7    as much as fits, every kind in turn
    uv run examples/reliability/attack.py --kinds extremes --counts extremes=60

Every attempt is fixed by its kind, its number and the seed. Outcomes are appended to attack.jsonl in the folder of the
attack; the same command again goes on where it stood. At the end it prints, per kind, how many attempts were right,
refused, stopped, wrong, lost, or a traceback (`attempt.OUTCOMES`), and lists all that should not be.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent.parent))

from examples.reliability import extremes, runs, scenes, signals
from examples.reliability.attempt import OUTCOMES, Found, found

COUNTS = {
    "kills": 200,
    "signals": 200,
    "limits": 40,
    "damage": 300,
    "malformed": 500,
    "random": 300,
    "living": 200,
    "extremes": extremes.COUNT,
}
BAD = ("wrong", "lost", "traceback")


class Attack:
    """An attack in a folder, which remembers what has been tried.

    Args:
        folder: of the attack.
        seed: which attack.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed, self._base = folder, seed, None
        folder.mkdir(parents=True, exist_ok=True)
        self.log = folder / f"attack-{seed}.jsonl"
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.done = {(entry["kind"], entry["number"]): entry for entry in map(json.loads, lines)}

    @property
    def base(self) -> runs.Base:
        if self._base is None:
            self._base = runs.Base(self.folder / "base")
        return self._base

    def attempt(self, kind: str, number: int) -> Found:
        """One attempt in a scratch folder of its own."""
        scratch = self.folder / "scratch"
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        seed = 100_000 * self.seed + number
        actions: dict[str, Callable[[], Found]] = {
            "kills": lambda: runs.kill(self.base, seed, scratch),
            "signals": lambda: signals.asked_to_end(self.base, seed, scratch),
            "limits": lambda: runs.limit(self.base, seed, scratch),
            "damage": lambda: runs.damage(self.base, seed, scratch),
            "malformed": lambda: scenes.malformed_scene(seed, scratch),
            "random": lambda: scenes.random_scene(seed, scratch),
            "living": lambda: scenes.random_scene(seed, scratch, living=True),
            "extremes": lambda: extremes.extreme(scattered(number, COUNTS["extremes"]), scratch),
        }
        begin = time.monotonic()
        try:
            one = actions[kind]()
        except Exception as error:
            one = found("traceback", f"the attack itself: {type(error).__name__}: {error}")
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        entry = {"kind": kind, "number": number, "outcome": one.outcome, "note": one.note, **one.numbers}
        entry["wall"] = round(time.monotonic() - begin, 2)
        with self.log.open("a") as file:
            file.write(json.dumps(entry) + "\n")
        self.done[kind, number] = entry
        return one


def scattered(number: int, count: int) -> int:
    """A permutation of 0 to count - 1, so that the first attempts are spread over all rows and forms."""
    stride = next(s for s in range(int(count * 0.618), count) if _coprime(s, count))
    return number * stride % count


def _coprime(a: int, b: int) -> bool:
    while b:
        a, b = b, a % b
    return a == 1


def in_turn(counts: dict[str, int], done: set[tuple[str, int]]) -> Iterator[tuple[str, int]]:
    """Every attempt that is left, kinds in proportion to their counts."""
    left = [(k / counts[kind], kind, k) for kind in counts for k in range(counts[kind]) if (kind, k) not in done]
    for _, kind, k in sorted(left):
        yield kind, k


def table(entries: list[dict]) -> str:
    """What came of all attempts, as a table."""
    lines = ["| kind | tried | " + " | ".join(OUTCOMES) + " |", "|---|" + "---|" * (len(OUTCOMES) + 1)]
    for kind in COUNTS:
        own = Counter(entry["outcome"] for entry in entries if entry["kind"] == kind)
        if own:
            lines.append(f"| {kind} | {own.total()} | " + " | ".join(str(own[outcome]) for outcome in OUTCOMES) + " |")
    return "\n".join(lines)


def extremes_table(entries: list[dict]) -> str:
    """The rows of the extremes: outcomes of their forms, largest error over what was asked, cost."""
    lines = ["| extreme | ms | outcomes of its forms | worst error over asked | ms per ms |", "|---|---|---|---|---|"]
    for row in extremes.ROWS:
        own = [e for e in entries if e["kind"] == "extremes" and e.get("row") == row]
        if own:
            counts = Counter(e["outcome"] for e in own)
            said = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
            errors = [e["error_over_asked"] for e in own if e["outcome"] == "right" and "error_over_asked" in e]
            ran = [e for e in own if e["outcome"] == "right" and "seconds" in e]
            costs = {s: [1e3 * e["seconds"] / e["ms"] for e in ran if e["form"][0] == s] for s in ("implicit", "rkc")}
            cost = ", ".join(f"{s} {min(c):.3g} to {max(c):.3g}" for s, c in costs.items() if c)
            lines.append(f"| {row} | {own[0]['ms']:g} | {said} | {max(errors, default=0):.2g} | {cost} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="wall time; the rest can be gone on with")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", choices=list(COUNTS), default=list(COUNTS))
    parser.add_argument("--counts", nargs="+", default=[], metavar="KIND=N", help="attempts of a kind")
    parser.add_argument("--cut-off", type=float, help="computing time of a finer run [s] (default: 60, extremes 10)")
    parser.add_argument("-o", dest="folder", type=Path, default=Path("runs/attack"), help="(default: runs/attack)")
    parser.add_argument("--again", nargs=2, metavar=("KIND", "N"), help="one attempt, and what came of it")
    options = parser.parse_args()
    attack = Attack(options.folder.absolute(), options.seed)
    root = Path(__file__).parent.parent.parent
    os.environ.setdefault("PYTHONPATH", os.pathsep.join([str(root), str(root / "kernels")]))
    if options.cut_off:
        scenes.CUT_OFF = extremes.CUT_OFF = options.cut_off
    if options.again:
        print(attack.attempt(options.again[0], int(options.again[1])))
        return 0
    counts = {kind: COUNTS[kind] for kind in options.kinds}
    counts |= {kind: int(n) for kind, _, n in (given.partition("=") for given in options.counts)}
    end = time.monotonic() + 60 * options.minutes
    for kind, number in in_turn(counts, set(attack.done)):
        if time.monotonic() > end:
            break
        one = attack.attempt(kind, number)
        if one.outcome in BAD:
            print(f"{kind} {number}: {one.outcome}: {one.note}", file=sys.stderr, flush=True)
    entries = list(attack.done.values())
    print(table(entries))
    if any(e["kind"] == "extremes" for e in entries):
        print(f"\n{extremes_table(entries)}")
    bad = [e for e in entries if e["outcome"] in BAD]
    print(f"\n{len(bad)} of {len(entries)} attempts ended as none should" + (":" if bad else ""))
    for e in bad:
        print(f"- {e['kind']} {e['number']}: {e['outcome']}: {e['note']}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
