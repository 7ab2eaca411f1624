"""Known answers of rod theory: cantilever, Euler and Greenhill buckling, the loaded helix.

The program has no loads, so these tests work with its forces near a state: their finite differences are the stiffness
matrix, whose inverse gives small deflections and whose zero eigenvalue a buckling load. A discrete rod bends at its
joints, so a clamped segment holds it at the middle: lengths count from there, otherwise errors are first order in h.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from tests.helpers import attachment, cell, displaced, ground_state_frames, helix_axis, placed, rod, unit
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene

# Relative, of a known answer by the value extrapolated to h = 0, and of the order of convergence. float64 alone:
# float32 forces are too coarse to differentiate.
TOLERANCE = {"float64": 1e-3}
ORDER_TOLERANCE = 0.3

COUNTS = (10, 20, 40)  # segments
LENGTH = 2.0
RIGIDITY = 3.5
STIFF = 1e6  # K [pN]: its own compliance is out of sight


def forces_and_torques(scene: Scene, starts: list[InitialState], device: str) -> tuple[np.ndarray, np.ndarray]:
    """Of many shapes of one scene at once, shapes [start_count, node_count, 3] and [start_count, node_count]."""
    sim = Simulation([scene] * len(starts), device=device, starts=starts)
    sim.evaluate()
    state = sim.system.state.data
    return state.force.numpy().reshape(len(starts), -1, 3), state.spin_torque.numpy().reshape(len(starts), -1)


def stiffness(scene: Scene, start: InitialState, free: list[tuple[int, int]], device: str) -> np.ndarray:
    """Minus the derivative of force and torque with respect to node coordinates (element, 0..2), spins (element, 3)."""
    count, step = len(start.positions[0]), 1e-8
    starts = []
    for element, axis in free:
        for sign in (-1, 1):
            change = np.zeros((count, 4))
            change[element, axis] = sign * step
            starts.append(displaced(scene, start, change[:, :3], change[:, 3]))
    forces, torques = forces_and_torques(scene, starts, device)
    loads = np.concatenate([forces, torques[..., None]], axis=2)[:, [e for e, _ in free], [a for _, a in free]]
    matrix = -(loads[1::2] - loads[::2]) / (2 * step)
    assert np.abs(matrix - matrix.T).max() < 1e-5 * np.abs(matrix).max()
    return (matrix + matrix.T) / 2


def straight_rod(count: int, extension: float = 0.0, twist: float = 0.0, values: dict | None = None):
    """A rod of COUNTS segments along z, each longer by `extension`, each joint twisted by `twist` [rad]."""
    scene = rod({
        "flagella.length": LENGTH,
        "flagella.segment_length": LENGTH / count,
        "flagella.stretching_stiffness": STIFF,
        "flagella.bending_rigidity": RIGIDITY,
        **(values or {}),
    })  # fmt: skip
    (spec,) = scene.resolved_flagella()
    anchor, _ = attachment(scene, spec)
    z = np.array([0.0, 0.0, LENGTH / count * (1 + extension)])
    angle = twist * np.arange(count)
    e1 = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return scene, placed(scene, [anchor + np.arange(1, count + 1)[:, None] * z], [e1])


def converges_to(expected: float, found: list[float]) -> None:
    """Second order in h as h is halved from one value to the next."""
    errors = np.abs(np.array(found) / expected - 1)
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(2.0, abs=ORDER_TOLERANCE)
    assert (4 * found[-1] - found[-2]) / 3 == pytest.approx(expected, rel=TOLERANCE["float64"])


def zero_of(f: Callable[[float], float], low: float, high: float) -> float:
    """Root by the secant method."""
    at_low, at_high = f(low), f(high)
    while abs(high - low) > 1e-9 * abs(high):
        low, high, at_low = high, high - at_high * (high - low) / (at_high - at_low), at_high
        at_high = f(high)
    return high


def test_cantilever(device):
    """A force F across the end of a clamped rod: deflection F L^3/(3A), L from the middle of the clamped segment."""
    found = []
    for count in COUNTS:
        scene, start = straight_rod(count)
        free = [(i, 1) for i in range(2, count + 1)]
        load = np.eye(len(free))[-1]
        deflection = np.linalg.solve(stiffness(scene, start, free, device), load)[-1]
        effective = LENGTH - LENGTH / count / 2
        found.append(deflection * 3 * RIGIDITY / effective**3)
    converges_to(1.0, found)


def test_euler_buckling(device):
    """The end load at which a clamped-free rod loses its stiffness: pi^2 A/(4 L^2)."""
    found = []
    for count in COUNTS:

        def lowest(load: float, count: int = count) -> float:
            scene, start = straight_rod(count, extension=-load / STIFF)
            free = [(i, 1) for i in range(2, count + 1)]
            return float(np.linalg.eigvalsh(stiffness(scene, start, free, device))[0])

        effective = LENGTH - LENGTH / count / 2
        found.append(zero_of(lowest, 1.0, 2.0) * 4 * effective**2 / RIGIDITY)
    converges_to(math.pi**2, found)


def greenhill() -> float:
    """M L/A at which a twisted rod, clamped at both ends and free to shorten, buckles.

    w = x + i y obeys A w'''' = i M w'''; w = c_0 + c_1 s + c_2 s^2 + c_3 exp(i M s/A) with w = w' = 0 at s = +-L/2 has
    a solution where tan x = x, x = M L/(2A): x = 4.4934 and M L/A = 8.9868.
    """
    return 2 * zero_of(lambda x: math.sin(x) - x * math.cos(x), 4.4, 4.6)


def test_greenhill_twist_buckling(device):
    assert greenhill() == pytest.approx(8.987, abs=1e-3)
    twist_rigidity, found = 7.0, []
    for count in COUNTS:
        h = LENGTH / count

        def lowest(moment: float, count: int = count, h: float = h) -> float:
            values = {"flagella.twist_rigidity": twist_rigidity}
            scene, start = straight_rod(count, twist=moment * h / twist_rigidity, values=values)
            free = [(i, axis) for i in range(2, count - 1) for axis in (0, 1)]
            return float(np.linalg.eigvalsh(stiffness(scene, start, free, device))[0])

        expected = greenhill() * RIGIDITY / (LENGTH - h)
        found.append(zero_of(lowest, 0.9 * expected, expected) * (LENGTH - h) / RIGIDITY)
    converges_to(greenhill(), found)


def helix(length: float, count: int, scale: float = 1.0, stretching: float = 1e3) -> tuple[Scene, InitialState]:
    """The paper's filament with all its strains scaled."""
    scene = cell({
        "flagella.count": 1,
        "flagella.length": length,
        "flagella.segment_length": length / count,
        "flagella.stretching_stiffness": stretching,
        "hydrodynamics.mode": "none",
        "body.contact": False,
        "motor.torque": 0.0,
    })  # fmt: skip
    frames = ground_state_frames(count, length / count, scale * np.array(scene.flagella.intrinsic_curvature))
    anchor, _ = attachment(scene, scene.resolved_flagella()[0])
    nodes = anchor + np.cumsum(length / count * frames[:, :, 2], axis=0)
    return scene, placed(scene, [nodes], [frames[:, :, 0]])


