"""The map as a triangle mesh or a cloud: rendered depth of all keyframes fused by Open3D's TSDF."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from services.mapping.export.glb import TRIANGLES, Primitive, glb_bytes
from services.mapping.pipeline import Mapper
from shared import se3
from shared.errors import UnavailableError
from shared.maps import RenderReply, RenderRequest

VOXEL_M = 0.02
TRUNCATION_VOXELS = 4.0
MAX_DEPTH_M = 20.0
MIN_ALPHA = 200  # of 255: where less is drawn, the depth is of no surface
MIN_WEIGHT = 0.5  # keyframes that saw a voxel
_BLOCK_VOXELS = 8  # side of the grid's blocks
_BLOCKS = 20_000  # room at the start; the grid grows
_INSTALL = (
    "a mesh needs the package open3d-cpu (pip install 'pointslam[mesh]') and its system "
    "libraries (apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1)"
)
Visit = Callable[[Callable[[Mapper], Any]], Any]


def mesh_ply(visit: Visit) -> bytes:
    """A mesh as PLY, with colours, in the map's own axes.

    Args:
        visit: asks the mapper between two of its iterations; once for each keyframe here.

    Raises:
        UnavailableError: Open3D or its system libraries are absent, or the map has no surface.
    """
    open3d, mesh = _fused(visit, "extract_triangle_mesh")
    return _written(open3d.io.write_triangle_mesh, "mesh.ply", mesh.to_legacy())


def mesh_glb(visit: Visit) -> bytes:
    """A mesh as binary glTF, with colours, y up; for the rest see `mesh_ply`."""
    _, mesh = _fused(visit, "extract_triangle_mesh")
    positions = mesh.vertex.positions.numpy() * np.array([1, -1, -1], np.float32)
    colours = np.rint(255.0 * mesh.vertex.colors.numpy().clip(0.0, 1.0)).astype(np.uint8)
    opaque = np.concatenate([colours, np.full_like(colours[:, :1], 255)], axis=1)
    attributes = {"POSITION": positions.astype(np.float32), "COLOR_0": opaque}
    return glb_bytes(Primitive(TRIANGLES, attributes, mesh.triangle.indices.numpy().astype("<u4")))


def cloud_ply(visit: Visit) -> bytes:
    """Points of the surface as PLY, with normals and colours; for the rest see `mesh_ply`."""
    open3d, cloud = _fused(visit, "extract_point_cloud")
    return _written(open3d.io.write_point_cloud, "cloud.ply", cloud.to_legacy())


def _fused(visit: Visit, extract: str) -> tuple[Any, Any]:
    """Open3D, and what its grid's method `extract` makes of all keyframes."""
    open3d = _open3d()
    grid = _grid(open3d)
    for seq in visit(lambda mapper: mapper.views.seqs()):
        _integrate(open3d, grid, *visit(lambda mapper, seq=seq: _rendered(mapper, seq)))
    surface = getattr(grid, extract)(weight_threshold=MIN_WEIGHT)
    points = surface.vertex if extract == "extract_triangle_mesh" else surface.point
    if len(points.positions) == 0:
        raise UnavailableError("the map has no surface yet")
    return open3d, surface


def _written(write: Callable[[str, Any], bool], name: str, surface: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(str(path), surface)
        return path.read_bytes()


def _rendered(mapper: Mapper, seq: int) -> tuple[RenderRequest, RenderReply]:
    view = mapper.views[seq]
    intrinsics = mapper.views.image(seq).intrinsics
    request = RenderRequest(view.T_world_camera, intrinsics, view.t_ns)
    return request, mapper.render(request)


def _grid(open3d: Any) -> Any:
    float32 = open3d.core.float32
    return open3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(float32, float32, float32),
        attr_channels=((1,), (1,), (3,)),
        voxel_size=VOXEL_M,
        block_resolution=_BLOCK_VOXELS,
        block_count=_BLOCKS,
        device=open3d.core.Device("CPU:0"),
    )


def _integrate(open3d: Any, grid: Any, request: RenderRequest, reply: RenderReply) -> None:
    """Add one rendered view to the grid."""
    solid = np.where(reply.alpha >= MIN_ALPHA, reply.depth_m, 0.0).astype(np.float32)
    if not solid.any():
        return
    depth = open3d.t.geometry.Image(solid[..., None])
    colour = open3d.t.geometry.Image(reply.rgb.astype(np.float32) / np.float32(255.0))
    matrix = open3d.core.Tensor(request.intrinsics.matrix())
    T_camera_world = open3d.core.Tensor(se3.inverse(request.T_world_camera))
    view = matrix, T_camera_world, 1.0, MAX_DEPTH_M, TRUNCATION_VOXELS
    blocks = grid.compute_unique_block_coordinates(depth, *view)
    grid.integrate(blocks, depth, colour, *view)


def _open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise UnavailableError(f"{_INSTALL}: {error}") from None
    return open3d
