"""What a session shows to those who watch it."""

from __future__ import annotations

from services.gateway.events import SessionEvents
from services.gateway.newest_image import NewestImage
from services.gateway.pulse import Pulse
from shared.camera import Intrinsics
from shared.frames import Frame
from shared.stream import FrameReply


class LiveView:
    """The newest image, how tracking goes, and what happened."""

    def __init__(self, size: Intrinsics) -> None:
        self.image = NewestImage(size)
        self.pulse = Pulse()
        self.events = SessionEvents()

    def show(self, frame: Frame, reply: FrameReply) -> None:
        """A frame was answered."""
        self.image.keep(frame.seq, frame.rgb)
        self.pulse.beat(reply)
        self.events.hear(frame.seq, reply.status)
