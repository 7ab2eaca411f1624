"""PyElastica beside warpflag: one step of a helical filament, of two in contact, and how many steps a ms takes.

    uv run --with pyelastica examples/benchmarks/pyelastica.py

The same filament in both: 48 elements, 10 um long, helical at rest, rigidities, stretching and drags of the scene; no
flow between nodes. The two filaments lie side by side and touch. Shown are the time of one step of PyElastica
(position Verlet, one evaluation of all forces) and of one right-hand side of warpflag, and the computing time of a
simulated millisecond.

What differs, and matters more than the times of a step: PyElastica's rods have inertia, warpflag's have none. At the
density of water a filament of 0.02 um forgets its velocity in 1e-10 s and its spin sooner still, and steps must resolve
that. (The analytical damper keeps any step finite, but beyond that time it stalls the rod: the steady velocity under a
force comes out as x / (exp x - 1) of the right one, x the step over the time. A factor of 0.9 is allowed here, and the
formula is checked against a run.) Heavier rods can take longer steps; that is the usual way out, and sound as long as
the inertia stays quicker than the motion of interest, here the motor's turn of some 1e-3 s. Densities up to 1e4 times
water's are shown. A step must also be stable: then the search is by trial, from a shape slightly disturbed.

What PyElastica's rods have not: anisotropic drag (here the transverse one acts in all directions), a motor, a body.
They shear; shear is as stiff as stretch here. Their contact is a linear spring, as stiff as warpflag's force at a
distance of one diameter, and begins at 0.04 um: the rods are as thick, at the mass of the filament of 0.02 um.
Warpflag runs with motor and body, implicit with its default accuracy; its millisecond is the second one of a run, when
the motors have wound up the filaments.
"""

from __future__ import annotations

import argparse
import logging
import math
import sys
import time
from typing import Any

import numpy as np
from tools.cells import placed
from tools.harness import Repeated, interleaved, table
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side

from warpflag.model.geometry import initial_state
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, paper_scene, with_values

try:
    import elastica
except ImportError:
    sys.exit("PyElastica is not installed: uv run --with pyelastica examples/benchmarks/pyelastica.py")

ELEMENTS, LENGTH = 48, 10.0  # um
WATER = 1e-9  # pN s^2/um^4
DENSITIES = (1.0, 1e2, 1e4)  # of water
DRAG_ACROSS, DRAG_SPIN = 2.8e-3, 1.26e-6  # pN s/um^2, pN s: the scene's
SLOWED = 0.9  # the least share of its velocity that a rod must reach
CONTACT_STIFFNESS = 19 * 0.8 / 0.04  # pN/um, the slope of the scene's force at its diameter
TRIAL = 2000  # steps
DISTURBED, BLOWN = 1e-5, 0.05  # um, at the start of a trial, and what counts as unstable at its end


def scene(filaments: int, stepper: str = "implicit") -> Scene:
    """The filaments on a body, without flow; two are 0.042 um apart."""
    values: dict[str, Any] = {
        "flagella.count": filaments,
        "flagella.length": LENGTH,
        "flagella.segment_length": LENGTH / ELEMENTS,
        "hydrodynamics.mode": "none",
        "body.contact": False,
        "numerics.stepper": stepper,
    }
    if filaments == 2:
        values |= {"flagella.opening_angle": 0.0, "flagellum.0.azimuth": 0.0}
        values["flagellum.1.azimuth"] = 2 * math.degrees(math.asin(0.042 / 0.8))
    return with_values(paper_scene(name="filaments", duration=1.0), values)


class Rods(elastica.BaseSystemCollection, elastica.Damping, elastica.Contact, elastica.Forcing):
    """Rods that are damped, touch and are pushed."""


