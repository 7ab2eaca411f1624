"""Rotations against Rodrigues' formula and the product of quaternions."""

from __future__ import annotations

import numpy as np
import pytest

from tests import helpers
from warpflag.base import rotations

VECTORS = [[0.3, -1.0, 2.0], [0.0, 0.0, 3.1], [1e-9, 0.0, 0.0], [0.0, 0.0, 0.0], [-2.0, 1.5, 0.1]]


@pytest.mark.parametrize("vector", VECTORS)
@pytest.mark.parametrize("scale", [1.0, -3.0, 1e-3])
def test_matrix_is_rodrigues_formula_for_quaternions_of_any_length(vector, scale):
    quaternion = scale * helpers.quaternion(vector)
    found = rotations.matrix(quaternion)
    np.testing.assert_allclose(found, helpers.rotation(vector), atol=1e-14)
    np.testing.assert_allclose(rotations.axis_of_body(quaternion), helpers.rotation(vector)[:, 2], atol=1e-14)


def test_arrays_of_quaternions_are_taken_one_by_one():
    quaternions = np.array([helpers.quaternion(v) for v in VECTORS[:4]]).reshape(2, 2, 4)
    found = rotations.matrix(quaternions)
    assert found.shape == (2, 2, 3, 3)
    np.testing.assert_allclose(found[1, 0], helpers.rotation(VECTORS[2]), atol=1e-15)
    vectors = np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]])
    turned = rotations.rotated(quaternions, vectors)
    assert turned.shape == (2, 2, 2, 3)
    np.testing.assert_allclose(turned[0, 1, 1], helpers.rotation(VECTORS[1]) @ vectors[1], atol=1e-14)


@pytest.mark.parametrize("vector", VECTORS)
def test_vectors_are_found_again(vector):
    quaternion = helpers.quaternion(vector)
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(rotations.vector_of_quaternion(sign * quaternion), vector, atol=1e-14)
    np.testing.assert_allclose(rotations.vector_of_matrix(helpers.rotation(vector)), vector, atol=1e-7)
    small = np.asarray(vector) * 0.4
    np.testing.assert_allclose(rotations.vector_of_matrix(helpers.rotation(small)), small, atol=1e-14)


def test_more_than_half_a_turn_is_taken_the_other_way_round():
    found = rotations.vector_of_quaternion(helpers.quaternion([0.0, 0.0, 1.5 * np.pi]))
    np.testing.assert_allclose(found, [0.0, 0.0, -0.5 * np.pi], atol=1e-14)


def test_product_turns_by_the_second_and_then_by_the_first():
    first, second = helpers.quaternion(VECTORS[0]), helpers.quaternion(VECTORS[4])
    found = rotations.product(2.0 * first, second)
    assert np.linalg.norm(found) == pytest.approx(2.0)
    expected = helpers.rotation(VECTORS[0]) @ helpers.rotation(VECTORS[4])
    np.testing.assert_allclose(rotations.matrix(found), expected, atol=1e-14)


def test_relative_rotation_is_in_the_axes_of_the_first():
    first, turn = helpers.quaternion(VECTORS[0]), helpers.quaternion(VECTORS[4])
    second = 2.0 * helpers.product(first, turn)
    np.testing.assert_allclose(rotations.relative(3.0 * first, second), turn, atol=1e-14)
