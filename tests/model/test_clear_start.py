"""Starts that are clear of the body and of other flagella, whatever the scene; and given starts that are not."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import cell, displaced
from tests.oracles import body_gaps, contact_distances
from warpflag.model.clear_start import pairs_within
from warpflag.model.geometry import initial_state
from warpflag.model.start import starting_state
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, paper_scene, with_values

SCENES = 40


def random_scene(index: int, phases: bool) -> Scene:
    """1 to 8 flagella, tilts from 0 to 90 deg; half of them with anchors on the caps, too."""
    random = np.random.default_rng([7, index])
    count = int(random.integers(1, 9))
    values = {"flagella.count": count, "flagella.length": float(random.uniform(3.0, 9.0))}
    values["hook.length"] = [0.0, 0.055][index % 2]
    for k in range(count):
        offset = random.uniform(-1.0, 1.0) * (1.25 if index % 4 > 1 else 0.85)
        values |= {
            f"flagellum.{k}.azimuth": float(random.uniform(0, 360)),
            f"flagellum.{k}.anchor_offset": float(offset),
        }
        values |= {f"flagellum.{k}.tilt": float(random.uniform(0, 90))}
        values |= {f"flagellum.{k}.phase": float(random.uniform(0, 360))} if phases else {}
    return with_values(paper_scene("random"), {**values, "steric.enabled": True})


@pytest.mark.parametrize("phases", [False, True], ids=["free phases", "given phases"])
def test_nearly_every_random_scene_starts_clear(phases):
    refused, changed = [], 0
    for index in range(SCENES):
        scene = random_scene(index, phases)
        try:
            start = starting_state(scene)
        except SceneError as error:
            refused.append(str(error))
            continue
        changed += bool(start.notes)
        nodes = np.concatenate([x[1:] for x in start.positions])
        assert body_gaps(scene, start, nodes).min() >= -1e-12
        assert contact_distances(start).min(initial=1.0) >= 0.7 * 0.04 - 1e-12
        for spec, x, own in zip(
            scene.resolved_flagella(), start.positions, initial_state(scene).positions, strict=True
        ):
            assert x[0] == pytest.approx(own[0], abs=1e-12)
            assert np.linalg.norm(np.diff(x, axis=0), axis=1) == pytest.approx(spec.segment_length, rel=1e-9)
    assert len(refused) <= 0.05 * SCENES, refused
    assert changed > 0.2 * SCENES


@pytest.mark.parametrize("phase", [None, 180.0], ids=["other phase", "turned"])
def test_clear_starts_run(phase, device):
    """No guard is violated, and nothing has energy but contacts and hooks."""
    values = {"flagella.count": 3, "flagella.opening_angle": 60.0, "numerics.stepper": "implicit"}
    scene = cell({**values, **{f"flagellum.{k}.phase": phase for k in range(3)}})
    sim = Simulation(scene, device=device)
    assert sim.notes[0]
    sim.evaluate()
    assert sim.cell_state().elastic_energy.sum() < 1e-12
    sim.advance(5e-5)


PRESSED = {"flagella.count": 3, "flagella.length": 1.2, "flagella.segment_length": 0.06, "numerics.stepper": "implicit"}
"""Of the third flagellum node 1 is 0.37 sigma outside the body, which presses on it with more than 1000 pN."""


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({}, "with the phase of flagellum 2 at 250 deg"),
        ({f"flagellum.{k}.phase": 180.0 + 131.4 * (k == 1) for k in range(3)}, "turning about its anchor flagellum"),
    ],
    ids=["other phase", "turned"],
)
def test_no_flagellum_starts_pressed_onto_the_body(values, said, device):
    """The guard of strains does not stop the first steps."""
    scene = cell({**PRESSED, **values})
    sim = Simulation(scene, device=device)
    assert said in " ".join(sim.notes[0])
    start = starting_state(scene)
    nodes = np.concatenate([x[1:] for x in start.positions])
    assert body_gaps(scene, start, nodes).min() > 0.6 * 0.04
    sim.advance(1e-7)


def test_what_starts_pressed_for_want_of_another_place_is_told():
    """A contact that is wider than the segments are long: node 1 can't leave it."""
    values = {**PRESSED, "flagella.count": 1, "steric.diameter": 0.15, "steric.strength": 10.0}
    (*_, note) = starting_state(cell(values)).notes
    assert note.startswith("starts with node 1 of flagellum 0 pressed by the body with ")


def test_a_clear_scene_keeps_its_own_shape():
    scene = cell()
    start, own = starting_state(scene), initial_state(scene)
    assert start.notes == ()
    for a, b in zip((*start.positions, *start.directors), (*own.positions, *own.directors), strict=True):
        assert (a == b).all()


def test_a_given_phase_stays_and_the_flagellum_is_turned(capsys):
    values = {"flagella.count": 3, "flagella.opening_angle": 60.0, "flagellum.2.phase": 180.0}
    scene = cell({**values, "flagellum.0.phase": 0.0, "flagellum.1.phase": 0.0})
    (note,) = starting_state(scene).notes
    assert "turning about its anchor flagellum" in note
    free = with_values(scene, {f"flagellum.{k}.phase": None for k in range(3)})
    (note,) = starting_state(free).notes
    assert "phase of flagellum 2 at" in note


def test_what_cannot_start_clear_is_refused_with_a_tilt_that_would_do():
    scene = cell({"flagella.count": 1, "flagella.anchor_offset": -1.25, "flagella.opening_angle": 20.0})
    with pytest.raises(SceneError, match=r"flagellum 0 inside the body.*a tilt of (\d+)") as refused:
        starting_state(scene)
    would = float(str(refused.value).rpartition("a tilt of ")[2].split()[0])
    assert starting_state(with_values(scene, {"flagellum.0.tilt": would})).notes != ("",)
    with pytest.raises(SceneError):
        starting_state(with_values(scene, {"flagellum.0.tilt": would - 60.0}))


def test_a_given_start_inside_the_body_is_refused():
    scene = cell()
    start, inward = initial_state(scene), np.zeros((22, 3))
    inward[1, 0] = -0.5
    with pytest.raises(SceneError, match=r"flagellum 0 inside the body: node 1 is 0\.\d+ um deep"):
        Simulation(scene, device="cpu", starts=displaced(scene, start, inward))
    Simulation(with_values(scene, {"body.contact": False}), device="cpu", starts=displaced(scene, start, inward))


@pytest.mark.parametrize(("count", "others"), [(10, 20), (64, 128), (150, 333), (65, 30)])
def test_pairs_of_near_points_are_those_of_all_pairs(count, others):
    """Of points along two random walks, shorter and longer than what is looked at together."""
    random = np.random.default_rng(count)
    a, b = (np.cumsum(0.1 * random.standard_normal((n, 3)), axis=0) for n in (count, others))
    expected = np.nonzero(np.linalg.norm(a[:, None] - b, axis=2) < 0.5)
    assert len(expected[0]) > 5
    np.testing.assert_array_equal(pairs_within(a, b, 0.5), expected)