class Elastica:
    """Filaments in PyElastica.

    Args:
        density: in units of water's.
        step: [s].
        push: force on every rod [pN].
    """

    def __init__(self, filaments: int, density: float, step: float, push: float = 0.0, disturbed: float = 0.0) -> None:
        self._simulator, self._step, self._time = Rods(), step, np.float64(0.0)
        self._stepper = elastica.PositionVerlet()
        self._rods = [self._rod(k, density, disturbed) for k in range(filaments)]
        for rod in self._rods:
            self._simulator.append(rod)
            self._simulator.dampen(rod).using(
                elastica.AnalyticalLinearDamper,
                translational_damping_constant=DRAG_ACROSS * LENGTH / ELEMENTS,
                rotational_damping_constant=DRAG_SPIN * LENGTH / ELEMENTS,
                time_step=step,
            )
            if push:
                along = np.array([0.0, 0.0, 1.0])
                self._simulator.add_forcing_to(rod).using(elastica.UniformForces, force=push, direction=along)
        if filaments == 2:
            self._simulator.detect_contact_between(*self._rods).using(
                elastica.RodRodContact, k=CONTACT_STIFFNESS, nu=0.0
            )
        self._simulator.finalize()
        self._start = [rod.position_collection.copy() for rod in self._rods]

    def __call__(self, steps: int) -> None:
        """Takes so many steps."""
        for _ in range(steps):
            self._time = self._stepper.step(self._simulator, self._time, self._step)

    @property
    def velocity(self) -> float:
        """Mean over the nodes of the first rod, along z [um/s]."""
        return float(np.mean(self._rods[0].velocity_collection[2]))

    @property
    def moved(self) -> float:
        """Largest displacement of a node so far [um]; infinite once the numbers are lost."""
        far = [
            np.abs(rod.position_collection - start).max() for rod, start in zip(self._rods, self._start, strict=True)
        ]
        return float(max(far)) if np.isfinite(far).all() else math.inf

    @staticmethod
    def _rod(k: int, density: float, disturbed: float) -> Any:
        """The helix of the scene as a rod whose rest shape is where it stands."""
        start = initial_state(scene(1))
        nodes, e1 = start.positions[0].T.copy(), start.directors[0][1:].T.copy()
        nodes[0] += 0.0395 * k  # contact is closed by half a nm
        tangents = np.diff(nodes, axis=1) / np.linalg.norm(np.diff(nodes, axis=1), axis=0)
        directors = np.array([e1, np.cross(tangents, e1, axis=0), tangents])
        # Contact begins at 0.04 um, so the rod is as thick; its density is that of the filament of half the diameter.
        radius, inertia = 0.02, math.pi * 0.02**4 / 4
        rod = elastica.CosseratRod.straight_rod(
            ELEMENTS,
            nodes[:, 0],
            tangents[:, 0],
            e1[:, 0].copy(),
            LENGTH,
            radius,
            density * WATER / 4,
            youngs_modulus=3.5 / inertia,
            shear_modulus=3.5 / (2 * inertia),
            position=nodes,
            directors=directors,
        )
        rod.shear_matrix[:] = 1000.0 * np.eye(3)[:, :, None]  # pN
        rod.compute_internal_forces_and_torques(np.float64(0.0))
        rod.rest_kappa[:], rod.rest_sigma[:] = rod.kappa, rod.sigma
        rod.position_collection += disturbed * np.random.default_rng(k).standard_normal(nodes.shape)
        return rod


def inertia_time(density: float) -> tuple[float, float]:
    """Times in which such a filament forgets its velocity and its spin [s]."""
    mass = density * WATER * math.pi * 0.01**2
    spin_inertia = density * WATER / 4 * math.pi * 0.02**4 / 2  # per length, of the rod as it is built above
    return mass / DRAG_ACROSS, spin_inertia / DRAG_SPIN


def drag_step(density: float) -> float:
    """Longest step at which neither motion is stalled too much [s]."""
    x = 0.0
    while (x + 1e-4) / math.expm1(x + 1e-4) > SLOWED:
        x += 1e-4
    return x * min(inertia_time(density))


def check_drag_formula(density: float = 1.0) -> None:
    """The steady velocity of a pushed rod, against the formula that the steps follow from."""
    step = inertia_time(density)[0]  # x = 1
    rods = Elastica(1, density, step, push=1e-3)
    rods(200)
    right = 1e-3 / (DRAG_ACROSS * LENGTH)
    found = rods.velocity / right
    assert abs(found * math.expm1(1.0) - 1.0) < 0.05, f"a pushed rod reaches {found:.3f} of its velocity"


def stable(filaments: int, density: float, step: float) -> bool:
    """Whether a disturbed shape stays together."""
    rods = Elastica(filaments, density, step, disturbed=DISTURBED)
    with np.errstate(all="ignore"):
        rods(TRIAL)
    return rods.moved < BLOWN


def longest_step(filaments: int, density: float) -> tuple[float, str]:
    """Longest usable step [s] and what limits it."""
    low = high = drag_step(density)
    if stable(filaments, density, high):
        return high, "drag"
    while not stable(filaments, density, low):
        high, low = low, low / 4
    while high / low > 1.1:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(filaments, density, middle) else (low, middle)
    return low, "stability"


def warpflag_per_ms(filaments: int, stepper: str) -> float:
    """Computing time of the second simulated millisecond [s]; the least of three runs."""
    costs = []
    for _ in range(3):
        sim = Simulation(scene(filaments, stepper), device="cpu")
        sim.advance(1e-3)
        begun = time.process_time()
        sim.advance(2e-3)
        costs.append(time.process_time() - begun)
    return min(costs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=21, help="turns of every contender")
    args = parser.parse_args()
    logging.getLogger().setLevel(logging.ERROR)  # it warns of every rod as small as this
    check_drag_formula()
    rows: list[list[Any]] = []
    for filaments in (1, 2):
        sim = placed(scene(filaments))
        own = Repeated(lambda sim=sim: launch_right_hand_side(sim.system.model, sim.system.state))
        other = Elastica(filaments, 1.0, drag_step(1.0))
        times = interleaved({"warpflag": own, "PyElastica": other}, args.rounds)
        for density in DENSITIES:
            step, limit = longest_step(filaments, density)
            cost = times["PyElastica"]
            row = ["PyElastica", filaments, f"{density:g} x water", f"{inertia_time(density)[0]:.0e}"]
            rows.append([*row, 1e6 * cost, f"{step:.1e}", limit, f"{1e-3 / step * cost:.2g}"])
        for stepper in ("rkc", "implicit"):
            per_ms = warpflag_per_ms(filaments, stepper)
            rows.append(
                [f"warpflag, {stepper}", filaments, "none", "0", 1e6 * times["warpflag"], "", "", f"{per_ms:.2g}"]
            )
    head = ["", "filaments", "density", "inertia time s", "us per step or right-hand side", "longest step s"]
    print(table([*head, "limited by", "s of computing per ms"], rows))


if __name__ == "__main__":
    main()
