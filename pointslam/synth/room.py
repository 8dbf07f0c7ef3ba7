"""A furnished room, different for every seed: walls, windows, shelves, table, sofa, pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pointslam.synth import textures
from pointslam.synth.surfaces import UP, Box, Facing, Surface, Vector, box_surfaces, panel
from pointslam.synth.textures import Material

SIZE_M = np.array([5.0, 4.0, 2.6])

NORTH, SOUTH = Facing(np.array([0.0, 1.0, 0.0]), UP), Facing(np.array([0.0, -1.0, 0.0]), UP)
EAST, WEST = Facing(np.array([1.0, 0.0, 0.0]), UP), Facing(np.array([-1.0, 0.0, 0.0]), UP)
DOWN, ABOVE = Facing(-UP, NORTH.forward), Facing(UP, SOUTH.forward)

WALLPAPERS = [
    ((214, 203, 180), (150, 88, 74)),
    ((190, 205, 200), (70, 110, 120)),
    ((220, 208, 190), (96, 120, 72)),
    ((205, 196, 212), (112, 80, 132)),
]
FLOORS = [(176, 128, 84), (148, 104, 70), (190, 150, 108)]
WOODS = [(150, 100, 60), (120, 78, 50), (188, 148, 100), (96, 66, 48)]
CLOTHS = [(70, 90, 130), (130, 70, 66), (80, 110, 84), (150, 130, 100)]


@dataclass(frozen=True)
class Painter:
    """Draws with one stream of random numbers, so that a seed is a room."""

    rng: np.random.Generator

    def pick(self, colours: list) -> tuple:
        """One of a palette, slightly off."""
        colour = np.array(colours[int(self.rng.integers(len(colours)))], np.float64)
        return tuple((colour + self.rng.normal(0, 5, 3)).clip(0, 255).tolist())

    def box(self, box: Box, material: Material) -> list[Surface]:
        """A box of one material."""
        return box_surfaces(box, material, self.rng)

    def hang(
        self,
        at: tuple[float, float, float],
        facing: Facing,
        size_m: tuple[float, float],
        paint: Material,
    ) -> list[Surface]:
        """Something flat, a thumb's width off the wall."""
        centre = np.array(at) - 0.02 * facing.forward
        return [panel(centre, facing, size_m, paint(self.rng, *size_m))]


def build_room(seed: int) -> list[Surface]:
    """All surfaces of the room of a seed; its corner is the world's origin, metres."""
    painter = Painter(np.random.default_rng([seed, 1]))
    return [
        *_shell(painter),
        *_bookshelf(painter, (0.95, 3.83)),
        *_desk(painter, (2.55, 3.6)),
        *_cabinet(painter, (4.3, 3.77)),
        *_sofa(painter, (4.55, 1.7)),
        *_coffee_table(painter, (2.9, 2.55)),
        *_cartons(painter),
        *_west_wall(painter),
        *_pictures(painter),
    ]


def _shell(painter: Painter) -> list[Surface]:
    colour, ink = WALLPAPERS[int(painter.rng.integers(len(WALLPAPERS)))]
    paper = textures.wallpaper(colour, ink)
    length, depth, height = SIZE_M
    middle = 0.5 * SIZE_M
    walls = [(NORTH, length), (SOUTH, length), (EAST, depth), (WEST, depth)]
    surfaces = [
        panel(middle + middle * facing.forward, facing, (w, height), paper(painter.rng, w, height))
        for facing, w in walls
    ]
    floor = textures.wood(painter.pick(FLOORS), plank_m=0.14)(painter.rng, length, depth)
    ceiling = textures.plaster((226, 224, 216), 0.03)(painter.rng, length, depth)
    surfaces.append(panel(middle * [1, 1, 0], DOWN, (length, depth), floor))
    surfaces.append(panel(middle * [1, 1, 2], ABOVE, (length, depth), ceiling))
    lamp = np.full((200, 400, 3), 252, np.uint8)
    lamp[::40] = lamp[:, ::40] = 205
    surfaces.append(
        Surface(
            np.array([1.9, 2.3, height - 0.03]), EAST.forward, SOUTH.forward, 1.2, 0.6, lamp, True
        )
    )
    carpet = textures.rug(
        [tuple(painter.pick(CLOTHS)), (210, 190, 150), (150, 60, 50), (60, 66, 96)]
    )
    surfaces.append(panel([2.8, 2.3, 0.006], DOWN, (2.2, 1.5), carpet(painter.rng, 2.2, 1.5)))
    return surfaces


