"""Draws snapshots of a run as an SVG file: body and flagella, seen across the cell's first axis.

uv run examples/snapshots.py RUN_DIRECTORY [-o FILE.svg] [--times 0 3 6 9 ...  in ms]
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpflag import Record

COLORS = ["#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#000000"]
SCALE = 34  # pixels per um
MARGIN = 0.5  # um
WIDTH = 0.07  # of a flagellum as drawn, more than it is [um]
COLUMNS = 3


def axes_of(quaternion: np.ndarray) -> np.ndarray:
    """Body axes e_b1, e_b2, e_b3 in the lab as rows, of a quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (np.eye(3) + 2 * w * cross + 2 * cross @ cross).T


def strokes(record: Record, frame: int, view: np.ndarray) -> list[tuple[float, np.ndarray, float, str]]:
    """Depth, end points, width and colour of every stroke of a frame, relative to the body centre [um]."""
    centre, e3 = record.body_position[frame], axes_of(record.body_orientation[frame])[2]
    half = (record.body_length - record.body_width) / 2
    axis = np.stack([-half * e3, half * e3]) @ view.T
    drawn = [(0.0, axis[:, :2], record.body_width, "#b9bdb3")]
    points = (record.positions[frame] - centre) @ view.T
    first_node = record.first_node
    for k in range(len(first_node) - 1):
        nodes = points[first_node[k] : first_node[k + 1]]
        for a, b in pairwise(nodes):
            drawn.append(((a[2] + b[2]) / 2, np.stack([a, b])[:, :2], WIDTH, COLORS[k % len(COLORS)]))
    return sorted(drawn, key=lambda stroke: stroke[0])


def line(points: np.ndarray, width: float, color: str) -> str:
    (x1, y1), (x2, y2) = np.asarray(points) * [SCALE, -SCALE]
    style = f'stroke="{color}" stroke-width="{width * SCALE:.1f}"'
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" {style}/>'


def picture(record: Record, frames: list[int]) -> str:
    """The frames in rows, each with its time; the cell swims to the left."""
    e1, _, e3 = axes_of(record.body_orientation[0])
    view = np.stack([e3, e1, np.cross(e3, e1)])
    drawn = [strokes(record, frame, view) for frame in frames]
    bounds = np.array([(ends.min(axis=0), ends.max(axis=0)) for cell in drawn for _, ends, _, _ in cell])
    left, right = bounds[:, 0, 0].min() - MARGIN, bounds[:, 1, 0].max() + MARGIN
    lines, top = [], 0.0
    for row in range(0, len(frames), COLUMNS):
        cells = list(zip(frames, drawn, strict=True))[row : row + COLUMNS]
        ends = np.concatenate([stroke[1] for _, cell in cells for stroke in cell])
        low, high = ends[:, 1].min() - MARGIN, ends[:, 1].max() + MARGIN
        for column, (frame, cell) in enumerate(cells):
            x, y = (column * (right - left) - left) * SCALE, (top + high) * SCALE
            label = f'x="{(left + 0.1) * SCALE:.0f}" y="{0.2 * SCALE - high * SCALE + 12:.0f}"'
            lines.append(f'<g transform="translate({x:.1f} {y:.1f})">')
            lines += [line(*stroke[1:]) for stroke in cell]
            lines.append(f"<text {label}>{1e3 * record.times[frame]:.1f} ms</text></g>")
        top += high - low
    width = min(COLUMNS, len(frames)) * (right - left)
    lines.append(line(np.array([[width - 1.3, -0.3], [width - 0.3, -0.3]]), 0.06, "#000000"))
    lines.append(f'<text x="{(width - 0.8) * SCALE:.0f}" y="{0.85 * SCALE:.0f}" text-anchor="middle">1 µm</text>')
    box = f'viewBox="0 0 {width * SCALE:.0f} {top * SCALE:.0f}"'
    style = 'stroke-linecap="round" font-family="sans-serif" font-size="14"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {box} {style}>'
    return "\n".join([head, '<rect width="100%" height="100%" fill="#ffffff"/>', *lines, "</svg>"]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory")
    parser.add_argument("-o", dest="output", default="snapshots.svg")
    parser.add_argument("--times", nargs="+", type=float, metavar="MS", help="default: six, evenly spread")
    options = parser.parse_args()
    with Record(options.directory) as record:
        times = 1e3 * record.times
        wanted = options.times or np.linspace(times[0], times[-1], 6)
        frames = [int(np.abs(times - time).argmin()) for time in wanted]
        Path(options.output).write_text(picture(record, frames), encoding="utf-8")
    print(options.output)


if __name__ == "__main__":
    main()
