"""The measures on the record of a run: frame by frame, and over a window of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from warpflag.base import rotations
from warpflag.observables import bundle, contact, motion, phase, shape
from warpflag.observables.arrays import Array, elapsed, flagella
from warpflag.record import Record
from warpflag.scene import Scene, loads

__all__ = [
    "Swimming",
    "bundle_lengths",
    "elastic_energies",
    "motor_torques",
    "phase_profile",
    "steric_force_densities",
    "strains",
    "swimming",
]


def phase_profile(record: Record, a: int = 0, b: int = 1) -> Array:
    """Local phase difference theta(i) of two flagella, shape [frame_count, segment_count of the shorter].

    Args:
        record: of the run.
        a: number of one flagellum.
        b: number of the other.

    Raises:
        RecordError: the record can't be read.
    """
    first, second = (_rows(record, k) for k in (a, b))
    count = min(first.stop - first.start, second.stop - second.start)
    positions, directors = record.positions[:], record.directors[:]
    frames = []
    for rows in (slice(first.start, first.start + count), slice(second.start, second.start + count)):
        frames += [directors[:, rows][:, 1:], phase.segment_tangents(positions[:, rows])]
    return phase.local_phase_difference(*frames)


def bundle_lengths(record: Record, gap: float = 0.0) -> Array:
    """Bundle length l_r of every frame, shape [frame_count].

    Args:
        record: of the run.
        gap: contour length that does not end a bundle [um], as in `bundle_length`; with 0 it is what records hold.

    Raises:
        RecordError: the record can't be read.
    """
    return bundle.bundle_length(record.positions[:], record.first_node, gap=gap)


def steric_force_densities(record: Record, rule: Literal["pairs", "nodes", "net"] = "pairs") -> Array:
    """Steric force density f_c of every frame [pN/um], shape [frame_count].

    Args:
        record: of the run.
        rule: how forces are counted, as in `steric_force_density`.

    Raises:
        RecordError: the record can't be read.
    """
    scene, first_node = loads(record.scene_text), record.first_node
    if not scene.steric.enabled:
        return np.zeros(record.frame_count)
    given = scene.steric.diameter
    diameter = 4.0 * scene.flagella.filament_radius if given is None else given
    length = float(np.mean([spec.length for spec in scene.resolved_flagella()]))
    law = scene.steric.strength, diameter, length
    own = scene.steric.self_contact
    frames = record.positions[:]
    return np.array([contact.steric_force_density(x, first_node, *law, rule, self_contact=own) for x in frames])


def strains(record: Record, flagellum: int = 0) -> Array:
    """Omega_1, Omega_2, Omega_3 at the joints of segments 1..N of a flagellum [1/um], [frame_count, N - 1, 3].

    Args:
        record: of the run.
        flagellum: its number.

    Raises:
        RecordError: the record can't be read.
    """
    rows, h = _rows(record, flagellum), loads(record.scene_text).resolved_flagella()[flagellum].segment_length
    tangents = phase.segment_tangents(record.positions[:][:, rows])
    return shape.strain(tangents, record.directors[:][:, rows][:, 1:], h)


def elastic_energies(record: Record) -> Array:
    """Bending, twist and stretching energy of every frame [pN um], shape [frame_count, 3].

    Raises:
        RecordError: the record can't be read.
    """
    scene, first_node = loads(record.scene_text), record.first_node
    axes = _motor_axes_in_lab(record, scene)
    frames = zip(record.positions[:], record.directors[:], axes, strict=True)
    return np.array([shape.elastic_energy(scene, x, e1, m, first_node) for x, e1, m in frames])


@dataclass(frozen=True)
class Swimming:
    """How a cell swims over a window of its record. Rates are differences over the window.

    Attributes:
        start: time of the first frame of the window [s].
        stop: time of the last frame [s].
        body_speed: along the body axis, forward [um/s].
        net_speed: displacement over time [um/s].
        body_rate: of the body about its axis, which points to the rear [Hz].
        motor_rate: of the motors relative to the body [Hz], shape [flagellum_count].
        motor_rate_lab: of the motors in the lab [Hz], shape [flagellum_count].
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
    """Measures a window of a record.

    Args:
        record: of the run.
        start: of the window [s]; default: after two thirds of the run.
        stop: of the window [s]; default: the end of the run.

    Raises:
        ValueError: the window holds fewer than two frames.
        RecordError: the record can't be read.
    """
    scene, first_node, times = loads(record.scene_text), record.first_node, record.times
    window = record.window(start, stop)
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
        motor_power=_motor_power(record, scene, window, motor_rate),
        stored_power=float(energy[-1] - energy[0]) / duration,
        body_power=motion.body_power(times, body_positions, orientations, scene),
    )


def _motor_power(record: Record, scene: Scene, window: slice, rates: Array) -> float:
    """Mean power of all motors [pN um/s]; where torques are not constant by the trapezoidal rule over the frames."""
    torques = motor_torques(record, scene, window)
    if torques.ndim == 1:
        return float(2 * np.pi * rates @ torques)
    work = torques * np.diff(record.motor_angle[window], axis=0)
    return float(work.sum() / elapsed(record.times[window]))


def motor_torques(record: Record, scene: Scene, window: slice) -> Array:
    """Torques of the motors [pN um], shape [flagellum_count] where they are constant; else in each interval of a window
    of frames, the mean of its two ends, shape [frame_count - 1, flagellum_count]."""
    measured = record.observables.get("motor_torque")
    if measured is None:
        return np.array([spec.torque for spec in scene.resolved_flagella()])
    return 0.5 * (measured[window][1:] + measured[window][:-1])


def _rows(record: Record, flagellum: int) -> slice:
    return list(flagella(record.first_node))[flagellum]


def _motor_axes_in_lab(record: Record, scene: Scene) -> Array:
    """Motor axes m of every frame and flagellum, unit vectors, shape [frame_count, flagellum_count, 3]."""
    return rotations.rotated(record.body_orientation, motion.motor_axes(scene))
