"""The analytic zipper against closed solutions, brute force, and a record made to zip at a known speed."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.shapes import Zipping
from warpflag.model import zipper
from warpflag.model.zipper import PAPER, Zipper
from warpflag.record import RECORD_NAME, Record
from warpflag.record.recorder import Recorder

PLAIN = Zipper(
    opening_angle=60.0, axial_length=5.0, phase_velocity=300.0, body_speed=150.0, body_rate=80.0, radius=0.2, start=1.0
)


def test_without_wrapping_the_front_moves_at_the_phase_velocity():
    times = np.linspace(0.0, 0.02, 50)
    expected = np.minimum((1.0 + 300.0 * times) / 5.0, 1.0)
    for model in (replace(PLAIN, radius=0.0), replace(PLAIN, body_rate=0.0)):
        assert zipper.bundle_length(model, times) == pytest.approx(expected, abs=1e-4)


def test_without_swimming_the_angle_stays():
    times = np.linspace(0.0, 0.006, 20)
    speed = 300.0 + 2 * math.pi * 80.0 * 0.2 / math.sin(math.radians(30))
    expected = (1.0 + speed * times) / 5.0
    assert zipper.bundle_length(replace(PLAIN, body_speed=0.0), times) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("angle", [23.0, 90.0, 180.0])
def test_agrees_with_small_steps_of_the_equations(angle):
    model = replace(PLAIN, opening_angle=angle)
    length, psi, dt, count = model.start, math.pi / 2 - math.radians(angle) / 2, 5e-8, 0
    while length < 0.99 * model.axial_length:
        speed = model.phase_velocity + 2 * math.pi * model.body_rate * model.radius / math.cos(psi)
        psi += dt * model.body_speed * math.cos(psi) / (model.axial_length - length)
        length += dt * speed
        count += 1
    assert zipper.bundle_length(model, np.array([dt * count]))[0] == pytest.approx(0.99, abs=1e-4)


def test_the_closed_zip_stays_closed_although_cos_psi_vanishes():
    for radius in (0.0, 0.5):
        lengths = zipper.bundle_length(replace(PLAIN, body_speed=1e5, radius=radius), np.array([0.0, 0.014, 1.0]))
        assert lengths[0] == pytest.approx(0.2)
        assert lengths[1:] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("radius", "start"), [(0.3, 1.2), (1.7, 0.1), (0.0, 2.0)])
def test_fit_finds_radius_and_start(radius, start):
    times = np.linspace(0.0, 0.012, 60)
    wanted = replace(PAPER, radius=radius, start=start, opening_angle=44.0)
    found = zipper.fit(replace(PAPER, opening_angle=44.0), times, zipper.bundle_length(wanted, times))
    assert found.zipper.radius == pytest.approx(radius, abs=1e-4)
    assert found.zipper.start == pytest.approx(start, abs=1e-4)
    assert found.residual < 1e-5


def test_fit_of_the_velocity_and_its_residual():
    times = np.linspace(0.0, 0.01, 80)
    ripple = 0.02 * math.sqrt(2) * np.sin(2 * np.pi * 10 * times / times[-1])
    wanted = replace(PLAIN, radius=0.0, phase_velocity=350.0)
    found = zipper.fit(
        replace(PLAIN, radius=0.0), times, zipper.bundle_length(wanted, times) + ripple, "phase_velocity"
    )
    assert found.zipper.phase_velocity == pytest.approx(350.0, rel=0.05)
    assert found.residual == pytest.approx(0.02, rel=0.05)


def test_too_fast_a_wave_leaves_the_radius_at_zero():
    times = np.linspace(0.0, 0.01, 40)
    slow = zipper.bundle_length(replace(PLAIN, radius=0.0, phase_velocity=200.0), times)
    found = zipper.fit(PLAIN, times, slow)
    assert found.zipper.radius == 0.0
    assert found.residual > 0.05


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"opening_angle": 0.0}, "opening angle"),
        ({"start": 5.0}, "beyond the tips"),
        ({"phase_velocity": 0.0, "radius": 0.0}, "forward"),
        ({"body_rate": -80.0}, "forward"),
    ],
)
def test_what_does_not_zip_is_refused(change, problem):
    with pytest.raises(ValueError, match=problem):
        zipper.bundle_length(replace(PLAIN, **change), np.array([0.0]))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return Zipping(tmp_path_factory.mktemp("zipping"))


def test_parameters_are_measured_from_a_record(tmp_path):
    made = Zipping(tmp_path, split=0.5)
    with Record(made.directory) as record:
        found = zipper.measured(record, 1e-3, 5e-3)
    assert found.opening_angle == pytest.approx(90.0)
    assert found.axial_length == pytest.approx(30 * 0.16864, rel=1e-4)
    assert found.body_speed == pytest.approx(made.body_speed)
    assert found.body_rate == pytest.approx(-made.body_rate)
    # The bend at the front, which moves along one of the two, costs 2.9 %.
    assert found.phase_velocity == pytest.approx(-made.pitch * made.helix_rate, rel=0.05)


def test_the_opening_angle_is_that_between_the_helix_axes(tmp_path):
    """Of tilts of 60 and 30 degrees at azimuths of 100 and 40: cos Phi = cos 60 cos 30 + sin 60 sin 30 cos 60."""
    values = {"flagellum.0.azimuth": 100.0, "flagellum.0.tilt": 60.0, "flagellum.1.azimuth": 40.0}
    made = Zipping(tmp_path, split=0.5, values={**values, "flagellum.1.tilt": 30.0})
    with Record(made.directory) as record:
        found = zipper.measured(record, 1e-3, 2e-3)
    assert found.opening_angle == pytest.approx(math.degrees(math.acos(math.sqrt(3) / 4 + math.sqrt(3) / 8)))


def test_zipping_is_found_in_a_record_and_fitted(made):
    with Record(made.directory) as record:
        times, lengths = zipper.zipping(record)
        model = zipper.measured(record, times[0], times[-1])
    assert times[0] == pytest.approx(made.onset)
    assert times[-1] == pytest.approx(made.onset + (1 - made.start) / made.front_speed, abs=5e-4)
    assert lengths == pytest.approx(made.front(times), abs=0.04)
    found = zipper.fit(model, times - times[0], lengths, "phase_velocity")
    assert found.zipper.phase_velocity == pytest.approx(made.front_speed * model.axial_length, rel=0.05)
    assert found.residual < 0.03


def test_a_record_that_never_zips_is_refused(made, tmp_path):
    path = Path(shutil.copy(made.directory / RECORD_NAME, tmp_path))
    with Record(path) as record:
        last, given = int(record.steps[29]), record.parameters  # before the front reaches the tips
    sizes = {name: given[name] for name in ("filament_radius", "body_length", "body_width")}
    cut = Recorder(path, resume_step=last)
    cut.start(given["scene"], given["first_node"], **sizes)
    cut.close()
    with Record(path) as record, pytest.raises(ValueError, match="never complete"):
        zipper.zipping(record)
