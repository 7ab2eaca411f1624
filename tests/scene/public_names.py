"""Every public name in a user's script. pyright checks it, a test sees that no name is left out; it is not run."""

from __future__ import annotations

from pathlib import Path

import warpflag
from warpflag import (
    Body,
    External,
    Flagella,
    FlagellumOverride,
    Fluid,
    Hook,
    Hydrodynamics,
    Motor,
    NumericalError,
    Numerics,
    Polymorphs,
    Record,
    Recorder,
    Scene,
    SceneError,
    Simulation,
    Start,
    Steric,
    load,
    paper_scene,
    with_values,
)


def scene(path: Path | None = None) -> Scene:
    """A scene of a file, or one with a section of every kind."""
    if path is not None:
        return with_values(load(path), {"motor.torque": 2.0, "flagellum.0.torque": 1.5})
    return Scene(
        name=f"made with {warpflag.__version__}",
        duration=1e-3,
        frames=10,
        flagella=Flagella(count=2, length=6.0),
        flagellum=(FlagellumOverride(torque=2.0), FlagellumOverride(tilt=30.0)),
        motor=Motor(torque=3.4),
        hook=Hook(length=0.055),
        fluid=Fluid(viscosity=1e-3),
        hydrodynamics=Hydrodynamics(mode="all"),
        steric=Steric(self_contact=True),
        body=Body(length=2.5),
        external=External(body_force=(0.0, 0.0, 1.0)),
        numerics=Numerics(accuracy=1e-2),
        polymorphs=Polymorphs(),
        start=Start(),
    )


PAPER = paper_scene("paper")


def run(made: Scene, directory: Path) -> float:
    """The last phase difference of a run; NaN where it can't be simulated."""
    try:
        simulation = Simulation(made, device="cpu", reporters=[Recorder(directory / "run.h5")])
        simulation.run(5e-4, progress=True)
        simulation.run()
    except (SceneError, NumericalError) as error:
        print(error)
        return float("nan")
    print(simulation.state.positions.shape, simulation.evaluate().body_velocity)
    with Record(directory) as record:
        found = record.wobble()
        print(record.motor_loads(), record.bundle_membership(), found.angle, record.frame(-1).time)
        print(record.wrapping().wrapped)
        return float(record.observables["phase_difference"][-1])
