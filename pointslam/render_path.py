"""Views of a run's or a session's map along a path, as a video or an archive."""

from __future__ import annotations

from pathlib import Path

from pointslam.client import Client
from pointslam.datasets.lists import read_trajectory
from pointslam.progress import progress_bar
from pointslam.run import open_saved_session
from pointslam.run_folder import RunFolder
from shared.errors import ConfigError
from shared.path_renders import PathFormat, PathRenderRequest, PathRenderStatus
from shared.se3 import Pose

_FORMATS = {".webm": PathFormat.WEBM, ".mp4": PathFormat.MP4, ".zip": PathFormat.JPEG}


def render_source(
    source: str, request: PathRenderRequest, gateway: str, out: Path
) -> PathRenderStatus:
    """Draw views of a run's folder, or of a session that a gateway serves, into a file.

    Raises:
        PointSlamError: there is no such run or session, or it cannot be drawn.
    """
    folder = RunFolder(Path(source))
    with progress_bar("rendering", "picture") as progress:
        if folder.is_run():
            with open_saved_session(folder, folder.read_record()) as session:
                return session.render_path(request, out, progress)
        with Client(gateway) as client:
            return client.session(source).render_path(request, out, progress)


def format_of(out: Path, is_lossless: bool) -> PathFormat:
    """What a file of this name holds.

    Raises:
        ConfigError: its suffix says nothing, or only an archive could be without loss.
    """
    format = _FORMATS.get(out.suffix)
    if format is None:
        raise ConfigError(f"--out {out}: its name must end with {', '.join(_FORMATS)}")
    if not is_lossless:
        return format
    if format is not PathFormat.JPEG:
        raise ConfigError(f"--lossless goes with a .zip, not with {out.suffix}")
    return PathFormat.PNG


def poses_in(file: Path) -> tuple[Pose, ...]:
    """The poses of a TUM file.

    Raises:
        ConfigError: it is absent or holds none.
    """
    poses = tuple(Pose.from_matrix(pose.T_world_camera) for pose in read_trajectory(file))
    if not poses:
        raise ConfigError(f"--path {file}: no such path, and no TUM file with poses")
    return poses
