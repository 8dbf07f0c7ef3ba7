"""Rectangles with textures: all that a procedural room is made of.

The world's z axis points up. A surface is seen from the side that it faces: its texture's first
row is the edge at `origin`, columns run along `right`, rows along `down`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pointslam.synth.textures import Material, Texture

Vector = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Surface:
    """One textured rectangle; `right` and `down` are unit vectors, sizes are metres."""

    origin: Vector
    right: Vector
    down: Vector
    width_m: float
    height_m: float
    texture: Texture
    is_lamp: bool = False  # shines by itself: shown as its texture, unlit

    @property
    def normal(self) -> Vector:
        """Unit vector towards the side that the surface is seen from."""
        return np.cross(self.down, self.right)


@dataclass(frozen=True)
class Box:
    """An upright block: centre of its base, size along its own axes, turn about z."""

    base: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw_rad: float = 0.0

    def axes(self) -> tuple[Vector, Vector]:
        """The box's own x and y axes in the world."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


@dataclass(frozen=True)
class Facing:
    """How a rectangle is looked at: along `forward`, with `up` on top."""

    forward: Vector
    up: Vector

    @property
    def right(self) -> Vector:
        """To the right of whoever looks."""
        return np.cross(self.forward, self.up)


def panel(
    centre: ArrayLike, facing: Facing, size_m: tuple[float, float], texture: Texture
) -> Surface:
    """A rectangle of (width, height) around `centre`."""
    right, up = facing.right, facing.up
    width, height = size_m
    origin = np.asarray(centre, np.float64) - 0.5 * width * right + 0.5 * height * up
    return Surface(origin, right, -up, width, height, texture)


def box_surfaces(box: Box, material: Material, rng: np.random.Generator) -> list[Surface]:
    """The four sides and the top of a box, seen from outside."""
    x_axis, y_axis = box.axes()
    sx, sy, sz = box.size
    centre = np.array(box.base) + 0.5 * sz * UP
    sides = [
        (Facing(y_axis, UP), sx, sz, 0.5 * sy),
        (Facing(-y_axis, UP), sx, sz, 0.5 * sy),
        (Facing(x_axis, UP), sy, sz, 0.5 * sx),
        (Facing(-x_axis, UP), sy, sz, 0.5 * sx),
        (Facing(-UP, y_axis), sx, sy, 0.5 * sz),
    ]
    return [
        panel(centre - half * facing.forward, facing, (w, h), material(rng, w, h))
        for facing, w, h, half in sides
    ]
