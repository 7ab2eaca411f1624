"""Precision, module options and the structs of device arrays that every kernel shares.

Elements are stored flagellum after flagellum, cell after cell. Element i of a flagellum is the pair (node r_i,
segment i): segment i >= 1 ends at r_i, segment 0 is the motor tripod whose tangent is the motor axis m. So nodes and
segments share one index, and ragged batches need only offset tables.

Positions are relative to the body centre, in lab axes: float32 does not lose digits with the distance swum. Body
pose, times and accumulated angles are float64 in both precisions.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

# Vector code for this machine's CPU. Reassociation lets sums vectorise; NaN and infinity keep their meaning, because
# the guards need them.
FAST_CPU_FLAGS = (
    "-march=native -mreassociate -fno-signed-zeros -freciprocal-math -ffp-contract=fast "
    "-mprefer-vector-width=512 -mllvm=-inline-threshold=9000"
)
STRICT_CPU_FLAGS = "-march=native -ffp-contract=off"


@dataclass(frozen=True)
class Precision:
    """One floating-point type and the build that uses it.

    Attributes:
        name: "float64" or "float32".
        strict: build without reassociation, contraction or reciprocals (reproducible to the last bit).
    """

    name: str
    strict: bool = False

    @property
    def real(self) -> Any:
        return {"float64": wp.float64, "float32": wp.float32}[self.name]

    @property
    def vec3(self) -> Any:
        return {"float64": wp.vec3d, "float32": wp.vec3f}[self.name]

    @property
    def vec4(self) -> Any:
        return {"float64": wp.vec4d, "float32": wp.vec4f}[self.name]

    @property
    def quat(self) -> Any:
        return {"float64": wp.quatd, "float32": wp.quatf}[self.name]

    @property
    def mat33(self) -> Any:
        return {"float64": wp.mat33d, "float32": wp.mat33f}[self.name]

    @property
    def cpu_flags(self) -> str:
        return STRICT_CPU_FLAGS if self.strict else FAST_CPU_FLAGS

    def module(self, stage: str, variant: str = "") -> Any:
        """Warp module of one stage in this precision; a variant is a set of switches compiled in."""
        parts = ["warpflag_kernels", stage, self.name, "strict" if self.strict else "fast", variant]
        module = wp.get_module(".".join(part for part in parts if part))
        module.options.update({"enable_backward": False, "cpu_compiler_flags": self.cpu_flags, "fast_math": False})
        return module


@functools.cache
def structs(p: Precision) -> SimpleNamespace:
    """The structs `Model` (constant during a run), `State` (the current evaluation point and its forces), `PairSum`,
    `Neighbours`.

    C cells, K flagella, E elements. An array that the scene does not need stays empty.
    """
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Model:
        # Topology.
        cell_of: wp.array(dtype=wp.int32)  # [E]
        flagellum_of: wp.array(dtype=wp.int32)  # [E]
        first_node: wp.array(dtype=wp.int32)  # [K + 1]
        first_flagellum: wp.array(dtype=wp.int32)  # [C + 1]
        # Rod, per flagellum [K].
        segment_length: wp.array(dtype=real)  # h [um]
        bending_rigidity: wp.array(dtype=real)  # A [pN um^2]
        twist_rigidity: wp.array(dtype=real)  # C [pN um^2]
        hook_rigidity: wp.array(dtype=real)  # twist rigidity of the motor joint [pN um^2]
        stretching_stiffness: wp.array(dtype=real)  # K [pN]
        rest_strain: wp.array(dtype=vec3)  # h Omega^0 [rad]
        # Motor and anchor, per flagellum [K]; vectors in body axes.
        motor_torque: wp.array(dtype=real)  # [pN um]
        motor_axis: wp.array(dtype=vec3)
        anchor: wp.array(dtype=vec3)  # [um]
        # Local drag.
        mobility_along: wp.array(dtype=real)  # [E], along the tangent [um/(s pN)]
        mobility_across: wp.array(dtype=real)  # [E] [um/(s pN)]
        spin_mobility: wp.array(dtype=real)  # [K] [1/(pN um s)]
        # Pair sum, per cell [C].
        pair_radius: wp.array(dtype=real)  # [um]
        pair_mobility: wp.array(dtype=real)  # 1/(8 pi eta) [um^2/(s pN)]
        # Steric, per cell [C].
        steric_strength: wp.array(dtype=real)  # F_0 [pN]
        steric_diameter: wp.array(dtype=real)  # sigma [um]
        # Body, per cell [C]: capsule surface, mobility of the spheroid along and across its axis.
        body_half_length: wp.array(dtype=real)  # of the capsule's axis [um]
        body_radius: wp.array(dtype=real)  # [um]
        body_mobility_along: wp.array(dtype=real)  # [um/(s pN)]
        body_mobility_across: wp.array(dtype=real)
        body_spin_mobility: wp.array(dtype=real)  # about the axis [1/(pN um s)]
        body_tumble_mobility: wp.array(dtype=real)  # across the axis [1/(pN um s)]

    @wp.struct
    class State:
        # Where: the current evaluation point.
        position: wp.array(dtype=vec3)  # [E], node relative to the body centre, lab axes [um]
        tangent: wp.array(dtype=vec3)  # [E], e3 of the segment
        director: wp.array(dtype=vec3)  # [E], e1 of the segment
        length: wp.array(dtype=real)  # [E], of the segment [um]
        body_position: wp.array(dtype=wp.vec3d)  # [C] [um]
        body_orientation: wp.array(dtype=wp.quatd)  # [C], body axes to lab axes
        body_axis: wp.array(dtype=vec3)  # [C], e_b3, points to the rear
        # Which cells take part in this pass.
        active: wp.array(dtype=wp.int32)  # [C]
        # Joint i couples segments i and i + 1: energy gradients with respect to the two segment vectors and spins.
        joint_before: wp.array(dtype=vec3)  # [E] [pN]
        joint_after: wp.array(dtype=vec3)  # [E] [pN]
        joint_spin_before: wp.array(dtype=real)  # [E] [pN um]
        joint_spin_after: wp.array(dtype=real)  # [E] [pN um]
        # Steric forces of a segment, on its first and on its second node; contact of a node with the body.
        steric_first: wp.array(dtype=vec3)  # [E] [pN]
        steric_second: wp.array(dtype=vec3)  # [E] [pN]
        body_contact: wp.array(dtype=vec3)  # [E] [pN]
        # Totals.
        force: wp.array(dtype=vec3)  # [E]; on r_0: what the anchor hands to the body [pN]
        spin_torque: wp.array(dtype=real)  # [E], about the tangent [pN um]
        velocity: wp.array(dtype=vec3)  # [E], of the node, lab [um/s]
        flagellum_force: wp.array(dtype=vec3)  # [K], of a flagellum on the body [pN]
        flagellum_torque: wp.array(dtype=vec3)  # [K], about the body centre [pN um]
        body_velocity: wp.array(dtype=vec3)  # [C] [um/s]
        body_spin: wp.array(dtype=vec3)  # [C] [rad/s]

    @wp.struct
    class PairSum:
        # One array per component: what lets a compiler fill its vector registers. [E] each.
        x: wp.array(dtype=real)  # position [um]
        y: wp.array(dtype=real)
        z: wp.array(dtype=real)
        fx: wp.array(dtype=real)  # force, zero on r_0, which the sum leaves to the body [pN]
        fy: wp.array(dtype=real)
        fz: wp.array(dtype=real)
        ux: wp.array(dtype=real)  # 8 pi eta times the velocity [pN/um]; only where pairs are summed by halves
        uy: wp.array(dtype=real)
        uz: wp.array(dtype=real)
        # What float64 runs add up of it; only where their pairs are float32 and summed by halves.
        total_x: wp.array(dtype=wp.float64)
        total_y: wp.array(dtype=wp.float64)
        total_z: wp.array(dtype=wp.float64)

    @wp.struct
    class Neighbours:
        position: wp.array(dtype=vec3)  # [E], of the nodes when the lists were built [um]
        left: wp.array(dtype=wp.int32)  # [K], 1: a node has moved by more than half the skin since
        # When that was last asked; [E + BLOCK] midpoints of segments and half their lengths, a tenth added.
        x: wp.array(dtype=wp.float32)  # [um]
        y: wp.array(dtype=wp.float32)
        z: wp.array(dtype=wp.float32)
        half: wp.array(dtype=wp.float32)
        extent: wp.array(dtype=real)  # [K], of a flagellum around its middle node [um]
        stale: wp.array(dtype=wp.int32)  # [C], 1: the lists no longer hold
        count: wp.array(dtype=wp.int32)  # [E], segments listed; -1: more than there is room for
        earlier: wp.array(dtype=wp.int32)  # [E], how many of them are of earlier flagella
        segment: wp.array(dtype=wp.int32)  # [E * SLOTS]

    return SimpleNamespace(Model=Model, State=State, PairSum=PairSum, Neighbours=Neighbours)


@dataclass(frozen=True)
class Switches:
    """The terms a scene asks for. What is off is not compiled, allocated or launched.

    Attributes:
        pairs: which nodes the pair sum couples: "none", "within" one flagellum, "between" flagella, or "all".
        steric: contact between segments of different flagella.
        body_contact: contact between nodes and the body surface.
        bearing_torque: the hook hands its bearing torque to the body, so the swimmer is torque-free.
        short_pairs: every pair of the sum in float32, their sums in float64; in a float64 run.
    """

    pairs: str
    steric: bool
    body_contact: bool
    bearing_torque: bool
    short_pairs: bool


@dataclass(frozen=True)
class DeviceModel:
    """Model on a device.

    Attributes:
        data: the struct `Model` of this precision.
        groups: the struct `Groups`: flagella that a CPU takes side by side.
        cell_count, flagellum_count, element_count: sizes C, K, E.
        largest_cell: moving nodes of the largest cell.
    """

    precision: Precision
    switches: Switches
    device: Any
    cell_count: int
    flagellum_count: int
    element_count: int
    largest_cell: int
    data: Any
    groups: Any

    @property
    def pair_precision(self) -> Precision:
        """Of the terms of the pair sum."""
        return Precision("float32", self.precision.strict) if self.switches.short_pairs else self.precision

    @property
    def one_thread_per_cell(self) -> bool:
        """Whether a launch is cut by cells: on a CPU, where its threads take turns. The strict build is cut finer."""
        return self.device.is_cpu and not self.precision.strict

    @property
    def threads_cooperate(self) -> bool:
        """Whether several threads work together on one node or one cell: on a GPU."""
        return self.device.is_cuda


@dataclass(frozen=True)
class DeviceState:
    """State on a device: the structs `State` and `Neighbours` of this precision, `PairSum` of that of the pairs."""

    data: Any
    pairs: Any
    neighbours: Any
