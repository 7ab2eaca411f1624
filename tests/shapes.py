"""Shapes and motions with known measures: helices, lines, and a whole record of two flagella that zip."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.helpers import quaternion, rotation
from warpflag import observables
from warpflag.record import RECORD_NAME, Frame
from warpflag.record.recorder import Recorder
from warpflag.record.reporters import start_reporter
from warpflag.scene import paper_scene, with_values


def helix(node_count, *, axis_offset=(0.0, 0.0, 0.0), phase=0.0, radius=0.22, pitch=2.14, h=0.2, handedness=-1):
    """Nodes of a helix about the z direction and directors across z, which turn with the helix."""
    turn = 2 * np.pi * radius
    s = h * np.arange(node_count)
    angle = handedness * 2 * np.pi * s / np.hypot(turn, pitch) + phase
    nodes = np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch * s / np.hypot(turn, pitch)], axis=-1)
    tangents = observables.segment_tangents(nodes)
    directors = np.cross([0.0, 0.0, 1.0], tangents)
    directors /= np.linalg.norm(directors, axis=1, keepdims=True)
    return nodes + axis_offset, np.vstack([[1.0, 0.0, 0.0], directors])


def bent_helix(node_count, *, bend, phase=0.0, radius=0.22, pitch=2.14, h=0.2):
    """Nodes of a left-handed helix about an arc of radius `bend` in the xz plane, along z at the origin."""
    contour = np.hypot(2 * np.pi * radius, pitch)
    s = h * np.arange(node_count)
    angle, along = phase - 2 * np.pi * s / contour, pitch * s / contour / bend
    zero = np.zeros_like(s)
    centre = bend * np.stack([1.0 - np.cos(along), zero, np.sin(along)], axis=-1)
    inward = np.stack([np.cos(along), zero, -np.sin(along)], axis=-1)
    return centre + radius * (np.cos(angle)[:, None] * inward + np.sin(angle)[:, None] * [0.0, 1.0, 0.0])


def line(node_count, *, x=0.0, y=0.0, h=0.2, tilt=0.0):
    """Nodes of a straight line along z; tilt moves it along x by so much per unit of z."""
    z = h * np.arange(node_count)
    return np.stack([x + tilt * z, np.full_like(z, y), z], axis=-1)


def joined(*flagella):
    return np.concatenate(flagella), np.cumsum([0, *(len(nodes) for nodes in flagella)])


PARTED = 0.48  # um; distance of the flagella of `Zipping` at a front that is not abrupt, beyond the bundle's 0.44


class Zipping:
    """Two left-handed helices of 31 nodes that turn at 300 Hz and bundle from the motor on, on a body that swims.

    The front starts at 40 % of the contour and moves at 100 contours a second from 1 ms on; before, nothing is bundled.
    All of it in axes turned in the lab. Frames every 0.05 ms to 8 ms.

    values: of the scene that the record names, whatever the shape.
    split: how fast the second flagellum leaves the first at the front [um of distance per um of contour]; 0: at once, a
    segment across, which no axis of a turn survives.
    """

    helix_rate, motor_rate, body_rate, body_speed = 300.0, 400.0, -60.0, 150.0
    pitch, segments, start, onset, front_speed = -2.14, 30, 0.4, 1e-3, 100.0

    def __init__(self, directory: Path, split: float = 0.0, values: dict | None = None) -> None:
        self.directory, self.split = directory, split
        self.scene = with_values(paper_scene(name="made-up"), values or {})
        self.times = 5e-5 * np.arange(161)
        first_node = np.array([0, 31, 62])
        recorder = Recorder(directory / RECORD_NAME)
        start_reporter(recorder, self.scene, first_node)
        for step, time in enumerate(self.times):
            recorder.write(self._frame(step, float(time), first_node))
        recorder.close()

    def front(self, times):
        """l_r of the construction, before it is cut to whole nodes; below 0 before the onset."""
        return np.minimum(self._grown(times), 1.0)

    def _grown(self, times):
        """The same, and beyond the tips when it has passed them."""
        grown = self.start + self.front_speed * (np.asarray(times) - self.onset)
        return np.where(np.asarray(times) < self.onset - 1e-9, -1.0, grown)

    def _frame(self, step: int, time: float, first_node: np.ndarray) -> Frame:
        pitch, phase = abs(self.pitch), 2 * np.pi * self.helix_rate * time
        nodes, directors = helix(31, phase=phase, pitch=pitch)
        beyond = 0.2 * np.arange(31) - 6.0 * self._grown(time) - 1e-9
        apart = np.where(beyond > 0.0, 2.0, 0.3)
        if self.split:
            apart = np.clip(PARTED + self.split * beyond, 0.3, 2.0)
        other = nodes + apart[:, None] * [1.0, 0.0, 0.0]
        turn = rotation([0.3, -0.2, 0.1])
        forward = turn @ [0.0, 0.0, -1.0]
        centre = self.body_speed * time * forward
        # About e_b3 first, then the whole frame.
        spin, whole = quaternion([0.0, 0.0, 2 * np.pi * self.body_rate * time]), quaternion([0.3, -0.2, 0.1])
        orientation = np.array([
            *(whole[3] * spin[:3] + spin[3] * whole[:3] + np.cross(whole[:3], spin[:3])),
            whole[3] * spin[3] - whole[:3] @ spin[:3],
        ])  # fmt: skip
        positions = np.concatenate([nodes, other]) @ turn.T + centre
        e1 = np.concatenate([directors, directors]) @ turn.T
        return Frame(
            time=time,
            step=step,
            positions=positions,
            directors=e1,
            motor_angle=np.full(2, 2 * np.pi * self.motor_rate * time),
            body_position=centre,
            body_orientation=orientation,
            observables={
                "phase_difference": observables.phase_difference(positions, e1, first_node),
                "bundle_length": observables.bundle_length(positions, first_node),
                "steric_force_density": 1.0 + time,
                "elastic_energy": 3.0 + 50.0 * time,
            },
        )
