"""Structs of device arrays that every kernel shares: the model of a batch, a pose, the state being evaluated.

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

from warpflag_kernels.base.plan import Plan, Switches
from warpflag_kernels.base.precision import Precision

NEVER = -1.0e30  # a time before any other [s]


@functools.cache
def structs(p: Precision) -> SimpleNamespace:
    """The structs `Model`, constant during a run, `Pose`, and `State`, one evaluation of the right-hand side.

    C cells, K flagella, E elements. An array that the scene does not need stays empty.
    """
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Rod:
        """Per flagellum [K], and the intrinsic strain of every joint."""

        segment_length: wp.array(dtype=real)  # h [um]
        bending_rigidity: wp.array(dtype=real)  # A [pN um^2]
        twist_rigidity: wp.array(dtype=real)  # C [pN um^2]
        hook_rigidity: wp.array(dtype=real)  # twist rigidity of the motor joint [pN um^2]
        stretching_stiffness: wp.array(dtype=real)  # K [pN]
        rest_strain: wp.array(dtype=vec3)  # [E], h Omega^0 of the joint after segment e [rad]

    @wp.struct
    class Motor:
        """Per flagellum [K]; vectors in body axes."""

        torque: wp.array(dtype=real)  # T_m [pN um]
        axis: wp.array(dtype=vec3)  # m, unit vector
        anchor: wp.array(dtype=vec3)  # r_0 [um]

    @wp.struct
    class MotorLaw:
        """Where the torque is not constant, see motor/laws.py; per flagellum [K] unless said otherwise."""

        kind: wp.array(dtype=wp.int32)  # which law it is, by the numbers of motor/laws.py
        curve: wp.array(dtype=vec3)  # [2 K], torque against rate, forward and reverse: the three numbers of that law
        rate: wp.array(dtype=real)  # prescribed, relative to the body [rad/s]
        first_switch: wp.array(dtype=wp.int32)  # [K + 1], flagellum k has the corners from first_switch[k] on
        switch_time: wp.array(dtype=wp.float64)  # [corners], time of a corner [s]
        switch_drive: wp.array(dtype=real)  # [corners], drive there, from 1 (forward) to -1 (reverse)

    @wp.struct
    class Polymorphs:
        """Three forms of every joint, see rod/polymorphs.py; per flagellum [K] unless said otherwise."""

        rest_strain: wp.array(dtype=vec3)  # [3 E], h Omega^0 of forms 0, 1 and 2 of every joint [rad]
        ramp: wp.array(dtype=wp.float64)  # in which a ground state changes [s]
        # Moments beyond which joints flip to form 1, and below which they flip back [pN um].
        nucleation: wp.array(dtype=wp.vec2d)  # at root and tip
        propagation: wp.array(dtype=wp.vec2d)  # beside a joint of the other form
        # When joints of form 1 go on to form 2.
        first_second: wp.array(dtype=wp.int32)  # [K + 1], flagellum k has the intervals from first_second[k] on
        second: wp.array(dtype=wp.vec2d)  # [intervals], beginning and end [s]

    @wp.struct
    class Hook:
        """Bending of the hook, per flagellum [K]."""

        stiffness: wp.array(dtype=real)  # without a torque [pN um/rad]
        stiffening: wp.array(dtype=real)  # 1/T_s: how much it grows by the motor's torque [1/(pN um)]
        helix_axis: wp.array(dtype=vec3)  # unit vector, of the flagellum at rest, in the axes of segment 1

    @wp.struct
    class Drag:
        """Local mobility."""

        mobility_along: wp.array(dtype=real)  # [E], of a node along the tangent [um/(s pN)]
        mobility_across: wp.array(dtype=real)  # [E], of a node across the tangent [um/(s pN)]
        spin_mobility: wp.array(dtype=real)  # [K], of a segment about its tangent [1/(pN um s)]

    @wp.struct
    class Pairs:
        """Rotne-Prager sum."""

        radius: wp.array(dtype=real)  # [K], a, of the nodes of a flagellum [um]
        mobility: wp.array(dtype=real)  # [C], 1/(8 pi eta) [um^2/(s pN)]

    @wp.struct
    class Steric:
        """Per cell [C]."""

        strength: wp.array(dtype=real)  # F_0 [pN]
        diameter: wp.array(dtype=real)  # sigma [um]

    @wp.struct
    class Body:
        """Per cell [C]: the capsule that contact sees, and the mobility of the spheroid or of its shell of beads."""

        half_length: wp.array(dtype=real)  # of the capsule's axis [um]
        radius: wp.array(dtype=real)  # of the capsule [um]
        mobility_along: wp.array(dtype=real)  # along its axis [um/(s pN)]
        mobility_across: wp.array(dtype=real)  # across its axis [um/(s pN)]
        spin_mobility: wp.array(dtype=real)  # about its axis [1/(pN um s)]
        tumble_mobility: wp.array(dtype=real)  # about an axis across it [1/(pN um s)]
        # [36 C], of a shell of beads, from force and torque to velocity and spin in body axes, row after row;
        # where it is set, the four above are empty.
        shell_mobility: wp.array(dtype=real)

    @wp.struct
    class External:
        """Forces from outside, in lab axes, per cell [C]."""

        force_per_length: wp.array(dtype=vec3)  # on every flagellum [pN/um]
        body_force: wp.array(dtype=vec3)  # at the body's centre [pN]

    @wp.struct
    class Model:
        cell_of: wp.array(dtype=wp.int32)  # [E], of an element
        flagellum_of: wp.array(dtype=wp.int32)  # [E], of an element
        first_node: wp.array(dtype=wp.int32)  # [K + 1], flagellum k has the elements from first_node[k] on
        first_flagellum: wp.array(dtype=wp.int32)  # [C + 1], cell c has the flagella from first_flagellum[c] on
        rod: Rod
        motor: Motor
        drag: Drag
        pairs: Pairs
        steric: Steric
        body: Body
        # Optional terms: each an array of one struct, empty without the term, since all launches have all arrays among
        # their arguments.
        motor_law: wp.array(dtype=MotorLaw)
        hook: wp.array(dtype=Hook)
        polymorphs: wp.array(dtype=Polymorphs)
        external: wp.array(dtype=External)

    @wp.struct
    class Pose:
        position: wp.array(dtype=vec3)  # [E], node relative to the body centre, lab axes [um]
        tangent: wp.array(dtype=vec3)  # [E], e3 of the segment; of the tripod: the motor axis
        director: wp.array(dtype=vec3)  # [E], e1 of the segment
        length: wp.array(dtype=real)  # [E], of the segment [um]
        body_position: wp.array(dtype=wp.vec3d)  # [C] [um]
        body_orientation: wp.array(dtype=wp.quatd)  # [C], body axes to lab axes
        body_axis: wp.array(dtype=vec3)  # [C], e_b3, points to the rear

    @wp.struct
    class MotorState:
        """Per flagellum [K]; only where the torque is not constant."""

        torque: wp.array(dtype=real)  # at the moment evaluated [pN um]
        within_step: wp.array(dtype=real)  # in an implicit step [pN um]
        slope: wp.array(dtype=real)  # of the piece of its curve on which it was found last [pN um s]
        on_hook: wp.array(dtype=real)  # at the end of the last step; only with a hook that stiffens by it [pN um]

    @wp.struct
    class Forms:
        """Forms of the joints [E]; only with polymorphs."""

        form: wp.array(dtype=wp.int32)  # 0, 1 or 2
        before: wp.array(dtype=wp.int32)  # form before it flipped last
        changed: wp.array(dtype=wp.float64)  # from when on it has its present form [s]
        flipped: wp.array(dtype=wp.float64)  # end of the step that was found in, no earlier [s]
        looked: wp.array(dtype=wp.float64)  # when it was looked at last [s]
        # What moments were beyond their thresholds then, those that nucleate and those that propagate; 0 where that is
        # not known [pN um].
        beyond: wp.array(dtype=wp.vec2d)
        reached: wp.array(dtype=wp.vec2d)  # the same at the look that is being taken
        rest_strain: wp.array(dtype=vec3)  # the array of `Rod`, which changes with time here [rad]

    @wp.struct
    class State:
        pose: Pose
        time: wp.array(dtype=wp.float64)  # [C], of the evaluation [s]; only where something depends on it
        motor: wp.array(dtype=MotorState)  # one, or none, as in `Model`
        forms: wp.array(dtype=Forms)
        active: wp.array(dtype=wp.int32)  # [C], 1: the cell takes part in this pass
        # Joint i couples segments i and i + 1: energy gradients with respect to the two segment vectors and spins.
        joint_before: wp.array(dtype=vec3)  # [E] [pN]; of the hook with respect to the unit vector m [pN um]
        joint_after: wp.array(dtype=vec3)  # [E] [pN]
        joint_spin_before: wp.array(dtype=real)  # [E] [pN um]
        joint_spin_after: wp.array(dtype=real)  # [E] [pN um]
        stretch_change: wp.array(dtype=vec3)  # [E], first variation of the segment's stretching gradient [pN]
        # Steric forces of a segment, on its first and on its second node; contact of a node with the body.
        steric_first: wp.array(dtype=vec3)  # [E] [pN]
        steric_second: wp.array(dtype=vec3)  # [E] [pN]
        body_contact: wp.array(dtype=vec3)  # [E] [pN]
        # Totals.
        force: wp.array(dtype=vec3)  # [E]; on r_0: force of the flagellum on the body at the anchor [pN]
        spin_torque: wp.array(dtype=real)  # [E], about the tangent [pN um]
        velocity: wp.array(dtype=vec3)  # [E], of the node, lab [um/s]
        flagellum_force: wp.array(dtype=vec3)  # [K], of a flagellum on the body [pN]
        flagellum_torque: wp.array(dtype=vec3)  # [K], about the body centre [pN um]
        surface_force: wp.array(dtype=vec3)  # [C], of the flow on the body when it is held [pN]; only with body flow
        surface_torque: wp.array(dtype=vec3)  # [C], about its centre [pN um]
        body_velocity: wp.array(dtype=vec3)  # [C], of the body's centre, lab [um/s]
        body_spin: wp.array(dtype=vec3)  # [C], angular velocity, lab [rad/s]

    return SimpleNamespace(Model=Model, Pose=Pose, State=State)


@dataclass(frozen=True)
class DeviceModel:
    """Model of a batch on a device.

    Attributes:
        plan: how its kernels are executed.
        switches: the terms that the scenes ask for.
        terms: force terms in their order, instances of `Term`.
        cell_count, flagellum_count, element_count: sizes C, K, E.
        data: the struct `Model`.
        optional: structs of the optional terms, by their names in `Model`, as in `optional`.
        groups: the struct `Groups`: flagella side by side in vector lanes.
        shells: beads of the bodies on the host, `warpflag_kernels.fluid.shell.Shells`; None without body flow.
    """

    plan: Plan
    switches: Switches
    terms: tuple[Any, ...]
    cell_count: int
    flagellum_count: int
    element_count: int
    data: Any
    optional: SimpleNamespace
    groups: Any
    shells: Any = None

    @property
    def precision(self) -> Precision:
        return self.plan.precision

    @property
    def device(self) -> Any:
        return self.plan.device

    @property
    def touching(self) -> bool:
        """Whether anything can be in contact."""
        return any(term.contact for term in self.terms)

    @property
    def timed(self) -> bool:
        """Whether any force depends on time itself."""
        return any(term.timed for term in self.terms)


@dataclass(frozen=True)
class DeviceState:
    """State of a batch on a device.

    Attributes:
        data: the struct `State`.
        optional: structs of the optional terms, by their names in `State`, as in `optional`.
        pairs: the struct `PairSum` of the Rotne-Prager sum.
        shell: the struct `Shell` of the flow round the body.
        neighbours: the struct `Neighbours` of the steric force.
    """

    data: Any
    optional: SimpleNamespace
    pairs: Any
    shell: Any
    neighbours: Any


def allocate_pose(p: Precision, cell_count: int, element_count: int, device: Any, pose: Any) -> None:
    """Arrays of the struct `Pose`, in place; segments have unit length, the rest is zero."""
    for name in ("position", "tangent", "director"):
        setattr(pose, name, wp.zeros(element_count, dtype=p.vec3, device=device))
    pose.length = wp.ones(element_count, dtype=p.real, device=device)
    pose.body_position = wp.zeros(cell_count, dtype=wp.vec3d, device=device)
    pose.body_orientation = wp.zeros(cell_count, dtype=wp.quatd, device=device)
    pose.body_axis = wp.zeros(cell_count, dtype=p.vec3, device=device)


def optional(whole: Any) -> SimpleNamespace:
    """Structs of the optional terms, by their names in the struct `Model` or `State`; none of their arrays is set.

    Kernels read each through an array of one struct, whose contents the host cannot read; so the host keeps the
    structs, too.
    """
    kinds = {name: var.type.dtype for name, var in whole.vars.items() if isinstance(var.type, wp.array)}
    return SimpleNamespace(**{name: kind() for name, kind in kinds.items() if hasattr(kind, "vars")})


def attach(parts: SimpleNamespace, data: Any, device: Any) -> None:
    """Puts those structs of `optional` that have arrays into `data`, each in an array of one, where kernels find it."""
    for name, part in vars(parts).items():
        if any(getattr(part, field) is not None for field in part._cls.vars):
            setattr(data, name, wp.array([part], dtype=part._cls, device=device))


def allocate_state(model: DeviceModel) -> tuple[Any, SimpleNamespace]:
    """The struct `State`, its arrays zero, and its optional structs; a term that is off gets no arrays."""
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    s = structs(p).State()
    allocate_pose(p, cells, elements, device, s.pose)
    s.active = zeros(cells, wp.int32)
    s.joint_before, s.joint_after = zeros(elements, p.vec3), zeros(elements, p.vec3)
    s.joint_spin_before, s.joint_spin_after = zeros(elements, p.real), zeros(elements, p.real)
    if model.switches.steric:
        s.steric_first, s.steric_second = zeros(elements, p.vec3), zeros(elements, p.vec3)
    if model.switches.has("body contact"):
        s.body_contact = zeros(elements, p.vec3)
    s.force, s.velocity, s.spin_torque = zeros(elements, p.vec3), zeros(elements, p.vec3), zeros(elements, p.real)
    s.flagellum_force, s.flagellum_torque = zeros(flagella, p.vec3), zeros(flagella, p.vec3)
    if model.switches.flows.body:
        s.surface_force, s.surface_torque = zeros(cells, p.vec3), zeros(cells, p.vec3)
    s.body_velocity, s.body_spin = zeros(cells, p.vec3), zeros(cells, p.vec3)
    if model.timed:
        s.time = zeros(cells, wp.float64)
    parts = optional(structs(p).State)
    if model.switches.has("motor law"):
        for name in ("torque", "within_step", "slope"):
            setattr(parts.motor, name, zeros(flagella, p.real))
        if model.switches.has("hook that stiffens"):
            parts.motor.on_hook = wp.clone(model.data.motor.torque)
    if model.switches.has("polymorphs"):
        parts.forms.form, parts.forms.before = zeros(elements, wp.int32), zeros(elements, wp.int32)
        parts.forms.changed = wp.full(elements, NEVER, dtype=wp.float64, device=device)
        parts.forms.flipped = wp.full(elements, NEVER, dtype=wp.float64, device=device)
        parts.forms.looked = zeros(elements, wp.float64)
        parts.forms.beyond, parts.forms.reached = zeros(elements, wp.vec2d), zeros(elements, wp.vec2d)
        parts.forms.rest_strain = model.data.rod.rest_strain
    attach(parts, s, device)
    return s, parts
