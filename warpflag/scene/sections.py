"""The sections of a scene that say what is simulated: a frozen dataclass each, a declaration for every setting.

`warpflag.scene.run_sections` has those that say how it is run.

Units are um, pN and s throughout (so pN um for torques, pN s/um^2 for viscosity); angles are in degrees.
Defaults are those of Adhyapak & Stark, Phys. Rev. E 92, 052701 (2015), "the paper", wherever it prints a
value, but for hydrodynamics and hook, where they are those of a model that converges with the segment length; where it
prints none, the class says where the value comes from.

Body axes: e_b3 is the long axis and points to the rear, e_b1 is where azimuths are counted from.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from warpflag.scene.settings import Section, choice, integer, number, numbers, switch, vector
from warpflag.scene.smooth_helix import inscribed_strain, smooth_strain

FORMS = ("semicoiled", "curly_1", "coiled")
"""Forms of a filament that have names, beside that of its ground state."""

MOTOR_LAWS = ("constant", "torque_speed", "rate")


@dataclass(frozen=True)
class Flagella(Section, key="flagella"):
    """The group of flagella: how many, their shape, their elasticity and where they sit.

    The paper prints the elastic constants, the ground state and the opening angles 23, 44 and 90 deg.
    Length, segment length and anchor offset are not printed: the defaults reproduce the radius 0.22 um
    that it quotes for the discrete helix, and offsets from 0.6 to 0.85 um keep a finished bundle.
    """

    count: int = integer(2, 1, 10_000, "number of flagella, at azimuths 360 k/count deg")
    length: float = number(6.0, "um", 0.1, 100, "contour length of each")
    segment_length: float = number(
        0.2, "um", 0.01, 1, "wanted length of a segment; the nearest that divides the contour is taken"
    )
    opening_angle: float = number(
        90.0, "deg", 0, 180, "angle between two opposite flagella; each helix axis is tilted by half of it"
    )
    phase_difference: float | None = number(
        None,
        "",
        0,
        1,
        "initial contour average of the phase difference theta of flagella 0 and 1",
        derived="all flagella start at the same phase angle",
    )
    anchor_offset: float = number(
        0.6,
        "um",
        -50,
        50,
        "distance of the anchor from the body's middle toward the rear, length/2 at the pole",
        usual=(1e-3, 5.0),
    )
    bending_rigidity: float = number(3.5, "pN um^2", 1e-3, 1e5, "A, the paper's")
    twist_rigidity: float = number(3.5, "pN um^2", 1e-3, 1e5, "C, in the paper equal to A")
    stretching_stiffness: float = number(1000.0, "pN", 1, 1e7, "K, the paper's")
    intrinsic_curvature: tuple[float, float, float] = vector(
        (0.0, 1.3, -2.1),
        "1/um",
        -100,
        100,
        "strain Omega^0 of the ground state about e1, e2, e3, the paper's; third positive: right-handed",
    )
    helix_radius: float | None = number(
        None, "um", 1e-6, 100, "of the ground state, with helix_pitch", derived="as intrinsic_curvature says"
    )
    helix_pitch: float | None = number(
        None, "um", -1e3, 1e3, "of the ground state; negative: left-handed", derived="as intrinsic_curvature says"
    )
    nodes_on_helix: bool = switch(False, "nodes lie on the smooth helix of that strain; else each joint has the strain")
    filament_radius: float = number(
        0.010, "um", 1e-3, 0.5, "a, not printed but implied by the paper's gamma_R = 4 pi eta a^2"
    )
    on_axis: bool = switch(
        False, "r_0 lies on the axis of the helix, whose amplitude grows from there; else it is a point of the helix"
    )
    hook_twist_factor: float = number(
        3.0, "", 1e-3, 1e3, "twist rigidity of the hook joint over C, the paper's; it bends freely"
    )

    @property
    def ground_strain(self) -> tuple[float, float, float]:
        """Strain Omega^0 of the ground state [1/um]: intrinsic_curvature, or that of the helix of radius and pitch."""
        if self.helix_radius is None or self.helix_pitch is None:
            return self.intrinsic_curvature
        return smooth_strain(self.helix_radius, self.helix_pitch)

    def strain_at_rest(self, h: float, form: tuple[float, float, float] | None = None) -> tuple[float, float, float]:
        """Strain of the joints [1/um], segments of h [um]: of the ground state, or of a form of this strain."""
        strain = self.ground_strain if form is None else form
        return inscribed_strain(strain, h) if self.nodes_on_helix else strain


@dataclass(frozen=True)
class FlagellumOverride(Section, key="flagellum"):
    """Values of a single flagellum, a [[flagellum]] table; what is absent is taken from the group."""

    azimuth: float | None = number(None, "deg", -360, 360, "of the anchor about e_b3, from e_b1", derived="360 k/count")
    anchor_offset: float | None = number(
        None, "um", -50, 50, "as flagella.anchor_offset", usual=(1e-3, 5.0), derived="flagella.anchor_offset"
    )
    motor_axis_angle: float | None = number(
        None, "deg", 0, 180, "motor axis to e_b3, toward the outward normal", derived="motor.axis_angle"
    )
    tilt: float | None = number(
        None, "deg", 0, 180, "helix axis to e_b3, toward the normal", derived="flagella.opening_angle / 2"
    )
    torque: float | None = number(None, "pN um", -1e3, 1e3, "motor torque", usual=(1e-3, 1e3), derived="motor.torque")
    law: str | None = choice(None, MOTOR_LAWS, "as motor.law", derived="motor.law")
    knee: float | None = number(None, "Hz", 0, 1e5, "as motor.knee", derived="motor.knee")
    no_load: float | None = number(None, "Hz", 1e-3, 1e6, "as motor.no_load", derived="motor.no_load")
    rate: float | None = number(None, "Hz", -1e5, 1e5, "as motor.rate", derived="motor.rate")
    switch_times: tuple[float, ...] | None = numbers(
        None, "s", 0, 1e6, "as motor.switch_times", derived="motor.switch_times"
    )
    length: float | None = number(None, "um", 0.1, 100, "contour length", derived="flagella.length")
    segments: int | None = integer(
        None, 2, 10_000, "number of segments", derived="length / flagella.segment_length, rounded"
    )
    phase: float | None = number(
        None,
        "deg",
        -360,
        360,
        "angle of the anchor about the helix axis, which points away from the body, counted from the lab's "
        "x axis projected across it",
        derived="180; flagella of odd number shifted to reach flagella.phase_difference",
    )


@dataclass(frozen=True)
class Motor(Section, key="motor"):
    """The rotary motors and their hooks. The paper: T_m = 3.4 pN um, phi_m = 55 deg.

    Its text gives the body the motor torques and the forces at the anchors only (bearing_torque = false).

    Laws. constant: the torque, whatever the rate. torque_speed: the torque up to the knee, from there falling in
    proportion to zero at no_load; in reverse its own knee and end. rate: a prescribed rate relative to the body, and
    the torque that it takes. Rates are relative to the body. Knee and end: Chen & Berg, Biophys. J. 78, 1036 (2000),
    at 23 C; in reverse a straight line: Yuan, Fahrner, Turner & Berg, PNAS 107, 12846 (2010).

    Switching. schedule: a motor reverses at every one of its switch_times. markov: a two-state Markov process for each
    motor, all forward at first; with coupling, that share of the rates is of clocks which all motors of the cell
    share. Rates of switching: Mears et al., eLife 3, e01916 (2014), as used in models built on it.
    """

    torque: float = number(
        3.4, "pN um", -1e3, 1e3, "on each flagellum about the motor axis; negative: reversed", usual=(1e-3, 1e3)
    )
    axis_angle: float = number(55.0, "deg", 0, 180, "motor axis to e_b3, toward the outward normal")
    bearing_torque: bool = switch(
        True, "the body also takes the torque across the motor axis, so that the swimmer is torque-free"
    )
    law: str = choice("constant", MOTOR_LAWS, "what sets torque and rate")
    knee: float = number(175.0, "Hz", 0, 1e5, "rate up to which the torque is motor.torque; law torque_speed")
    no_load: float = number(300.0, "Hz", 1e-3, 1e6, "rate at which the torque is zero, above the knee")
    reverse_torque: float | None = number(
        None, "pN um", 0, 1e3, "magnitude of the torque in reverse", derived="that forward"
    )
    reverse_knee: float = number(0.0, "Hz", 0, 1e5, "knee in reverse; 0: a straight line from the start")
    reverse_no_load: float | None = number(
        None, "Hz", 1e-3, 1e6, "rate in reverse at which the torque is zero", derived="motor.no_load"
    )
    rate: float = number(100.0, "Hz", -1e5, 1e5, "prescribed rate relative to the body; law rate")
    averaging_time: float = number(
        1e-3, "s", 1e-5, 10, "over which a motor averages the rate that its curve goes by, where there is thermal noise"
    )
    switching: str = choice("none", ("none", "schedule", "markov"), "whether motors reverse during the run")
    switch_times: tuple[float, ...] = numbers((), "s", 0, 1e6, "when every motor reverses; with schedule")
    switch_ramp: float = number(1e-3, "s", 1e-6, 1, "time in which a motor goes from one sense to the other")
    to_reverse: float = number(0.26, "1/s", 0, 1e5, "rate of switching to reverse; with markov")
    to_forward: float = number(1.7, "1/s", 0, 1e5, "rate of switching back; with markov")
    coupling: float = number(0.0, "", 0, 1, "share of the switching rates that all motors of a cell have in common")
    seed: int = integer(0, 0, 2**31 - 1, "of the random switching")


@dataclass(frozen=True)
class Hook(Section, key="hook"):
    """The hook between motor and filament: a stub along the motor axis m that turns with the body, and a joint.

    The flagellum begins at its end. The paper has neither length nor stiffness: its hook is a universal joint on the
    body's surface. Measured: 0.055 to 0.06 um long. Its bending energy is (stiffness/2) |2 tan(beta/2)|^2, beta between
    m and the axis of the helix at rest, which is fixed in the first segment.
    """

    length: float = number(0.055, "um", 0, 1, "of the stub; the flagellum begins at its end", usual=(1e-3, 1.0))
    stiffness: float = number(
        0.65, "pN um/rad", 0, 1e4, "of bending; EI over the length: 0.65 relaxed, 4 loaded, 0 as in the paper"
    )
    stiffening_torque: float | None = number(
        None,
        "pN um",
        1e-4,
        1e4,
        "T_s: the stiffness grows by 1 + |motor torque|/T_s",
        derived="the stiffness does not depend on the torque",
    )


@dataclass(frozen=True)
class Polymorphs(Section, key="polymorphs"):
    """Forms that the filament changes to under its own moment, joint by joint: those of a bacterial flagellum.

    Rate of going on to the second form: that to curly-1 in models built on Mears et al., eLife 3, e01916 (2014).
    Moments are about the helix axis, against the handedness of the ground state, as a reversed motor winds it up.
    Thresholds of nucleation: Hotani, J. Mol. Biol. 156, 791 (1982). Those of propagation, on both sides of the middle
    of these two, are a choice. Strains of the target: from pitch and radius, semicoiled and curly-1 with half the
    pitch of the normal form (Darnton & Berg, Biophys. J. 92, 2230 (2007)).
    """

    enabled: bool = switch(False, "joints flip between the ground state and the target")
    target: str = choice("semicoiled", FORMS, "form that reversed motors lead to")
    second: str = choice("none", ("none", *FORMS), "form that joints in the target form go on to, from the root")
    second_rate: float = number(
        0.68, "1/s", 0, 1e6, "rate at which a filament begins to, while its motor winds it up; drawn with motor.seed"
    )
    semicoiled: tuple[float, float, float] = vector((0.0, 2.84, 2.29), "1/um", -100, 100, "strain of that form")
    curly_1: tuple[float, float, float] = vector((0.0, 2.61, 4.19), "1/um", -100, 100, "strain of that form")
    coiled: tuple[float, float, float] = vector((0.0, 1.82, -0.6), "1/um", -100, 100, "strain of that form")
    nucleation: float = number(1.1, "pN um", 0, 1e3, "moment at which root or tip flips to the target")
    nucleation_back: float = number(0.4, "pN um", -1e3, 1e3, "moment the other way at which it flips back")
    propagation: float = number(0.4, "pN um", -1e3, 1e3, "moment at which a joint beside the target flips to it")
    propagation_back: float = number(0.3, "pN um", -1e3, 1e3, "moment below which one beside the other form flips back")
    front_speed: float = number(200.0, "um/s", 1, 1e5, "at which a change of form travels along the filament, at most")
    ramp: float | None = number(None, "s", 1e-6, 1, "in which a joint's ground state changes", derived="h/front_speed")


@dataclass(frozen=True)
class Fluid(Section, key="fluid"):
    """The fluid and the drag of a filament in it, per unit length.

    The paper prints the drags for water: 1.6e-3 and 2.8e-3 pN s/um^2, 1.26e-6 pN s. It prints no
    viscosity; these drags invert to 1e-3 pN s/um^2.
    """

    viscosity: float = number(1e-3, "pN s/um^2", 1e-5, 10, "eta; water: 1e-3, the same number as in Pa s")
    drag_parallel: float | None = number(None, "pN s/um^2", 1e-6, 100, "gamma_par", derived="1.6e-3 viscosity / 1e-3")
    drag_perpendicular: float | None = number(
        None, "pN s/um^2", 1e-6, 100, "gamma_perp", derived="2.8e-3 viscosity / 1e-3"
    )
    drag_rotation: float | None = number(
        None, "pN s", 1e-10, 1, "gamma_R, spin about the tangent", derived="1.26e-6 viscosity / 1e-3"
    )
    temperature: float = number(0.0, "K", 0, 1e4, "of thermal noise; 0: none")
    seed: int = integer(0, 0, 2**63 - 1, "of the random numbers of thermal noise")
    noise_tolerance: float | None = number(
        None,
        "",
        1e-6,
        0.1,
        "relative error of the random flows of the pair sum",
        derived="what five products with it leave, 5e-5 to 6e-3",
    )


@dataclass(frozen=True)
class Hydrodynamics(Section, key="hydrodynamics"):
    """Which nodes move in the flow of which other nodes.

    none: local drag only. within: nodes of the same flagellum. between: nodes of different flagella.
    all: both, the paper's sum, with a radius that keeps it positive definite. as_printed: the paper's sum
    with the filament radius, which is not positive definite at contact. consistent: a pair sum that does
    not count a filament's own flow twice and converges with the segment length.
    """

    mode: str = choice(
        "consistent", ("none", "within", "between", "all", "as_printed", "consistent"), "pairs that are summed"
    )
    pair_radius: float | None = number(
        None,
        "um",
        1e-3,
        1,
        "radius of the Rotne-Prager pair term",
        derived="filament_radius with as_printed, else the least that keeps the mobility positive definite; "
        "that is max(filament_radius, drag_perpendicular h / (6 pi viscosity)) unless consistent, h that of the "
        "segment, the longest one unless consistent",
    )
    body_flow: bool | None = switch(
        None,
        "the body's surface obstructs the flow of the flagella and carries fluid along; with all and consistent",
        derived="true where it can be: with all and consistent, and a body",
    )
    body_beads: int = integer(
        60, 20, 2000, "beads of the body's surface with body_flow; the more, the better the flow beside the body"
    )


@dataclass(frozen=True)
class Steric(Section, key="steric"):
    """Contact of flagella with each other (and of their nodes with the body, see Body.contact).

    Force F_0 [2 (sigma/r)^13 - (sigma/r)^7] below 2^(1/6) sigma. The paper: F_0 = 0.8 pN, sigma = 4a.
    """

    enabled: bool = switch(True, "flagella repel each other")
    strength: float = number(0.8, "pN", 1e-6, 1e5, "F_0, the force at distance sigma")
    diameter: float | None = number(None, "um", 1e-3, 1, "sigma", derived="4 flagella.filament_radius")
    self_contact: bool = switch(False, "with enabled, a flagellum repels itself: segments 3 sigma of contour apart")


@dataclass(frozen=True)
class Body(Section, key="body"):
    """The cell body: a spherocylinder in contact, a prolate spheroid in the fluid. Sizes are the paper's.

    Switching its motions off one by one gives the paper's ablations; anchored switches all of them off.
    """

    length: float = number(2.5, "um", 0.1, 100, "L_b, caps included")
    width: float = number(0.8, "um", 0.05, 50, "d_b, not above the length")
    enabled: bool = switch(True, "false: a free filament without body, motor and hook, whose r_0 is a free end")
    contact: bool = switch(True, "the body's surface repels the nodes of flagella")
    translation: bool = switch(True, "the body moves")
    axial_rotation: bool = switch(True, "the body turns about its long axis")
    anchored: bool = switch(False, "the body neither moves nor turns, whatever the two switches above say")


@dataclass(frozen=True)
class External(Section, key="external"):
    """External forces in lab axes: sedimentation, the pull of a laser trap."""

    force_per_length: tuple[float, float, float] = vector(
        (0.0, 0.0, 0.0), "pN/um", -1e3, 1e3, "uniform force per contour length on every flagellum"
    )
    body_force: tuple[float, float, float] = vector(
        (0.0, 0.0, 0.0), "pN", -1e4, 1e4, "force on the body, at its centre"
    )


@dataclass(frozen=True, kw_only=True)
class Sections:
    """The sections above as attributes of a scene, in the order of a scene file; a new one is added here alone."""

    flagella: Flagella = field(default_factory=Flagella)
    motor: Motor = field(default_factory=Motor)
    hook: Hook = field(default_factory=Hook)
    polymorphs: Polymorphs = field(default_factory=Polymorphs)
    fluid: Fluid = field(default_factory=Fluid)
    hydrodynamics: Hydrodynamics = field(default_factory=Hydrodynamics)
    steric: Steric = field(default_factory=Steric)
    body: Body = field(default_factory=Body)
    external: External = field(default_factory=External)
