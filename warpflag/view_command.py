"""The commands that look at runs: `warpflag plot`, `render`, `export`; their options, and what they start."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any

from warpflag.base.exit_status import BAD_INPUT, DONE
from warpflag.base.output import missing
from warpflag.base.streams import tell

if TYPE_CHECKING:
    from warpflag.view.usd import Shot

__all__ = ["add", "export", "plot", "render"]


def add(commands: Any) -> None:
    """Adds the commands to a parser's commands."""
    plotting = commands.add_parser(
        "plot",
        help="draw the curves of runs, or the numbers of a sweep",
        description="Draws what was measured on a run over time, or compares several runs; needs matplotlib, the extra "
        "plot. Runs are labelled by what differs between their scenes. The bundle length passes over gaps of 1 um; "
        "run.h5 has the plain one. Of a sweep it draws numbers of its table against an axis, or maps over two.",
    )
    plotting.add_argument("directories", nargs="+", metavar="DIR", help="run directory, or the directory of one sweep")
    plotting.add_argument(
        "--x", metavar="COLUMN", help="of a sweep: draw against this column (default: its first axis, or the member)"
    )
    plotting.add_argument(
        "--y", nargs="+", default=[], metavar="COLUMN", help="observables of runs, or numbers of a sweep's table"
    )
    plotting.add_argument("-o", dest="output", metavar="FIG", required=True, help="ends in .png, .pdf, .svg, ...")
    plotting.add_argument(
        "--as",
        dest="kind",
        choices=("dashboard", "comparison", "curves", "map"),
        help="all curves of one run, or several runs in the same panels (default: by the number of DIR); of a sweep "
        "curves or a map (default: map of two axes)",
    )
    plotting.set_defaults(command=plot)

    drawing = commands.add_parser(
        "render",
        help="draw a run as a picture or a film",
        description="Draws a run or its movie. Letters, .jpg, .webp and .gif need Pillow, .mp4 ffmpeg (extra render). "
        "Flagella are drawn with a radius of 0.05 um; the picture says by how much that is too thick.",
    )
    drawing.add_argument("source", metavar="DIR", help="run directory, or a .usdc, .usda or .usdz file")
    drawing.add_argument(
        "-o", dest="output", metavar="FILE", required=True, help="ends in .png, .jpg, .webp, .gif or .mp4"
    )
    drawing.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="pixels (default: 1280x720)")
    drawing.add_argument(
        "--times", type=float, nargs="+", default=[], metavar="MS", help="of a picture [ms]; several make a sheet"
    )
    drawing.add_argument("--snapshots", type=int, metavar="N", help="a sheet of N pictures from first to last")
    drawing.add_argument("--radius", type=float, default=0.05, metavar="UM", help="least radius of flagella [um]")
    drawing.add_argument("--device", help="cpu, cuda:0, ... (see warpflag devices)")
    drawing.add_argument("--quiet", action="store_true", help="print errors only")
    drawing.set_defaults(command=render)

    exporting = commands.add_parser(
        "export", help="write a record in another format", description="Writes the record of a run in another format."
    )
    exporting.add_argument("directories", nargs="+", metavar="DIR", help="run directory; several make one USD movie")
    exporting.add_argument("--to", choices=("usd", "html", "vtkhdf", "xyz", "csv"), required=True, help="format")
    exporting.add_argument(
        "-o",
        dest="output",
        metavar="FILE",
        help="default: movie.usdc, cell.html or run.FORMAT in DIR; a movie may end in .usdc, .usda or .usdz",
    )
    exporting.add_argument("--clip-frames", type=int, metavar="N", help="frames per USD value clip (default: by size)")
    exporting.add_argument("--mesh", action="store_true", help="a USD movie of meshes, for Blender")
    exporting.set_defaults(command=export)

    for command in (drawing, exporting):
        command.add_argument(
            "--color", metavar="BY", help="flagellum (default), phase_difference, curvature, steric_force or form"
        )
        command.add_argument("--follow", action="store_true", help="the camera goes with the cell")
        command.add_argument("--fps", type=float, help="pictures per second of the film (default: 50)")
        command.add_argument(
            "--slow-down", type=float, metavar="X", help="times slower than the cell (default: a frame per frame)"
        )


