"""Thermal equilibrium and diffusion, simulated beside their exact values: the tables of docs/thermal.md.

    uv run examples/thermal/tables.py                   # all, an hour and a half of a core
    uv run examples/thermal/tables.py energies drift    # some
    uv run examples/thermal/tables.py --share 0.1       # with a tenth of the samples

Ensembles are batches: one cell per seed. Every number comes with its standard error over the cells, which are
independent, so that correlations in time need no correction. Units um, pN, s.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from tools import cost, joints, motion, shapes

TABLES: dict[str, Callable[[float], None]] = {
    f.__name__: f
    for f in (
        joints.energies,
        joints.order,
        joints.lengths,
        joints.dumbbell,
        joints.persistence,
        motion.drift,
        motion.diffusion,
        motion.body,
        motion.swimmer,
        shapes.tip,
        shapes.neighbours,
        shapes.contact,
        cost.cost,
    )
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", default=list(TABLES), help=", ".join(TABLES))
    parser.add_argument("--share", type=float, default=1.0, help="of the samples")
    chosen = parser.parse_args()
    for name in chosen.tables:
        TABLES[name](chosen.share)
