"""The state of every cell of a simulation on the host, read with one copy of each array."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.contact import pair_forces
from warpflag_kernels.motor import hook
from warpflag_kernels.rod import elastic

from warpflag.model.terms import supplied_power
from warpflag.record.cell_state import CellState, Evaluation
from warpflag.scene import Scene
from warpflag.scene.helix import joint_strain
from warpflag.stepping import System

__all__ = ["Cells", "CellsReader", "evaluation_of", "motor_torques"]


@dataclass(frozen=True)
class Cells:
    """All cells of a batch at one look, on the host, in lab coordinates.

    Attributes:
        time: [s], shape [cell_count].
        step: steps taken, shape [cell_count].
        positions: nodes [um], shape [node_count, 3], cell after cell, flagellum after flagellum.
        directors: e1 of the tripods and the segments, shape [node_count, 3].
        tangents: e3 of the tripods and the segments, shape [node_count, 3].
        motor_angle: accumulated turn of each motor relative to its body [rad], shape [flagellum_count].
        body_angle: accumulated turn of each body about its axis e_b3 [rad], shape [cell_count].
        body_position: [um], shape [cell_count, 3].
        body_orientation: quaternions (x, y, z, w), shape [cell_count, 4].
        elastic_energy: bending (with the hook's), twist, stretching [pN um], shape [cell_count, 3].
        steric_force: sum of the contact forces between flagella, each pair once [pN], shape [cell_count].
        first_flagellum: cell c has the flagella first_flagellum[c] to first_flagellum[c + 1] - 1.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
    """

    time: np.ndarray
    step: np.ndarray
    positions: np.ndarray
    directors: np.ndarray
    tangents: np.ndarray
    motor_angle: np.ndarray
    body_angle: np.ndarray
    body_position: np.ndarray
    body_orientation: np.ndarray
    elastic_energy: np.ndarray
    steric_force: np.ndarray
    first_flagellum: np.ndarray
    first_node: np.ndarray

    def flagella(self, cell: int) -> slice:
        """The flagella of one cell; a negative index counts from the end."""
        cell = range(len(self.time))[cell]
        return slice(int(self.first_flagellum[cell]), int(self.first_flagellum[cell + 1]))

    def nodes(self, cell: int) -> slice:
        """The nodes of one cell."""
        own = self.flagella(cell)
        return slice(int(self.first_node[own.start]), int(self.first_node[own.stop]))

    def cell(self, cell: int) -> CellState:
        """One cell by itself."""
        flagella, nodes = self.flagella(cell), self.nodes(cell)
        return CellState(
            time=float(self.time[cell]),
            step=int(self.step[cell]),
            positions=self.positions[nodes],
            directors=self.directors[nodes],
            tangents=self.tangents[nodes],
            motor_angle=self.motor_angle[flagella],
            body_angle=float(self.body_angle[cell]),
            body_position=self.body_position[cell],
            body_orientation=self.body_orientation[cell],
            elastic_energy=self.elastic_energy[cell],
            steric_force=float(self.steric_force[cell]),
        )


class CellsReader:
    """Reads the cells of a system.

    Args:
        system: what is advanced.
    """

    def __init__(self, system: System) -> None:
        self._system, model = system, system.model
        self._energy = wp.zeros(model.element_count, dtype=model.precision.vec3, device=model.device)
        self._force = wp.zeros(model.element_count, dtype=model.precision.real, device=model.device)
        data = system.model.data
        self.first_flagellum, self.first_node = data.first_flagellum.numpy(), data.first_node.numpy()
        self._first_node_of_cell = self.first_node[self.first_flagellum[:-1]]
        self._cell_of_node = data.cell_of.numpy()

    def read(self) -> Cells:
        """All cells at the times that they have reached; no cell is active afterwards."""
        system = self._system
        model, state, chart, control = system.model, system.state, system.chart, system.control
        state.data.active.fill_(1)
        elastic.elastic_energy(model, state, self._energy)
        if model.switches.has("hook"):
            hook.add_energy(model, state, self._energy)
        steric_force = np.zeros(model.cell_count)
        if model.switches.steric:
            pair_forces.steric_magnitudes(model, state, self._force)
            steric_force = 0.5 * self._sums(self._force)
        state.data.active.zero_()
        centres = chart.base.body_position.numpy().copy()
        return Cells(
            time=control.time.numpy().copy(),
            step=control.steps.numpy().copy(),
            positions=chart.base.position.numpy().astype(np.float64) + centres[self._cell_of_node],
            directors=chart.base.director.numpy().astype(np.float64),
            tangents=chart.base.tangent.numpy().astype(np.float64),
            motor_angle=chart.motor_angle.numpy().copy(),
            body_angle=chart.body_angle.numpy().copy(),
            body_position=centres,
            body_orientation=chart.base.body_orientation.numpy().copy(),
            elastic_energy=self._sums(self._energy),
            steric_force=steric_force,
            first_flagellum=self.first_flagellum,
            first_node=self.first_node,
        )

    def _sums(self, values: Any) -> np.ndarray:
        """The sum over the nodes of each cell, shape [cell_count, ...]; independent of the other cells to the bit."""
        return np.add.reduceat(values.numpy().astype(np.float64), self._first_node_of_cell, axis=0)


def evaluation_of(system: System, scene: Scene, flagella: slice, nodes: slice) -> Evaluation:
    """Forces and velocities that the right-hand side has just left on the device, of one cell.

    Args:
        system: of the batch.
        scene: of the cell.
        flagella: of the cell.
        nodes: of the cell.
    """
    model, state = system.model, system.state.data
    first_node = model.data.first_node.numpy()[flagella.start : flagella.stop + 1]

    def host(array: Any, part: Any) -> np.ndarray:
        return array.numpy()[part].astype(np.float64)

    torques = host(state.spin_torque, nodes)
    cell = int(model.data.cell_of.numpy()[nodes.start])
    found = Evaluation(
        forces=host(state.force, nodes),
        torques=torques,
        velocities=host(state.velocity, nodes),
        spins=np.repeat(model.data.drag.spin_mobility.numpy()[flagella], np.diff(first_node)) * torques,
        tangents=host(state.pose.tangent, nodes),
        first=first_node[:-1] - nodes.start,
        motor_torques=motor_torques(system)[flagella],
        supplied={},
        positions=host(state.pose.position, nodes) + host(state.pose.body_position, cell),
        body_position=host(state.pose.body_position, cell),
        body_force=host(state.flagellum_force, flagella).sum(axis=0),
        body_torque=host(state.flagellum_torque, flagella).sum(axis=0),
        body_velocity=host(state.body_velocity, cell),
        body_spin=host(state.body_spin, cell),
    )
    supplied = supplied_power(scene, found)
    if model.switches.has("polymorphs"):
        supplied["polymorphs"] = _ramp_power(system, flagella, nodes)
    return dataclasses.replace(found, supplied=supplied)


def _ramp_power(system: System, flagella: slice, nodes: slice) -> float:
    """Rate at which ground states that change put energy into one cell at a pose that stands still [pN um/s]."""
    model, state = system.model.data, system.state.data
    forms, laws = system.state.optional.forms, system.model.optional.polymorphs
    own = np.arange(nodes.start, nodes.stop)
    form, before = forms.form.numpy()[own], forms.before.numpy()[own]
    rests = laws.rest_strain.numpy().reshape(-1, 3, 3).astype(np.float64)[own]
    of = model.flagellum_of.numpy()[own]
    ramp = laws.ramp.numpy()[of]
    share = (state.time.numpy()[model.cell_of.numpy()[nodes.start]] - forms.changed.numpy()[own]) / ramp
    pace = np.where((share >= 0.0) & (share < 1.0), 6.0 * share * (1.0 - share), 0.0) / ramp
    rows = np.arange(len(own))
    rate = pace[:, None] * (rests[rows, form] - rests[rows, before])
    power = 0.0
    first = model.first_node.numpy()
    for k in range(flagella.start, flagella.stop):
        here = slice(first[k] + 1, first[k + 1])  # segments 1 to N, with N - 1 joints
        tangents, directors, rest = (
            array.numpy()[here].astype(np.float64)
            for array in (state.pose.tangent, state.pose.director, forms.rest_strain)
        )
        a, c, h = (
            float(array.numpy()[k])
            for array in (model.rod.bending_rigidity, model.rod.twist_rigidity, model.rod.segment_length)
        )
        moment = np.array([a, a, c]) / h * (joint_strain(tangents, directors) - rest[:-1])
        local = slice(here.start - nodes.start, here.stop - 1 - nodes.start)
        power -= float((moment * rate[local]).sum())
    return power


def motor_torques(system: System) -> np.ndarray:
    """Torques of all motors at the state evaluated last [pN um], shape [flagellum_count]."""
    model = system.model
    if model.switches.has("motor law"):
        return system.state.optional.motor.torque.numpy().astype(np.float64)
    if model.switches.has("motor"):
        return model.data.motor.torque.numpy().astype(np.float64)
    return np.zeros(model.flagellum_count)
