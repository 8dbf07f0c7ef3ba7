"""Three-vectors and rotations whose components are SIMD lanes or numbers."""

from __future__ import annotations

from services.mapping.rasterizer.simd import inlined


@inlined
def dot(u, v):
    """Scalar product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inlined
def cross(u, v):
    """Vector product."""
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


@inlined
def scaled(u, factor):
    """`factor * u`."""
    return u[0] * factor, u[1] * factor, u[2] * factor


@inlined
def product(u, v):
    """Component by component."""
    return u[0] * v[0], u[1] * v[1], u[2] * v[2]


@inlined
def combined(u, a, v, b):
    """`a * u + b * v`."""
    return u[0] * a + v[0] * b, u[1] * a + v[1] * b, u[2] * a + v[2] * b


@inlined
def weighted(columns, weights):
    """A matrix, given by columns, times a vector."""
    c, w = columns, weights
    return (
        c[0][0] * w[0] + c[1][0] * w[1] + c[2][0] * w[2],
        c[0][1] * w[0] + c[1][1] * w[1] + c[2][1] * w[2],
        c[0][2] * w[0] + c[1][2] * w[1] + c[2][2] * w[2],
    )


@inlined
def rotation_columns(q):
    """Columns of the rotation of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return (
        ((y * y + z * z) * -2.0 + 1.0, (x * y + w * z) * 2.0, (x * z - w * y) * 2.0),
        ((x * y - w * z) * 2.0, (x * x + z * z) * -2.0 + 1.0, (y * z + w * x) * 2.0),
        ((x * z + w * y) * 2.0, (y * z - w * x) * 2.0, (x * x + y * y) * -2.0 + 1.0),
    )


@inlined
def quaternion_gradient(q, c):
    """Gradient at a unit quaternion from the gradients `c` at the rotation's columns."""
    w, x, y, z = q
    return (
        (x * (c[1][2] - c[2][1]) + y * (c[2][0] - c[0][2]) + z * (c[0][1] - c[1][0])) * 2.0,
        (
            y * (c[1][0] + c[0][1])
            + z * (c[2][0] + c[0][2])
            + w * (c[1][2] - c[2][1])
            - x * (c[1][1] + c[2][2]) * 2.0
        )
        * 2.0,
        (
            x * (c[1][0] + c[0][1])
            + z * (c[2][1] + c[1][2])
            + w * (c[2][0] - c[0][2])
            - y * (c[0][0] + c[2][2]) * 2.0
        )
        * 2.0,
        (
            x * (c[2][0] + c[0][2])
            + y * (c[2][1] + c[1][2])
            + w * (c[0][1] - c[1][0])
            - z * (c[0][0] + c[1][1]) * 2.0
        )
        * 2.0,
    )
