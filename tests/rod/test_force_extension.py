"""Force and extension of whole helices, far from their shape at rest: the published filaments, normal and coiled.

A helix of uniform strain is pulled by a force along its axis with ends free to turn. Its strain is that at which the
program's forces beyond a cut in its middle add up to the force, without torque about the axis.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import attachment, ground_state_frames, helix_axis, placed, rod, unit
from warpflag.run.simulation import Simulation

# Relative, of the extension by that of a smooth filament: that of h = 0.1 is 0.2 % off. Newton's method takes forces
# that float32 is too coarse for.
TOLERANCE = {"float64": 5e-3}

LENGTH, SEGMENT, STIFF = 6.0, 0.1, 1e6  # um, um, K in pN: no stretch
FORCES = (0.0, 2.0, 4.0, 6.0)  # pN
NORMAL, COILED = (1.3, 2.1), (1.82, 0.6)  # curvature, torsion [1/um]
# Minimum of A/2 [(k - k0)^2 + (t - t0)^2] - F t/sqrt(k^2 + t^2) over helices (k, t), A = C = 3.5 pN um^2.
EXTENSIONS = {NORMAL: (0.8503, 0.8734, 0.8919, 0.9070), COILED: (0.3131, 0.4437, 0.5565, 0.6528)}


def pulled(form: tuple[float, float], shapes: np.ndarray, force: float, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Of helices (k, t), shape [shape, 2]: force and torque beyond the cut less those asked for, and the extension."""
    scene = rod({
        "flagella.length": LENGTH,
        "flagella.segment_length": SEGMENT,
        "flagella.stretching_stiffness": STIFF,
        "flagella.intrinsic_curvature": (0.0, form[0], -form[1]),
    })  # fmt: skip
    (spec,) = scene.resolved_flagella()
    anchor = attachment(scene, spec)[0]
    starts = []
    for curvature, torsion in shapes:
        frames = ground_state_frames(spec.segment_count, SEGMENT, np.array([0.0, curvature, -torsion]))
        t = frames[:, :, 2]
        axis = helix_axis(np.cumsum(t, axis=0))[0]
        steps = SEGMENT * t * (1 + force * (t @ axis)[:, None] / STIFF)
        starts.append(placed(scene, [anchor + np.cumsum(steps, axis=0)], [frames[:, :, 0]]))
    sim = Simulation([scene] * len(starts), device=device, starts=starts)
    sim.evaluate()
    state = sim.system.state.data
    forces = state.force.numpy().reshape(len(starts), -1, 3)
    torques = state.spin_torque.numpy().reshape(len(starts), -1)
    left, extensions = [], []
    for start, f, q in zip(starts, forces, torques, strict=True):
        x = start.positions[0]
        t = unit(np.diff(x, axis=0))
        axis = helix_axis(x[1:])[0]
        m = len(x) // 2
        total = f[m:].sum(axis=0)
        torque = np.cross(x[m:] - x[m], f[m:]).sum(axis=0) + q[m + 1 :] @ t[m:]
        left.append([total @ axis + force, torque @ axis])  # the rod pulls back
        extensions.append(t[1:].mean(axis=0) @ axis)
    return np.array(left), np.array(extensions)


@pytest.mark.parametrize("form", [NORMAL, COILED], ids=["normal", "coiled"])
def test_a_filament_is_as_long_under_a_force_as_a_smooth_helix(form, device):
    shape, step, found = np.array(form), 1e-6, []
    for force in FORCES:
        for _ in range(6):
            near = shape + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
            left, extensions = pulled(form, near, force, device)
            slope = np.stack([left[1] - left[2], left[3] - left[4]], axis=1) / (2 * step)
            shape = shape - np.linalg.solve(slope, left[0])
        assert np.abs(left[0]).max() < 1e-6
        found.append(extensions[0])
    assert found == pytest.approx(EXTENSIONS[form], rel=TOLERANCE["float64"])
