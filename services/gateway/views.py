"""Render requests from a query string, and rendered views as files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.gateway.decode import MAX_T_NS, plain
from shared import codec, images
from shared.camera import MAX_IMAGE_SIDE_PX, Intrinsics
from shared.errors import InputError
from shared.maps import RenderReply, RenderRequest
from shared.se3 import Pose, Quaternion, Vector3

DEPTH_SCALE = 1000.0  # units per metre of a depth PNG
MEDIA_TYPES = {"jpeg": "image/jpeg", "png": "image/png", "msgpack": "application/msgpack"}
WHATS = ("colour", "depth", "alpha", "confidence")


@dataclass(frozen=True)
class View:
    """What of a render is wanted, and as which file."""

    request: RenderRequest
    what: str
    format: str

    def check(self, max_pixels: int) -> None:
        """Refuse what cannot be rendered with an InputError that names the field."""
        size = self.request.intrinsics
        size.check("intrinsics")
        if abs(self.request.appearance_t_ns or 0) >= MAX_T_NS:
            raise InputError("appearance_t_ns", f"must be less than {MAX_T_NS}")
        if size.width * size.height > max_pixels:
            raise InputError("width", f"width x height must be at most {max_pixels} pixels")
        if self.what not in WHATS:
            raise InputError("what", f"must be one of {', '.join(WHATS)}")
        if self.format not in MEDIA_TYPES:
            raise InputError("format", f"must be one of {', '.join(MEDIA_TYPES)}")
        if self.what != "colour" and self.format == "jpeg":
            raise InputError("format", f"{self.what} comes as png or msgpack")

    def etag(self, state: str) -> str:
        """A strong entity tag: the state of the map that is shown, and this view."""
        return f'"{state}-{self._digest()}"'

    def unless(self, if_none_match: str) -> RenderRequest:
        """The request of a client that has this view with one of these tags."""
        known = re.search(rf'"([\d.]+)-{self._digest()}"', if_none_match)
        return dataclasses.replace(self.request, unless_state=known[1]) if known else self.request

    def _digest(self) -> str:
        content = codec.pack(self.request) + f"{self.what} {self.format}".encode()
        return hashlib.blake2b(content, digest_size=12).hexdigest()

    def encode(self, reply: RenderReply) -> bytes:
        """The file."""
        if self.format == "msgpack":
            return codec.pack(reply)
        if self.what == "depth":
            return images.encode_png(millimetres(reply.depth_m))
        if self.what != "colour":
            return images.encode_png(reply.alpha if self.what == "alpha" else reply.confidence)
        if self.format == "png":
            return images.encode_png(reply.rgb)
        return images.encode_jpeg(reply.rgb).bytes


def mean_confidence(reply: RenderReply) -> float:
    """How well the map knows the view as a whole, 0 to 1."""
    return float(reply.confidence.mean()) / 255.0 if reply.confidence.size else 0.0


def millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth as a PNG holds it; 0 where there is none."""
    return np.clip(np.rint(depth_m * DEPTH_SCALE), 0, 65534).astype(np.uint16)


def pose_from(spelled: str | None, values: dict[str, float]) -> NDArray[np.float64]:
    """T_map_camera from JSON with named fields, else from px, py, pz, qx, qy, qz, qw.

    Raises:
        InputError: no such JSON, a value is not finite, or the quaternion has no length.
    """
    if spelled is not None:
        try:
            return plain(Pose, json.loads(spelled)).matrix()
        except (ValueError, RecursionError) as error:
            raise InputError("T_map_camera", f"not JSON ({str(error)[:100]})") from None
    position = Vector3(values["px"], values["py"], values["pz"])
    orientation = Quaternion(values["qx"], values["qy"], values["qz"], values["qw"])
    return Pose(position, orientation).matrix()


def intrinsics_from(
    lens: dict[str, float | None], width: int | None, height: int | None, camera: Intrinsics
) -> Intrinsics:
    """The session's colour camera, with what is given put in.

    A size without `fx` scales the camera to it.

    Raises:
        InputError: a side is no size of an image.
    """
    for name, side in (("width", width), ("height", height)):
        if side is not None and not 0 < side <= MAX_IMAGE_SIDE_PX:
            raise InputError(f"intrinsics.{name}", f"must be 1 to {MAX_IMAGE_SIDE_PX} px")
    if lens["fx"] is None and (width or height):
        camera = camera.scaled(width / camera.width if width else (height or 0) / camera.height)
    given = {name: value for name, value in lens.items() if value is not None}
    sizes = {"width": width or camera.width, "height": height or camera.height}
    return dataclasses.replace(camera, **given, **sizes)
