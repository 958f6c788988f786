"""Quaternions and angles against values by hand, rotation matrices and their algebraic laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kslc_jax import maths

HALF = 0.70710678  # cos 45 degrees: quaternions of quarter turns
X, Y, Z = np.eye(3, dtype=np.float32)

# Compiled once, so that the many examples of hypothesis are cheap.
rotate = jax.jit(maths.quat_rotate)
rotate_inverse = jax.jit(maths.quat_rotate_inverse)
to_euler = jax.jit(maths.quat_to_euler)
wrap = jax.jit(maths.wrap_angle)

quick = settings(max_examples=40, deadline=None, derandomize=True, database=None)
angles = st.floats(-3.1, 3.1)
pitches = st.floats(-1.5, 1.5)
vectors = st.tuples(*[st.floats(-10, 10)] * 3)


def matrix(roll, pitch, yaw):
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll), written out."""
    cr, cp, cy = np.cos([roll, pitch, yaw])
    sr, sp, sy = np.sin([roll, pitch, yaw])
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def quaternion(roll, pitch, yaw):
    """Quaternion q_z q_y q_x by the Hamilton product of half-angle quaternions."""

    def product(a, b):
        w, u, s, v = a[0], a[1:], b[0], b[1:]
        return np.concatenate([[w * s - u @ v], w * v + s * u + np.cross(u, v)])

    def turn(axis, angle):
        return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])

    return jnp.asarray(
        product(turn(Z, yaw), product(turn(Y, pitch), turn(X, roll))), dtype=jnp.float32
    )


@pytest.mark.parametrize(
    ("quat", "vector", "expected"),
    [
        ([1, 0, 0, 0], [1, 2, 3], [1, 2, 3]),
        ([HALF, HALF, 0, 0], Y, Z),  # quarter turn about x: y -> z
        ([HALF, 0, HALF, 0], Z, X),  # about y: z -> x
        ([HALF, 0, 0, HALF], X, Y),  # about z: x -> y
        ([HALF, 0, 0, HALF], [1, 2, 3], [-2, 1, 3]),
        ([0, 0, 0, 1], [1, 2, 3], [-1, -2, 3]),  # half turn about z
        ([0.5, 0.5, 0.5, 0.5], [1, 2, 3], [3, 1, 2]),  # a third of a turn about (1, 1, 1)
    ],
)
def test_rotation_by_hand(quat, vector, expected):
    quat, vector = jnp.asarray(quat, jnp.float32), jnp.asarray(vector, jnp.float32)
    for f in (maths.quat_rotate, rotate):
        np.testing.assert_allclose(f(quat, vector), expected, atol=1e-6)
    np.testing.assert_allclose(
        rotate_inverse(quat, jnp.asarray(expected, jnp.float32)), vector, atol=1e-6
    )


def test_a_product_is_one_rotation_after_another():
    about_x, about_z = jnp.array([HALF, HALF, 0, 0]), jnp.array([HALF, 0, 0, HALF])
    both = maths.quat_multiply(about_z, about_x)  # x to y, y to z, z to x
    np.testing.assert_allclose(both, [0.5, 0.5, 0.5, 0.5], atol=1e-6)
    for before, after in ((X, Y), (Y, Z), (Z, X)):
        np.testing.assert_allclose(rotate(both, jnp.asarray(before)), after, atol=1e-6)


@quick
@given(angles, pitches, angles, vectors)
def test_rotation_is_the_matrix(roll, pitch, yaw, vector):
    quat, m, v = quaternion(roll, pitch, yaw), matrix(roll, pitch, yaw), jnp.asarray(vector)
    np.testing.assert_allclose(rotate(quat, v), m @ np.asarray(v), atol=2e-5)
    np.testing.assert_allclose(rotate_inverse(quat, v), m.T @ np.asarray(v), atol=2e-5)


