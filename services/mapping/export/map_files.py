"""The map in every file format that needs the map itself (a snapshot needs its folder only)."""

from __future__ import annotations

from typing import BinaryIO

from services.mapping.config import ExportConfig
from services.mapping.export.baking import MapCopy, bake
from services.mapping.export.mesh import Visit, cloud_ply, mesh_glb, mesh_ply
from services.mapping.export.preview import preview
from services.mapping.export.splat_gltf import write_gltf
from services.mapping.export.splat_ply import write_ply
from services.mapping.export.splat_spz import write_spz
from services.mapping.export.splats import Splats
from services.mapping.spare_memory import give_back
from shared.maps import ExportFormat

_SPLATS = {
    ExportFormat.PLY: write_ply,
    ExportFormat.SPZ: write_spz,
    ExportFormat.GLB: write_gltf,
}
_SURFACES = {
    ExportFormat.MESH: mesh_ply,
    ExportFormat.MESH_GLB: mesh_glb,
    ExportFormat.POINTS: cloud_ply,
}


def write_map(file: BinaryIO, format: ExportFormat, visit: Visit, config: ExportConfig) -> None:
    """Write the map into a file that is at its start.

    Args:
        visit: asks the mapper between two of its iterations.

    Raises:
        UnavailableError: the map is empty and the format cannot say so, or a package is absent.
    """
    give_back()
    try:
        _write(file, format, visit, config)
    finally:
        give_back()  # what was copied and fitted leaves a tenth of a gigabyte of holes


def _write(file: BinaryIO, format: ExportFormat, visit: Visit, config: ExportConfig) -> None:
    if format in _SURFACES:
        file.write(_SURFACES[format](visit))
        return
    if format is ExportFormat.PREVIEW:
        write_ply(file, [Splats.of(preview(visit(MapCopy.of), config.preview_splats))], 0)
        return
    degree = config.harmonics_degree
    _SPLATS[format](file, map(Splats.of, bake(visit(MapCopy.of), degree)), degree)
