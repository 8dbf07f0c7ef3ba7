"""The recorded images of keyframes, as people look at them."""

from __future__ import annotations

from services.mapping.sessions.ledger import Ledger
from services.mapping.sessions.worker import MapWorker
from shared.camera import Calibration
from shared.frames import ColourEncoding, ColourImage
from shared.images import encode_jpeg
from shared.maps import KeyframeReply, KeyframeRequest
from shared.rectify import rectify_colour


class KeyframeImages:
    """What the keyframes of one session saw; safe from any thread."""

    def __init__(self, worker: MapWorker, ledger: Ledger, calibration: Calibration) -> None:
        self._worker = worker
        self._ledger = ledger
        self._calibration = calibration

    def answer(self, request: KeyframeRequest) -> KeyframeReply:
        """The image of a keyframe with its present pose; waits while the map has yet to take it.

        Raises:
            NotFoundError: no such keyframe.
        """
        view = self._worker.keyframe(request.seq)
        jpeg = undistorted_jpeg(view.frame.rgb, self._calibration)
        return KeyframeReply(view.seq, view.t_ns, self._ledger.pose(view.seq), jpeg)


def undistorted_jpeg(image: ColourImage, calibration: Calibration) -> ColourImage:
    """A colour image without lens distortion, as JPEG: as it came, where it is that already.

    Raises:
        InputError: it is damaged, or of another size than the calibration says.
    """
    if image.encoding is ColourEncoding.JPEG and not any(calibration.colour.distortion):
        return image
    return encode_jpeg(rectify_colour(image, calibration))
