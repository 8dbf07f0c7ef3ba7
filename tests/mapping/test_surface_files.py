"""Meshes and clouds of a map of a room, read by programs that are not ours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from services.mapping.config import MappingConfig
from services.mapping.export.mesh import Visit, cloud_ply, mesh_glb, mesh_ply
from services.mapping.pipeline import Mapper, NewKeyframe
from shared.tracks import KeyframePoses

open3d = pytest.importorskip("open3d", exc_type=ImportError)


@pytest.fixture
def visit(calibration, frame, true_pose) -> Visit:
    """A map of one keyframe after 60 iterations."""
    mapper = Mapper(calibration, MappingConfig(), 0, torch.device("cpu"))
    poses = KeyframePoses(1, np.array([0]), true_pose(0)[None])
    mapper.insert_keyframe(NewKeyframe(frame(0), poses, np.zeros((0, 3))))
    mapper.iterate(60)
    return lambda question: question(mapper)


def median_distance_m(points: NDArray) -> float:
    """To the room's back wall or its floor, whichever is nearer."""
    return float(np.median(np.minimum(abs(points[:, 2] - 2.0), abs(points[:, 1] - 0.8))))


def written(tmp_path, name: str, content: Callable[[Visit], bytes], visit: Visit) -> str:
    path = tmp_path / name
    path.write_bytes(content(visit))
    return str(path)


def test_a_mesh_lies_on_the_room(visit, tmp_path):
    mesh = open3d.io.read_triangle_mesh(written(tmp_path, "mesh.ply", mesh_ply, visit))

    vertices = np.asarray(mesh.vertices)
    assert len(vertices) > 100
    assert median_distance_m(vertices) < 0.02


def test_a_gltf_mesh_is_the_same_surface_with_y_up(visit, tmp_path):
    plain = open3d.io.read_triangle_mesh(written(tmp_path, "mesh.ply", mesh_ply, visit))

    (mesh,) = trimesh.load_scene(written(tmp_path, "m.glb", mesh_glb, visit)).geometry.values()

    expected = np.asarray(plain.vertices) * [1, -1, -1]
    np.testing.assert_allclose(np.sort(mesh.vertices, 0), np.sort(expected, 0), atol=1e-6)
    assert len(mesh.faces) == len(plain.triangles)
    assert mesh.visual.vertex_colors.shape == (len(expected), 4)


def test_a_cloud_lies_on_the_room_and_has_normals_and_colours(visit, tmp_path):
    cloud = open3d.io.read_point_cloud(written(tmp_path, "cloud.ply", cloud_ply, visit))

    assert median_distance_m(np.asarray(cloud.points)) < 0.02
    assert cloud.has_normals()
    assert cloud.has_colors()
