"""SPZ and glTF, read by programs that are not ours."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from typing import Any

import gsply
import numpy as np
import pytest
import torch
import trimesh

from services.mapping.export.baking import BakedGaussians
from services.mapping.export.harmonics import basis
from services.mapping.export.splat_gltf import write_gltf
from services.mapping.export.splat_ply import write_ply
from services.mapping.export.splat_spz import write_spz
from services.mapping.export.splats import Splats
from services.mapping.rasterizer import Gaussians
from shared.errors import UnavailableError

HALF_TURN = np.diag([1.0, -1.0, -1.0])


def splats(count: int = 200, degree: int = 3) -> Splats:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    return Splats(
        means_m=rng.uniform(-5, 5, (count, 3)).astype(np.float32),
        scales_m=np.exp(rng.uniform(-6, -1, (count, 3))).astype(np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, count).astype(np.float32),
        harmonics=rng.uniform(-0.4, 0.4, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def content(write: Callable[..., None], *blocks: Splats) -> bytes:
    write(file := io.BytesIO(), blocks, blocks[0].degree)
    return file.getvalue()


def rotations(quats_wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = quats_wxyz.T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def colours(harmonics: np.ndarray, directions: np.ndarray) -> np.ndarray:
    values = basis(torch.from_numpy(directions).float(), 3).numpy()
    return 0.5 + (values[:, :, None] * harmonics).sum(1)


@pytest.fixture
def directions() -> np.ndarray:
    drawn = np.random.default_rng(1).normal(size=(200, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def test_turning_the_axes_turns_every_rotation():
    turned = splats().y_up()

    expected = HALF_TURN @ rotations(splats().quats_wxyz)
    np.testing.assert_allclose(rotations(turned.quats_wxyz), expected, atol=1e-6)


def test_turning_the_axes_leaves_the_colour_of_every_direction(directions):
    turned = splats().y_up()

    seen = colours(turned.harmonics, directions @ HALF_TURN)
    np.testing.assert_allclose(seen, colours(splats().harmonics, directions), atol=1e-6)


@pytest.fixture
def read_spz(tmp_path):
    path = tmp_path / "map.spz"
    path.write_bytes(content(write_spz, splats()))
    return gsply.read_spz(path)


def test_a_reader_of_spz_gets_positions_to_a_quarter_of_a_millimetre(read_spz):
    np.testing.assert_allclose(read_spz.means, splats().means_m @ HALF_TURN, atol=1.3e-4)


def test_a_reader_of_spz_gets_shapes_and_opacities(read_spz):
    expected = splats().y_up()

    found = rotations(read_spz.quats / np.linalg.norm(read_spz.quats, axis=1, keepdims=True))
    np.testing.assert_allclose(found, rotations(expected.quats_wxyz), atol=6e-3)
    np.testing.assert_allclose(read_spz.scales, np.log(expected.scales_m), atol=1 / 31)
    np.testing.assert_allclose(1 / (1 + np.exp(-read_spz.opacities)), expected.opacities, atol=3e-3)


def test_a_reader_of_spz_gets_colours_to_its_steps(read_spz):
    expected = splats().y_up().harmonics

    np.testing.assert_allclose(read_spz.sh0, expected[:, 0], atol=0.014)
    np.testing.assert_allclose(read_spz.shN[:, :3], expected[:, 1:4], atol=4.6 / 128)
    np.testing.assert_allclose(read_spz.shN[:, 3:], expected[:, 4:], atol=8.6 / 128)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_spz_of_every_degree_is_read(tmp_path, degree):
    path = tmp_path / "map.spz"
    path.write_bytes(content(write_spz, splats(5, degree)))

    found = gsply.read_spz(path)

    assert found.shN.shape[1] == (degree + 1) ** 2 - 1


def test_spz_of_a_map_is_a_sixth_of_its_ply_or_less():
    smooth = splats(2000)

    assert 6 * len(content(write_spz, smooth)) < len(content(write_ply, smooth))


def gltf(glb: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The document of a GLB and the attributes of its primitive."""
    (length,) = struct.unpack_from("<I", glb, 12)
    document, binary = json.loads(glb[20 : 20 + length]), glb[28 + length :]
    arrays = {}
    for name, number in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        count = accessor["count"] * width
        arrays[name] = np.frombuffer(binary, kind, count, view["byteOffset"]).reshape(-1, width)
    return document, arrays


def test_a_splat_glb_has_what_the_extension_asks_for():
    document, arrays = gltf(content(write_gltf, splats()))

    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    assert {f"KHR_gaussian_splatting:SH_DEGREE_3_COEF_{n}" for n in range(7)} <= set(arrays)


def test_a_splat_glb_keeps_every_value():
    expected = splats().y_up()

    _, arrays = gltf(content(write_gltf, splats()))

    prefix = "KHR_gaussian_splatting:"
    xyzw = arrays[f"{prefix}ROTATION"]
    np.testing.assert_array_equal(np.roll(xyzw, 1, axis=1), expected.quats_wxyz)
    np.testing.assert_array_equal(arrays[f"{prefix}SCALE"], expected.scales_m)
    np.testing.assert_array_equal(arrays[f"{prefix}OPACITY"][:, 0], expected.opacities)
    np.testing.assert_array_equal(arrays[f"{prefix}SH_DEGREE_2_COEF_1"], expected.harmonics[:, 5])


def test_a_viewer_that_knows_no_splats_shows_points(tmp_path):
    path = tmp_path / "map.glb"
    path.write_bytes(content(write_gltf, splats()))

    (cloud,) = trimesh.load_scene(path).geometry.values()

    np.testing.assert_allclose(cloud.vertices, splats().y_up().means_m, atol=1e-6)


def test_an_empty_map_is_no_gltf():
    nothing = Gaussians(*(torch.zeros(0, *width) for width in ((3,), (3,), (4,), (), (3,))))

    with pytest.raises(UnavailableError, match="no Gaussians yet"):
        content(write_gltf, Splats.of(BakedGaussians(nothing, torch.zeros(0, 1, 3))))


@pytest.mark.parametrize("write", [write_ply, write_spz, write_gltf])
def test_blocks_of_a_map_make_the_file_of_the_whole(write):
    whole = splats()
    halves = [
        Splats(*(array[rows] for array in vars(whole).values()))
        for rows in (slice(0, 70), slice(70, None))
    ]

    assert content(write, *halves) == content(write, whole)
