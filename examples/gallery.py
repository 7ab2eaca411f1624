"""Makes the gallery, docs/gallery.md with its pictures and pages in docs/gallery/, from the examples:

    uv run --extra plot --extra render python examples/gallery.py

Runs what has no run yet in examples/runs; the whole takes some minutes on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from warpflag.record import Record
from warpflag.run import run
from warpflag.scene import Scene, load, with_values
from warpflag.view import figures
from warpflag.view.page import write_page
from warpflag.view.render import render

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
TORQUES = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5)  # pN um
PAGES = ("zipping", "eight_flagella")  # shown as a page, too
ENDING = """\
## How to make your own

| | |
|---|---|
| a picture, a sheet, a film | `warpflag render DIR -o cell.png`, `-o sheet.jpg --snapshots 6`, `-o film.webp` |
| curves of one run, of several | `warpflag plot DIR -o curves.png`, `warpflag plot DIR DIR -o compared.pdf` |
| a page for a browser | `warpflag export DIR --to html`: one file, which loads nothing from outside |
| Blender | `warpflag export DIR --to usd --mesh -o movie.usdc`, then `examples/blender.py` |
| usdview, Omniverse | `movie.usdc` of the run directory, or `warpflag export DIR --to usd --color curvature` |
| ParaView, OVITO | `warpflag export DIR --to vtkhdf`, `--to xyz` |
| notebooks | `examples/notebooks/`; a record at the end of a cell shows its page |

Pictures are drawn by a ray caster of this package: it needs no display, no GPU and no further package, takes a third of
a second and draws the same pixels every time, while VTK, which draws without a screen too, weighs more than 500 MB and
reads no USD. Letters, JPEG, WebP and GIF are Pillow's, mp4 is ffmpeg's, curves are matplotlib's, and three.js draws the
page.
"""


@dataclass(frozen=True)
class Entry:
    """A scene of the gallery: what it is called there, and what is to be seen."""

    title: str
    text: str
    scene: Callable[[], Scene]


def example(name: str, **values: float | int | None) -> Callable[[], Scene]:
    """A scene of the examples, with other values by key, in which a dot is written as two underscores."""
    return lambda: with_values(load(HERE / f"{name}.toml"), {k.replace("__", "."): v for k, v in values.items()})


ENTRIES = {
    "zipping": Entry(
        "Two flagella zip into a bundle",
        "Opening angle 90 degrees. They synchronise, touch, and zip from the body to the tips.",
        example("zipping"),
    ),
    "zipping_44": Entry("Opening angle 44 degrees", "The same, nearer to each other.", example("zipping_44")),
    "zipping_23": Entry("Opening angle 23 degrees", "Nearer still.", example("zipping_23")),
    "bundle_stays": Entry(
        "A bundle that stays", "At a lower torque the finished bundle lasts.", example("bundle_stays")
    ),
    "anchored": Entry("A body held fast", "The flagella turn, the body neither moves nor turns.", example("anchored")),
    "one_flagellum": Entry("One flagellum", "Alone on its body.", example("one_flagellum")),
    "three_flagella": Entry(
        "Three flagella",
        "At azimuths 120 degrees apart.",
        example("zipping", flagella__count=3, flagella__phase_difference=None),
    ),
    "eight_flagella": Entry("Eight flagella", "All round the body.", example("eight_flagella")),
    "twenty_flagella": Entry(
        "Twenty flagella",
        "The first two milliseconds of a crowd.",
        example("zipping", flagella__count=20, flagella__phase_difference=None, duration=2e-3, frames=40),
    ),
}


def ran(name: str, scene: Scene, runs: Path) -> Path:
    """The directory of a run, which is made where it is not there yet."""
    directory = runs / name
    if not (directory / "summary.json").is_file():
        outcome = run.start(scene, str(directory), None).execute(quiet=True)
        print(outcome.message)
    return directory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=HERE / "runs", metavar="DIR", help="where the runs are")
    parser.add_argument("--docs", type=Path, default=DOCS, metavar="DIR", help="where gallery.md goes")
    parser.add_argument("--only", nargs="+", default=list(ENTRIES), metavar="NAME", help="of these scenes alone")
    options = parser.parse_args()
    pictures = options.docs / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    text = [
        "# Gallery\n\nMade by `examples/gallery.py`. Flagella are drawn five times thicker than they are; time runs "
        "from left to right.\n"
    ]
    for name, entry in ENTRIES.items():
        if name not in options.only:
            continue
        directory = ran(name, with_values(entry.scene(), {"name": name}), options.runs)
        render(directory, pictures / f"{name}.jpg", snapshots=3, size=(1200, 225))
        figures.save(figures.dashboard(directory), pictures / f"{name}-curves.png", dpi=110)
        text += [f"## {entry.title}\n", f"{entry.text}\n", f"![{entry.title}](gallery/{name}.jpg)\n"]
        text.append(f"![Curves](gallery/{name}-curves.png)\n")
        if name in PAGES:
            with Record(directory) as record:
                write_page(record, pictures / f"{name}.html")
            text.append(f"[A page that moves](gallery/{name}.html): download it and open it in a browser.\n")
    if options.only == list(ENTRIES):
        scenes = {f"torque-{torque:g}": example("zipping", motor__torque=torque)() for torque in TORQUES}
        compared = [ran(name, scene, options.runs) for name, scene in scenes.items()]
        figures.save(figures.comparison(compared), pictures / "torques.png", dpi=110)
        text += ["## Eight torques\n", "![Eight torques](gallery/torques.png)\n"]
    text.append(ENDING)
    (options.docs / "gallery.md").write_text("\n".join(text), encoding="utf-8")
    print(options.docs / "gallery.md")


if __name__ == "__main__":
    main()