def _bookshelf(painter: Painter, at: tuple[float, float]) -> list[Surface]:
    timber = textures.wood(painter.pick(WOODS))
    upright = textures.wood(painter.pick(WOODS), is_upright=True)
    x, y = at
    surfaces = painter.box(Box((x, y + 0.15, 0), (1.3, 0.02, 2.0)), upright)
    for side in (-0.65, 0.65):
        surfaces += painter.box(Box((x + side, y, 0), (0.03, 0.3, 2.0)), upright)
    for level in range(6):
        height = 0.05 + 0.385 * level
        surfaces += painter.box(Box((x, y, height), (1.27, 0.3, 0.025)), timber)
        if level < 5:
            surfaces += _books(painter, (x - 0.62, y, height + 0.025), 1.24)
    return surfaces


def _books(painter: Painter, start: tuple[float, float, float], length_m: float) -> list[Surface]:
    surfaces: list[Surface] = []
    x, y, z = start
    end = x + length_m
    while x < end - 0.08:
        thickness, height = painter.rng.uniform(0.03, 0.075), painter.rng.uniform(0.2, 0.33)
        depth = painter.rng.uniform(0.14, 0.22)
        base = (x + 0.5 * thickness, y + 0.12 - 0.5 * depth, z)
        surfaces += painter.box(Box(base, (thickness, depth, height)), textures.book_spine)
        x += thickness + (0.18 if painter.rng.random() < 0.08 else 0.004)
    return surfaces


def _desk(painter: Painter, at: tuple[float, float]) -> list[Surface]:
    x, y = at
    timber = textures.wood(painter.pick(WOODS))
    surfaces = painter.box(Box((x, y, 0.72), (1.4, 0.7, 0.03)), timber)
    for leg_x, leg_y in ((-0.66, -0.31), (0.66, -0.31), (-0.66, 0.31), (0.66, 0.31)):
        surfaces += painter.box(Box((x + leg_x, y + leg_y, 0), (0.06, 0.06, 0.72)), timber)
    surfaces += painter.box(
        Box((x + 0.05, y + 0.15, 0.79), (0.56, 0.04, 0.36), 0.12), textures.painting
    )
    surfaces += painter.box(
        Box((x + 0.05, y + 0.17, 0.75), (0.2, 0.14, 0.04), 0.12), textures.plaster((50, 50, 54))
    )
    surfaces += painter.box(
        Box((x - 0.45, y - 0.05, 0.75), (0.24, 0.32, 0.11), 0.5), textures.printed_page
    )
    surfaces += painter.box(
        Box((x + 0.5, y - 0.12, 0.75), (0.16, 0.22, 0.05), -0.4), textures.book_spine
    )
    surfaces += painter.box(
        Box((x + 0.52, y + 0.22, 0.75), (0.12, 0.12, 0.26), 0.7),
        textures.fabric((190, 150, 70), (90, 50, 40)),
    )
    seat = textures.fabric(painter.pick(CLOTHS))
    turn = painter.rng.uniform(-0.6, 0.6)
    surfaces += painter.box(Box((x - 0.15, y - 0.62, 0.42), (0.45, 0.45, 0.07), turn), seat)
    surfaces += painter.box(
        Box((x - 0.15, y - 0.62, 0.0), (0.1, 0.1, 0.42), turn), textures.plaster((70, 70, 75))
    )
    return surfaces


def _cabinet(painter: Painter, at: tuple[float, float]) -> list[Surface]:
    x, y = at
    colour = painter.pick(WOODS)
    surfaces = painter.box(Box((x, y, 0), (1.0, 0.45, 0.95)), textures.wood(colour, plank_m=0.31))
    for level in range(3):
        centre = (x, y - 0.235, 0.17 + 0.31 * level)
        surfaces += painter.box(
            Box((x, y - 0.24, centre[2] - 0.02), (0.16, 0.03, 0.03)), textures.plaster((60, 55, 50))
        )
    vase = textures.rug([tuple(painter.pick(CLOTHS)), (230, 220, 200), (60, 80, 140)])
    surfaces += painter.box(Box((x - 0.25, y, 0.95), (0.17, 0.17, 0.34), 0.6), vase)
    surfaces += painter.box(
        Box((x + 0.2, y + 0.02, 0.95), (0.34, 0.05, 0.26), -0.25), textures.painting
    )
    return surfaces