@pytest.mark.parametrize("scale", [0.9, 1.15])
def test_helix_under_an_end_moment_stays_a_helix(scale, device):
    """With A = C a moment M along the axis only scales the strains: |Omega| = |Omega^0| +- M/A, and no force arises."""
    moments, rest = [], []
    for count in (15, 30, 60):
        scene, start = helix(3.0, count, scale)
        forces, torques = (a[0] for a in forces_and_torques(scene, [start], device))
        axis, _ = helix_axis(start.positions[0])
        x = start.positions[0]
        t = unit(np.diff(x, axis=0))
        # All that acts beyond the middle: the elastic forces there balance what the rest of the rod exerts.
        half = np.arange(count // 2, count + 1)
        end = np.cross(x[half], forces[half]).sum(axis=0) + torques[half] @ t[half - 1]
        end -= np.cross(x[half[0]], forces[half].sum(axis=0))
        moments.append(end @ axis)
        rest.append([np.linalg.norm(end - (end @ axis) * axis), np.linalg.norm(forces[half].sum(axis=0))])
    # Frames of a left-handed helix turn by -|Omega| about the axis: wound up further, it drives its end back by +M.
    converges_to((scale - 1) * math.hypot(1.3, 2.1) * RIGIDITY, moments)
    across, force = np.array(rest).T
    for none in (across, force):
        assert np.log2(none[:-1] / none[1:]) == pytest.approx(2.0, abs=ORDER_TOLERANCE)
        assert none[-1] < 1e-3


def test_soft_helical_spring(device):
    """Pulled by a force along its axis, ends free to turn, A = C: L R^2/A longer per force, besides the stretch
    L cos^2/K, for the moment is F R everywhere. 0.130 um/pN for the paper's filament of 10 um."""
    strain, length, stretching = math.hypot(1.3, 2.1), 10.0, 1e5
    radius, cosine = 1.3 / strain**2, 2.1 / strain
    assert length * radius**2 / RIGIDITY == pytest.approx(0.130, abs=5e-4)
    found = []
    for count in (25, 50, 100):
        h = length / count
        scene, start = helix(length, count, stretching=stretching)
        axis, point = helix_axis(start.positions[0])
        x = start.positions[0]
        t = unit(x[-1] - x[-2])
        # The force acts on the axis, at a lever from the last node: a force there, a couple on the last segment's
        # ends and a torque on its spin. The same numbers give the axis point's displacement from the nodes'.
        moment = np.cross(point + ((x[-1] - point) @ axis) * axis - x[-1], axis)
        load = np.zeros((count + 1, 4))
        load[-1] = [*(axis + np.cross(moment, t) / h), moment @ t]
        load[-2, :3] = -np.cross(moment, t) / h
        free = [(i, component) for i in range(2, count + 1) for component in range(4)]
        loads = np.array([load[i] for i in free])
        compliance = loads @ np.linalg.solve(stiffness(scene, start, free, device), loads)
        # Both end segments are rigid: a clamp and a lever.
        found.append(compliance / (length - h))
    converges_to(radius**2 / RIGIDITY + cosine**2 / stretching, found)
