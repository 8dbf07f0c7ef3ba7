"""The map as a triangle mesh: rendered depth of all keyframes fused by Open3D's TSDF."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from services.mapping.pipeline import Mapper
from shared import se3
from shared.errors import UnavailableError
from shared.maps import RenderReply, RenderRequest

VOXEL_M = 0.02
TRUNCATION_M = 0.08
MIN_ALPHA = 200  # of 255: where less is drawn, the depth is of no surface
_INSTALL = (
    "a mesh needs the package open3d-cpu (pip install 'pointslam[mesh]') and its system "
    "libraries (apt-get install libgl1 libgomp1 libx11-6)"
)
Visit = Callable[[Callable[[Mapper], Any]], Any]


def export_mesh(visit: Visit) -> bytes:
    """A coloured mesh as PLY.

    Args:
        visit: asks the mapper between two of its iterations; once for each keyframe here.

    Raises:
        UnavailableError: Open3D or its system libraries are absent; says what to install.
    """
    open3d = _open3d()
    volume = open3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=VOXEL_M,
        sdf_trunc=TRUNCATION_M,
        color_type=open3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    for seq in visit(lambda mapper: mapper.views.seqs()):
        T_world_camera, reply, intrinsics = visit(lambda mapper, seq=seq: _rendered(mapper, seq))
        k = open3d.camera.PinholeCameraIntrinsic(
            intrinsics.width, intrinsics.height, intrinsics.matrix()
        )
        volume.integrate(_rgbd(open3d, reply), k, se3.inverse(T_world_camera))
    mesh = volume.extract_triangle_mesh()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        open3d.io.write_triangle_mesh(str(path), mesh)
        return path.read_bytes()


def _rendered(mapper: Mapper, seq: int) -> tuple[np.ndarray, RenderReply, Any]:
    view = mapper.views[seq]
    intrinsics = mapper.views.image(seq).intrinsics
    request = RenderRequest(view.T_world_camera, intrinsics, view.t_ns)
    return view.T_world_camera, mapper.render(request), intrinsics


def _rgbd(open3d: Any, reply: RenderReply) -> Any:
    depth = np.where(reply.alpha >= MIN_ALPHA, reply.depth_m, 0.0).astype(np.float32)
    return open3d.geometry.RGBDImage.create_from_color_and_depth(
        open3d.geometry.Image(np.ascontiguousarray(reply.rgb)),
        open3d.geometry.Image(depth),
        depth_scale=1.0,
        depth_trunc=20.0,
        convert_rgb_to_intensity=False,
    )


def _open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise UnavailableError(f"{_INSTALL}: {error}") from None
    return open3d