def _sofa(painter: Painter, at: tuple[float, float]) -> list[Surface]:
    x, y = at
    cloth = textures.fabric(painter.pick(CLOTHS), painter.pick(CLOTHS))
    surfaces = painter.box(Box((x, y, 0.05), (0.85, 1.9, 0.37)), cloth)
    surfaces += painter.box(Box((x + 0.33, y, 0.42), (0.2, 1.9, 0.42)), cloth)
    for side in (-0.87, 0.87):
        surfaces += painter.box(Box((x, y + side, 0.42), (0.85, 0.18, 0.2)), cloth)
    for offset in (-0.5, 0.1, 0.52):
        pillow = textures.fabric(painter.pick(CLOTHS), (225, 215, 190))
        turn = painter.rng.uniform(-0.3, 0.3)
        surfaces += painter.box(Box((x + 0.12, y + offset, 0.42), (0.16, 0.38, 0.36), turn), pillow)
    return surfaces


def _coffee_table(painter: Painter, at: tuple[float, float]) -> list[Surface]:
    x, y = at
    turn = painter.rng.uniform(-0.4, 0.4)
    timber = textures.wood(painter.pick(WOODS))
    surfaces = painter.box(Box((x, y, 0.36), (0.9, 0.5, 0.05), turn), timber)
    surfaces += painter.box(Box((x, y, 0.0), (0.6, 0.3, 0.36), turn), timber)
    for offset, height in ((-0.22, 0.05), (0.1, 0.03), (0.3, 0.14)):
        size = (painter.rng.uniform(0.14, 0.26), painter.rng.uniform(0.14, 0.22), height)
        base = (x + offset, y + painter.rng.uniform(-0.1, 0.1), 0.41)
        surfaces += painter.box(Box(base, size, painter.rng.uniform(-1, 1)), textures.printed_page)
    return surfaces


def _cartons(painter: Painter) -> list[Surface]:
    cardboard = textures.wood((186, 148, 104))
    surfaces: list[Surface] = []
    for base, size in (
        ((3.75, 3.05, 0), (0.5, 0.4, 0.38)),
        ((3.72, 3.02, 0.38), (0.34, 0.3, 0.26)),
    ):
        box = Box(base, size, painter.rng.uniform(-0.7, 0.7))
        surfaces += painter.box(box, cardboard)
        x_axis, y_axis = box.axes()
        for facing in (Facing(y_axis, UP), Facing(x_axis, UP)):
            half = 0.5 * (size[1] if facing.forward is y_axis else size[0])
            label = np.array(base) + (0.5 * size[2]) * UP - (half - 0.012) * facing.forward
            surfaces += painter.hang(tuple(label), facing, (0.2, 0.16), textures.printed_page)
    return surfaces


def _west_wall(painter: Painter) -> list[Surface]:
    view = textures.landscape(painter.rng, 1.3, 1.2)
    window = panel([0.02, 2.2, 1.55], WEST, (1.3, 1.2), view)
    shining = Surface(window.origin, window.right, window.down, 1.3, 1.2, view, True)
    curtain = textures.fabric(painter.pick(CLOTHS), (220, 210, 190))
    surfaces = [shining]
    for y in (1.42, 2.98):
        surfaces += painter.box(Box((0.08, y, 0.15), (0.09, 0.32, 2.2)), curtain)
    surfaces += painter.box(
        Box((0.12, 2.2, 0.12), (0.12, 1.1, 0.6)), textures.wood((225, 222, 214), 0.08, True)
    )
    return surfaces


def _pictures(painter: Painter) -> list[Surface]:
    length, depth, _ = SIZE_M
    spots: list[tuple[tuple[float, float, float], Facing, tuple[float, float], Material]] = [
        ((2.1, depth, 1.65), NORTH, (0.5, 0.66), textures.painting),
        ((2.95, depth, 1.72), NORTH, (0.8, 0.52), textures.painting),
        ((4.25, depth, 1.8), NORTH, (0.6, 0.75), textures.printed_page),
        ((length, 1.3, 1.6), EAST, (0.9, 0.6), textures.painting),
        ((length, 2.45, 1.65), EAST, (0.55, 0.75), textures.printed_page),
        ((length, 3.3, 1.7), EAST, (0.5, 0.5), textures.painting),
        ((0.0, 0.65, 1.6), WEST, (0.6, 0.8), textures.painting),
        ((1.2, 0.0, 1.6), SOUTH, (0.9, 0.6), textures.painting),
        ((2.6, 0.0, 1.05), SOUTH, (0.9, 2.0), textures.wood((150, 110, 74), 0.3, True)),
        ((4.0, 0.0, 1.6), SOUTH, (0.6, 0.85), textures.printed_page),
    ]
    return [s for at, facing, size, paint in spots for s in painter.hang(at, facing, size, paint)]


def centre() -> Vector:
    """The middle of the room."""
    return 0.5 * SIZE_M
