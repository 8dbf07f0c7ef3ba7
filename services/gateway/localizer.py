"""Single images: read, checked, and given to a tracking worker to be found in a session's map."""

from __future__ import annotations

import time
from dataclasses import dataclass

from services.gateway.decode import (
    check_colour,
    check_depth,
    check_scale,
    check_size_of,
    matrix_of,
    named_from,
)
from services.gateway.dispatch import Limits
from services.gateway.owner import Fabric, MapOwner
from services.gateway.poses import deviations
from shared import codec
from shared.camera import Calibration, Camera
from shared.errors import InputError, UnavailableError
from shared.frames import DepthImage
from shared.localization import (
    LocalizationStatus,
    LocalizeMessage,
    LocalizeReply,
    LocalizeRequest,
    LocalizeResult,
)
from shared.se3 import Pose


@dataclass(frozen=True)
class _Device:
    """Whose image it is, where that is not the session's device."""

    calibration: Calibration | None = None
    camera: Camera | None = None


def read_localize(data: bytes, session: Calibration) -> LocalizeMessage:
    """A checked question from a msgpack message.

    Raises:
        TooLargeError: it is longer than the images of its device could be.
        InputError: names the field.
    """
    fields = codec.unpack_fields(data, ("calibration", "camera"))
    device = named_from(_Device, codec.from_plain, fields)
    check_size_of(data, calibration_of(device, session))
    message = named_from(LocalizeMessage, codec.unpack, data)
    check_localize(message, session)
    return message


def calibration_of(message: LocalizeMessage | _Device, session: Calibration) -> Calibration:
    """The device that took the image.

    Raises:
        InputError: it is described twice, or impossible.
    """
    calibration = message.calibration
    if message.camera is not None:
        if calibration is not None:
            raise InputError("camera", "must be absent where there is a calibration")
        calibration = Calibration(message.camera, session.depth_scale)
    if calibration is None:
        return session
    calibration.check()
    return calibration


def check_localize(message: LocalizeMessage, session: Calibration) -> None:
    """Refuse images that do not fit their device.

    Raises:
        InputError: names the field, what was found and what would do.
    """
    calibration = calibration_of(message, session)
    check_colour(message.rgb, calibration.colour.intrinsics)
    if message.T_map_camera_prior is not None:
        matrix_of(message.T_map_camera_prior, "T_map_camera_prior")
    if message.depth is None:
        return
    if message.camera is not None:
        raise InputError("camera", "is of colour alone: with depth, give the calibration")
    check_scale(message.depth, calibration)
    check_depth(message.depth, calibration.depth_camera().intrinsics)


class Localizer:
    """Finds single images in one session's map, a few at a time."""

    def __init__(self, fabric: Fabric, owner: MapOwner, calibration: Calibration) -> None:
        self._fabric = fabric
        self._owner = owner
        self._calibration = calibration
        self._under_way = 0

    async def localize(self, message: LocalizeMessage, map_revision: int) -> LocalizeReply:
        """Ask a tracking worker.

        Raises:
            PointSlamError: the image was refused.
            UnavailableError: no worker or no mapper, or too many images are under way.
        """
        limit = self._fabric.config.limits.max_localizations
        if self._under_way >= limit:
            raise UnavailableError(f"{limit} images are being localised in this session: try again")
        self._under_way += 1
        try:
            start = time.perf_counter()
            result = await self._ask(message, map_revision)
            return _reply(result, 1e3 * (time.perf_counter() - start))
        finally:
            self._under_way -= 1

    async def _ask(self, message: LocalizeMessage, map_revision: int) -> LocalizeResult:
        times = self._fabric.config.dispatch
        limits = Limits(times.offline_timeout_s, times.offline_wait_s, self._owner.session)

        async def ask() -> LocalizeResult:
            request = self._request(message, map_revision)
            return await self._fabric.trackers.localize(request, limits)

        return await self._owner.ask_tracker(ask, limits.wait_s)

    def _request(self, message: LocalizeMessage, map_revision: int) -> LocalizeRequest:
        depth, prior = message.depth, message.T_map_camera_prior
        return LocalizeRequest(
            session=self._owner.session,
            epoch=self._owner.epoch,
            map_revision=map_revision,
            calibration=calibration_of(message, self._calibration),
            rgb=message.rgb,
            depth=DepthImage(depth.encoding, depth.bytes) if depth else None,
            T_world_prior=matrix_of(prior, "T_map_camera_prior") if prior else None,
        )


def _reply(result: LocalizeResult, gateway_ms: float) -> LocalizeReply:
    is_found = result.status is not LocalizationStatus.NOT_LOCALISED
    deviation = deviations(result.covariance) if is_found else None
    return LocalizeReply(
        status=result.status,
        reason=result.reason,
        T_map_camera=Pose.from_matrix(result.T_world_camera) if is_found else None,
        pos_std_m=deviation[0] if deviation else None,
        rot_std_deg=deviation[1] if deviation else None,
        covariance=tuple(result.covariance.ravel().tolist()) if is_found else (),
        inliers=result.inliers,
        inlier_share=result.inlier_share,
        reference_seq=result.reference_seq,
        map_revision=result.map_revision,
        timings_ms=result.timings_ms | {"gateway": gateway_ms},
    )
