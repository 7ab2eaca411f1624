"""The measures on the record of a run: frame by frame, and over a window of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from warpflag.observables import bundle, contact, motion, phase, shape
from warpflag.observables.arrays import Array, elapsed, flagella, unit
from warpflag.record import Record
from warpflag.scene import Scene, loads

__all__ = [
    "Swimming",
    "bundle_lengths",
    "elastic_energies",
    "phase_profile",
    "steric_force_densities",
    "strains",
    "swimming",
]


def phase_profile(record: Record, a: int = 0, b: int = 1) -> Array:
    """theta(i) of flagella a and b, shape [frame_count, segment_count of the shorter]; see `local_phase_difference`."""
    first, second = (_rows(record, k) for k in (a, b))
    count = min(first.stop - first.start, second.stop - second.start)
    positions, directors = record.positions[:], record.directors[:]
    frames = []
    for rows in (slice(first.start, first.start + count), slice(second.start, second.start + count)):
        frames += [directors[:, rows][:, 1:], phase.segment_tangents(positions[:, rows])]
    return phase.local_phase_difference(*frames)


def bundle_lengths(record: Record, gap: float = 0.0) -> Array:
    """l_r of every frame, shape [frame_count]; passing over a gap [um]; with 0 what the record itself holds."""
    first_node = record.first_node
    return np.array([bundle.bundle_length(x, first_node, gap=gap) for x in record.positions[:]])


def steric_force_densities(record: Record, rule: Literal["pairs", "nodes", "net"] = "pairs") -> Array:
    """f_c of every frame by one of the rules [pN/um], shape [frame_count]; see `steric_force_density`."""
    scene, first_node = loads(record.scene_text), record.first_node
    if not scene.steric.enabled:
        return np.zeros(record.frame_count)
    given = scene.steric.diameter
    diameter = 4.0 * scene.flagella.filament_radius if given is None else given
    length = float(np.mean([spec.length for spec in scene.resolved_flagella()]))
    law = scene.steric.strength, diameter, length
    return np.array([contact.steric_force_density(x, first_node, *law, rule) for x in record.positions[:]])


def strains(record: Record, flagellum: int = 0) -> Array:
    """Omega_1, Omega_2, Omega_3 at the joints of segments 1..N of a flagellum [1/um], [frame_count, N - 1, 3]."""
    rows, h = _rows(record, flagellum), loads(record.scene_text).resolved_flagella()[flagellum].segment_length
    tangents = phase.segment_tangents(record.positions[:][:, rows])
    return shape.strain(tangents, record.directors[:][:, rows][:, 1:], h)


def elastic_energies(record: Record) -> Array:
    """Bending, twist and stretching energy of every frame [pN um], shape [frame_count, 3]."""
    scene, first_node = loads(record.scene_text), record.first_node
    axes = _motor_axes_in_lab(record, scene)
    frames = zip(record.positions[:], record.directors[:], axes, strict=True)
    return np.array([shape.elastic_energy(scene, x, e1, m, first_node) for x, e1, m in frames])


@dataclass(frozen=True)
class Swimming:
    """What a cell does over a window of its record. Rates by difference over the window; see the functions named.

    Attributes:
        start, stop: first and last frame of the window [s].
        body_speed: along the body axis, forward [um/s].
        net_speed: displacement over time [um/s].
        body_rate: of the body about its axis, which points to the rear [Hz].
        motor_rate, motor_rate_lab: of the motors relative to the body and in the lab [Hz], shape [flagellum_count].
        helix_rate: of the flagella about their helix axes in the lab [Hz], shape [flagellum_count].
        pitch: of the flagella, negative for left-handed [um], mean over flagella and frames.
        phase_velocity: v_e, from pitch and mean helix rate [um/s].
        thrust: of the flagella on the body along its axis [pN].
        motor_power: work of all motors over the time [pN um/s].
        stored_power: growth of the elastic energy over the time [pN um/s].
        body_power: what the fluid takes from the body [pN um/s]; it takes the rest from the flagella.
    """

    start: float
    stop: float
    body_speed: float
    net_speed: float
    body_rate: float
    motor_rate: Array
    motor_rate_lab: Array
    helix_rate: Array
    pitch: float
    phase_velocity: float
    thrust: float
    motor_power: float
    stored_power: float
    body_power: float


def swimming(record: Record, start: float | None = None, stop: float | None = None) -> Swimming:
    """Measures a window of a record, from `start` to `stop` [s]; default: the last third.

    Raises ValueError where it holds fewer than two frames.
    """
    scene, first_node, times = loads(record.scene_text), record.first_node, record.times
    window = _window(record, start, stop)
    times, positions = times[window], record.positions[window]
    duration = elapsed(times)
    body_positions, orientations = record.body_position[window], record.body_orientation[window]
    motor_rate = motion.motor_rate(times, record.motor_angle[window])
    helix_rate = motion.helix_rate(times, positions, first_node)
    pitch = float(np.mean([shape.helix_pitch(x[rows]) for x in positions for rows in flagella(first_node)]))
    speed = motion.body_speed(times, body_positions, orientations)
    energy = record.observables["elastic_energy"][window]
    return Swimming(
        start=float(times[0]),
        stop=float(times[-1]),
        body_speed=speed,
        net_speed=motion.net_speed(times, body_positions),
        body_rate=motion.body_rate(times, orientations),
        motor_rate=motor_rate,
        motor_rate_lab=motion.lab_motor_rate(times, record.motor_angle[window], orientations, motion.motor_axes(scene)),
        helix_rate=helix_rate,
        pitch=pitch,
        phase_velocity=shape.phase_velocity(pitch, float(helix_rate.mean())),
        thrust=motion.thrust(speed, scene),
        motor_power=float(2 * np.pi * motor_rate @ [spec.torque for spec in scene.resolved_flagella()]),
        stored_power=float(energy[-1] - energy[0]) / duration,
        body_power=motion.body_power(times, body_positions, orientations, scene),
    )


def _window(record: Record, start: float | None, stop: float | None) -> slice:
    times = record.times
    start = times[0] + 2 / 3 * (times[-1] - times[0]) if start is None else start
    stop = times[-1] if stop is None else stop
    slack = 1e-9 * times[-1]  # k duration/frames and a time typed by hand differ in the last bit
    return slice(int(np.searchsorted(times, start - slack)), int(np.searchsorted(times, stop + slack)))


def _rows(record: Record, flagellum: int) -> slice:
    return list(flagella(record.first_node))[flagellum]


def _motor_axes_in_lab(record: Record, scene: Scene) -> Array:
    """m of every frame and flagellum, shape [frame_count, flagellum_count, 3]."""
    q, axes = unit(record.body_orientation), motion.motor_axes(scene)
    vector, w = np.broadcast_to(q[:, None, :3], (len(q), *axes.shape)), q[:, None, 3:]
    return axes + 2 * w * np.cross(vector, axes) + 2 * np.cross(vector, np.cross(vector, axes))
