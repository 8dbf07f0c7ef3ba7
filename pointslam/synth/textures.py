"""Procedural materials: functions of (rng, size in metres) to RGB images at TEXEL_M a texel."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from pointslam.synth.noise import fractal_noise, tinted, value_noise

TEXEL_M = 0.003

Texture = NDArray[np.uint8]
Material = Callable[[np.random.Generator, float, float], Texture]


def texels(metres: float) -> int:
    """Texels along a length, at least two."""
    return max(round(metres / TEXEL_M), 2)


def _shape(width_m: float, height_m: float) -> tuple[int, int]:
    return texels(height_m), texels(width_m)


def plaster(colour: tuple[int, int, int], grain: float = 0.02) -> Material:
    """Painted plaster: roller grain and faint stains."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        shape = _shape(width_m, height_m)
        stains = 0.025 * fractal_noise(rng, shape, 180.0, 3)
        return tinted(colour, 1 + stains + grain * fractal_noise(rng, shape, 5.0, 2))

    return paint


def wallpaper(colour: tuple[int, int, int], ink: tuple[int, int, int]) -> Material:
    """Stripes and hand-printed flowers: a repeating pattern of which no two prints are alike."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        shape = _shape(width_m, height_m)
        columns = np.arange(shape[1]) * TEXEL_M
        stripes = 0.03 * np.sign(np.sin(2 * np.pi * columns / 0.16)).astype(np.float32)
        aged = 0.03 * fractal_noise(rng, shape, 120.0, 4) + stripes
        image = tinted(colour, 1 + aged)
        for row in range(30, shape[0], 80):
            for column in range(20 + 27 * (row // 80 % 2), shape[1], 54):
                _flower(image, rng, (column, row), ink)
        return image

    return paint


def _flower(
    image: Texture, rng: np.random.Generator, centre: tuple[int, int], ink: tuple[int, int, int]
) -> None:
    x, y = (int(c + rng.normal(0, 2.5)) for c in centre)
    shade = [float(np.clip(c * rng.uniform(0.75, 1.2), 0, 255)) for c in ink]
    turn = rng.uniform(0, 72)
    for petal in range(5):
        angle = np.deg2rad(turn + 72 * petal)
        at = (int(x + 8 * np.cos(angle)), int(y + 8 * np.sin(angle)))
        radius = int(rng.integers(3, 7))
        cv2.circle(image, at, radius, shade, -1, cv2.LINE_AA)
    cv2.circle(image, (x, y), 3, (235, 205, 120), -1, cv2.LINE_AA)


def wood(colour: tuple[int, int, int], plank_m: float = 0.0, is_upright: bool = False) -> Material:
    """Wood grain along the longer run; `plank_m` wide planks of differing shade where positive."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        if is_upright:
            width_m, height_m = height_m, width_m
        shape = _shape(width_m, height_m)
        grain = value_noise(rng, shape, (3.0, 90.0)) + 0.7 * value_noise(rng, shape, (1.5, 40.0))
        rings = np.sin(
            0.35 * np.arange(shape[0])[:, None] + 4 * value_noise(rng, shape, (40.0, 250.0))
        )
        brightness = 1 + 0.06 * grain + 0.05 * rings.astype(np.float32)
        if plank_m > 0:
            brightness *= _planks(rng, shape, texels(plank_m))
        image = tinted(colour, brightness)
        return np.ascontiguousarray(image.transpose(1, 0, 2)) if is_upright else image

    return paint


def _planks(rng: np.random.Generator, shape: tuple[int, int], rows: int) -> NDArray[np.float32]:
    shade = np.ones(shape, np.float32)
    for top in range(0, shape[0], rows):
        left = -int(rng.integers(0, 250))
        while left < shape[1]:
            right = left + int(rng.integers(250, 420))
            shade[top : top + rows, max(left, 0) : max(right, 0)] *= rng.uniform(0.78, 1.12)
            shade[top : top + rows, max(right - 1, 0) : max(right + 1, 0)] *= 0.6
            left = right
        shade[top : top + 2] *= 0.6
    return shade


