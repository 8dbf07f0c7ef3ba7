"""Files that other programs read."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from services.mapping.export.baking import BakedGaussians
from services.mapping.export.pieces import MAX_OPEN, Exports
from services.mapping.export.splat_ply import write_ply
from services.mapping.export.splats import Splats
from services.mapping.rasterizer import Gaussians
from shared.errors import NotFoundError


def baked(count: int = 4, degree: int = 0) -> BakedGaussians:
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(count, 3, generator=generator),
        scales=torch.rand(count, 3, generator=generator) + 0.01,
        quats_wxyz=torch.randn(count, 4, generator=generator),
        opacities=torch.linspace(0.1, 0.9, count),
        colours=torch.rand(count, 3, generator=generator),
    )
    harmonics = 0.1 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    return BakedGaussians(gaussians, harmonics)


def ply_bytes(*blocks: BakedGaussians, degree: int = 0) -> bytes:
    write_ply(file := io.BytesIO(), map(Splats.of, blocks), degree)
    return file.getvalue()


def read_ply(data: bytes) -> np.ndarray:
    """The vertices of a binary PLY, by the names in its own header."""
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    vertices = np.frombuffer(body, [(name, "<f4") for name in names])
    assert f"element vertex {len(vertices)}" in lines
    return vertices


@pytest.mark.parametrize(("degree", "rest"), [(0, 0), (1, 9), (2, 24), (3, 45)])
def test_a_ply_holds_what_3dgs_viewers_expect(degree, rest):
    vertices = read_ply(ply_bytes(baked(degree=degree), degree=degree))

    assert vertices.dtype.names == (
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    )


def test_a_viewer_computes_the_maps_values_from_the_ply():
    expected = baked().gaussians

    vertices = read_ply(ply_bytes(baked()))

    scales = np.exp(columns(vertices, "scale_0", "scale_1", "scale_2"))
    quats = expected.quats_wxyz / expected.quats_wxyz.norm(dim=1, keepdim=True)
    found = columns(vertices, "rot_0", "rot_1", "rot_2", "rot_3")
    np.testing.assert_allclose(columns(vertices, "x", "y", "z"), expected.means)
    np.testing.assert_allclose(scales, expected.scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertices["opacity"])), expected.opacities, 1e-5)
    np.testing.assert_allclose(found, quats, atol=1e-6)


def test_a_viewer_computes_the_colours_of_a_direction_from_the_ply():
    x, y, z = direction = np.array([0.48, -0.6, 0.64])
    expected = baked(degree=1)
    camera = expected.gaussians.means[2] - 3.0 * torch.from_numpy(direction).float()

    vertex = read_ply(ply_bytes(expected, degree=1))[2]

    # As the viewers' shaders spell it: a constant, then three functions, colour by colour.
    colour = [
        0.5
        + 0.28209479177387814 * vertex[f"f_dc_{c}"]
        - 0.4886025119029199 * y * vertex[f"f_rest_{3 * c}"]
        + 0.4886025119029199 * z * vertex[f"f_rest_{3 * c + 1}"]
        - 0.4886025119029199 * x * vertex[f"f_rest_{3 * c + 2}"]
        for c in range(3)
    ]
    np.testing.assert_allclose(expected.seen_from(camera).colours[2], colour, atol=1e-6)


def columns(vertices: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([vertices[name] for name in names], axis=1)


def test_blocks_of_a_map_follow_each_other_in_one_ply():
    first, second = baked(12), baked(3)

    vertices = read_ply(ply_bytes(first, second))

    means = torch.cat([first.gaussians.means, second.gaussians.means])
    np.testing.assert_allclose(columns(vertices, "x", "y", "z"), means)


def test_a_map_of_nothing_is_a_ply_without_vertices():
    assert len(read_ply(ply_bytes(baked(0)))) == 0


def test_pieces_join_to_the_file_which_is_closed_then():
    exports, file, data = Exports(100), io.BytesIO(bytes(range(256)) * 5), bytes(range(256)) * 5

    pieces = [exports.start(file)]
    while pieces[-1].offset + 100 < pieces[-1].total:
        pieces.append(exports.piece(pieces[0].export, pieces[-1].offset + 100))

    assert b"".join(piece.bytes for piece in pieces) == data
    assert {piece.total for piece in pieces} == {1280}
    assert file.closed


def test_an_empty_file_is_one_empty_piece():
    assert Exports(100).start(io.BytesIO()).total == 0


def test_the_export_that_nobody_reads_makes_room_for_new_ones():
    exports, files = Exports(2), [io.BytesIO(b"12345") for _ in range(MAX_OPEN + 1)]

    names = [exports.start(file).export for file in files]

    assert [file.closed for file in files] == [True] + [False] * MAX_OPEN
    assert exports.piece(names[1], 2).bytes == b"34"
    with pytest.raises(NotFoundError, match="under way"):
        exports.piece(names[0], 2)