def plot(options: argparse.Namespace) -> int:
    """Draws curves of runs or numbers of a sweep; returns the exit status."""
    os.environ["MPLBACKEND"] = "agg"  # a notebook's own, which a command started there inherits, may not exist here
    from warpflag.view import figures, sweep_figures

    for path in options.directories:
        folder = os.path.dirname(path)
        if os.path.isfile(path) and sweep_figures.is_sweep(folder):  # DIR/* names a sweep's own files, too
            told = f"the sweep: warpflag plot {folder}; its runs side by side: warpflag plot {folder}/0*"
            return tell(f"{path}: is no run directory; {told}", BAD_INPUT)
    if sweep_figures.is_sweep(options.directories[0]):
        figures.save(sweep_figures.figure(options.directories, options.kind, options.x, options.y), options.output)
        print(options.output)
        return DONE
    if options.x or options.kind in ("curves", "map"):
        return tell(f"{options.directories[0]}: is no sweep, which --x, curves and map are for", BAD_INPUT)
    runs = [figures.read(directory) for directory in options.directories]
    compared = options.kind == "comparison" or (options.kind is None and (len(runs) > 1 or options.y))
    if len(runs) > 1 and not compared:
        return tell("plot --as dashboard takes one DIR", BAD_INPUT)
    if options.y and not compared:
        return tell("--y is for comparisons: plot --as comparison", BAD_INPUT)
    figures.save(figures.comparison(runs, options.y) if compared else figures.dashboard(runs[0]), options.output)
    print(options.output)
    return DONE


def render(options: argparse.Namespace) -> int:
    """Draws a picture or a film; returns the exit status."""
    from warpflag.view import render as views
    from warpflag.view.notes import can_write

    filmed_anew = options.color or options.follow or options.slow_down is not None
    # Its pictures per second say how often the film looks at the movie, not how fast the movie plays.
    shot = _shot(options) if filmed_anew else None
    views.render(
        options.source,
        options.output,
        shot=shot,
        times=[1e-3 * time for time in options.times],
        snapshots=options.snapshots,
        frames_per_second=options.fps,
        size=options.size,
        radius=options.radius,
        device=options.device,
        quiet=options.quiet,
    )
    if not options.quiet:
        print(options.output)
        if not can_write():
            tell(f"drawn without time and scale bar: they need Pillow: {missing('Pillow', 'render')}", DONE)
    return DONE


def export(options: argparse.Namespace) -> int:
    """Writes a record in another format; returns the exit status."""
    from contextlib import ExitStack
    from pathlib import Path

    from warpflag.record import Record
    from warpflag.view import export as formats
    from warpflag.view import page, usd

    name = {"usd": "movie.usdc", "html": "cell.html"}.get(options.to, f"run.{options.to}")
    path = Path(options.output or Path(options.directories[0]) / name)
    if len(options.directories) > 1 and (options.to != "usd" or not options.output):
        return tell("export takes several DIR for one movie: --to usd, with -o", BAD_INPUT)
    of_movies = {"--mesh": options.mesh, "--follow": options.follow, "--fps": options.fps}
    of_movies |= {"--slow-down": options.slow_down, "--clip-frames": options.clip_frames}
    of_movies |= {"--color": None if options.to == "html" else options.color}
    for option, value in of_movies.items():
        if value and options.to != "usd":
            return tell(f"{option} is for movies: --to usd", BAD_INPUT)
    with ExitStack() as stack:
        records = [stack.enter_context(Record(directory)) for directory in options.directories]
        if options.to == "usd":
            shot = _shot(options, frames_per_second=options.fps, clip_frames=options.clip_frames, mesh=options.mesh)
            usd.write_movie(records, path, shot)
        elif options.to == "html":
            page.write_page(records[0], path, options.color or "flagellum")
        else:
            {"vtkhdf": formats.write_vtkhdf, "xyz": formats.write_xyz, "csv": formats.write_csv}[options.to](
                records[0], path
            )
    print(path)
    return DONE


def _shot(options: argparse.Namespace, **more: float | bool | None) -> Shot:
    """How a movie is to be filmed, by what was said of it."""
    from warpflag.view.usd import Shot

    said = {"color_by": options.color, "follow": options.follow, "slow_down": options.slow_down, **more}
    return Shot(**{name: value for name, value in said.items() if value is not None})


def _size(text: str) -> tuple[int, int]:
    """Width and height of "1280x720"."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text} is not of the form 1280x720")
    return int(width), int(height)