def fabric(colour: tuple[int, int, int], check: tuple[int, int, int] | None = None) -> Material:
    """Woven cloth with folds, and a tartan of a second colour where one is given."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        shape = _shape(width_m, height_m)
        weave = 0.07 * rng.standard_normal(shape).astype(np.float32)
        folds = 0.06 * fractal_noise(rng, shape, 90.0, 3)
        image = tinted(colour, 1 + weave + folds)
        if check is None:
            return image
        rows, columns = (np.arange(side) % 70 for side in shape)
        share = (
            0.35 * (rows < 22)[:, None]
            + 0.35 * (columns < 22)[None]
            + 0.2 * (rows % 35 < 3)[:, None]
        )
        mixed = image * (1 - share[..., None]) + np.array(check) * share[..., None]
        return np.clip(mixed, 0, 255).astype(np.uint8)

    return paint


def rug(colours: list[tuple[int, int, int]]) -> Material:
    """Bordered rug with rows of woven lozenges."""

    def paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        height, width = _shape(width_m, height_m)
        image = np.full((height, width, 3), colours[0], np.uint8)
        for ring, colour in enumerate(colours[1:]):
            inset = 14 + 16 * ring
            cv2.rectangle(image, (inset, inset), (width - inset, height - inset), colour, 7)
        for row in range(75, height - 60, 62):
            for column in range(75, width - 60, 62):
                radius = int(rng.integers(14, 27))
                lozenge = np.array([[0, -radius], [radius, 0], [0, radius], [-radius, 0]])
                colour = colours[int(rng.integers(1, len(colours)))]
                cv2.fillConvexPoly(image, lozenge + [column, row], colour, cv2.LINE_AA)
        pile = 1 + 0.1 * rng.standard_normal((height, width)).astype(np.float32)
        return tinted(image, pile)

    return paint


def painting(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """A framed abstract: blended ground, shapes, strokes; never the same twice."""
    height, width = _shape(width_m, height_m)
    ground = [fractal_noise(rng, (height, width), 0.6 * width, 4) for _ in range(3)]
    image = np.clip(130 + 45 * np.stack(ground, -1), 0, 255).astype(np.uint8)
    for _ in range(26):
        colour = rng.integers(10, 250, 3).tolist()
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        size = int(rng.integers(4, max(5, min(height, width) // 5)))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), size, colour, int(rng.choice([-1, 3])), cv2.LINE_AA)
        else:
            corners = np.array([x, y]) + rng.integers(-2 * size, 2 * size + 1, (4, 2))
            cv2.fillPoly(image, [corners.astype(np.int32)], colour, cv2.LINE_AA)
    border = max(4, min(height, width) // 18)
    frame = rng.integers(30, 110, 3).tolist()
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), frame, 2 * border)
    return tinted(image, 1 + 0.02 * rng.standard_normal((height, width)).astype(np.float32))


def printed_page(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """A poster or a magazine: headline, columns of words, a picture."""
    height, width = _shape(width_m, height_m)
    image = np.full((height, width, 3), rng.integers(205, 245, 3), np.uint8)
    ink = rng.integers(10, 90, 3).tolist()
    picture = painting(rng, 0.8 * width_m, 0.35 * height_m)[: height // 3]
    left = (width - picture.shape[1]) // 2
    image[height // 5 : height // 5 + len(picture), left : left + picture.shape[1]] = picture
    cv2.rectangle(image, (left, height // 18), (width - left, height // 8), ink, -1)
    for row in range(int(0.6 * height), int(0.94 * height), 6):
        column = left
        while column < width - left:
            word = int(rng.integers(4, 16))
            cv2.line(image, (column, row), (min(column + word, width - left), row), ink, 2)
            column += word + 4
    return image


def book_spine(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """A book's back: cloth, bands and a title."""
    height, width = _shape(width_m, height_m)
    cloth = rng.uniform(35, 220, 3)
    image = tinted(cloth, 1 + 0.06 * rng.standard_normal((height, width)).astype(np.float32))
    ink = (255 - cloth).tolist() if rng.random() < 0.5 else [225.0, 195.0, 110.0]
    for band in rng.uniform(0.05, 0.95, int(rng.integers(1, 4))):
        row = int(band * height)
        cv2.line(image, (0, row), (width, row), ink, 2)
    for row in range(int(0.25 * height), int(0.7 * height), 5):
        if rng.random() < 0.7:
            cv2.line(image, (width // 4, row), (int(width * rng.uniform(0.5, 0.85)), row), ink, 2)
    return image


def landscape(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """What a window shows: sky, hills, trees; and the window's bars."""
    height, width = _shape(width_m, height_m)
    fade = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = (np.array([150, 190, 235]) * (1 - fade) + np.array([225, 235, 240]) * fade) * np.ones(
        (1, width, 1)
    )
    image += 14 * np.clip(fractal_noise(rng, (height, width), 70.0, 4), 0, 3)[..., None]
    for layer, colour in enumerate(((140, 165, 150), (95, 135, 90), (60, 100, 55))):
        ridge = height * (0.5 + 0.13 * layer) + 18 * fractal_noise(rng, (1, width), 90.0, 4)[0]
        below = np.arange(height)[:, None] > ridge[None]
        leaves = 1 + 0.14 * fractal_noise(rng, (height, width), 16.0, 3)
        image = np.where(below[..., None], np.array(colour) * leaves[..., None], image)
    picture = np.clip(image, 0, 255).astype(np.uint8)
    for x in np.linspace(0, width - 1, 3).astype(int).tolist():
        cv2.line(picture, (x, 0), (x, height), (240, 238, 230), 14)
    for y in np.linspace(0, height - 1, 3).astype(int).tolist():
        cv2.line(picture, (0, y), (width, y), (240, 238, 230), 14)
    return picture