@quick
@given(angles, pitches, angles, vectors)
def test_inverse_undoes_and_length_stays(roll, pitch, yaw, vector):
    quat, v = quaternion(roll, pitch, yaw), jnp.asarray(vector)
    np.testing.assert_allclose(rotate_inverse(quat, rotate(quat, v)), v, atol=2e-5)
    assert float(jnp.linalg.norm(rotate(quat, v))) == pytest.approx(np.linalg.norm(v), abs=2e-5)
    np.testing.assert_allclose(rotate(-quat, v), rotate(quat, v), atol=2e-5)


@pytest.mark.parametrize(
    ("quat", "euler"),
    [
        ([1, 0, 0, 0], [0, 0, 0]),
        ([HALF, HALF, 0, 0], [np.pi / 2, 0, 0]),
        ([HALF, 0, 0, HALF], [0, 0, np.pi / 2]),
        ([HALF, 0, 0, -HALF], [0, 0, -np.pi / 2]),
        # Half angles 0.05, 0.1, 0.15 about one axis each give angles twice as large.
        ([0.99875026, 0.04997917, 0, 0], [0.1, 0, 0]),
        ([0.99500417, 0, 0.09983342, 0], [0, 0.2, 0]),
        ([0.98877108, 0, 0, 0.14943813], [0, 0, 0.3]),
        # A quarter turn in yaw and a half angle of 0.1 in pitch: HALF * (cos, -sin, sin, cos).
        ([0.70357418, -0.07059289, 0.07059289, 0.70357418], [0, 0.2, np.pi / 2]),
    ],
)
def test_euler_by_hand(quat, euler):
    quat = jnp.asarray(quat, jnp.float32)
    np.testing.assert_allclose(maths.quat_to_euler(quat), euler, atol=1e-6)
    np.testing.assert_allclose(to_euler(-quat), euler, atol=1e-6)


def test_euler_looking_straight_down_is_finite():
    """w y - z x may round to a number just above 1/2."""
    quat = jnp.array([0.7071069, 0.0, 0.7071069, 0.0])
    assert float(maths.quat_to_euler(quat)[1]) == pytest.approx(np.pi / 2, abs=1e-3)


@quick
@given(angles, pitches, angles)
def test_euler_round_trip(roll, pitch, yaw):
    """Near 90 degrees of pitch the float32 arcsin loses digits: 1e-4 up to 1.5 rad."""
    np.testing.assert_allclose(
        to_euler(quaternion(roll, pitch, yaw)), [roll, pitch, yaw], atol=1e-4
    )


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (0.0, 0.0),
        (3.0, 3.0),
        (-3.0, -3.0),
        (4.0, 4.0 - 2 * np.pi),
        (-4.0, 2 * np.pi - 4.0),
        (7.0, 7.0 - 2 * np.pi),
        (100.0, 100.0 - 32 * np.pi),
    ],
)
def test_wrap_by_hand(angle, wrapped):
    assert float(wrap(angle)) == pytest.approx(wrapped, abs=1e-5)


@quick
@given(st.floats(-100, 100))
def test_wrap_keeps_the_direction(angle):
    wrapped = float(wrap(angle))
    assert -3.1415930 <= wrapped <= 3.1415930
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=3e-5)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=3e-5)


def test_norm():
    assert float(maths.norm(jnp.array([3.0, -4.0, 12.0]))) == 13.0
    np.testing.assert_allclose(maths.norm(jnp.array([[3.0, 4.0], [0.0, -2.0]])), [5.0, 2.0])


@pytest.mark.parametrize("condition", [True, False])
def test_tree_where_takes_one_side_whole(condition):
    a, b = {"x": jnp.ones(2), "y": jnp.array(1)}, {"x": jnp.zeros(2), "y": jnp.array(0)}
    out = maths.tree_where(jnp.asarray(condition), a, b)
    np.testing.assert_array_equal(out["x"], [condition] * 2)
    assert int(out["y"]) == condition
