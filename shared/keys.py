"""Every key expression of the bus, and how urgent what it carries is."""

from __future__ import annotations

from zenoh import Priority

ROOT = "ps/v1"


class Keys:
    """Every key expression of the system."""

    @staticmethod
    def track(worker: str) -> str:
        """Frames for one tracking worker (TrackRequest, TrackResult)."""
        return f"{ROOT}/track/{worker}/frame"

    @staticmethod
    def localize(worker: str) -> str:
        """Single images for one tracking worker (LocalizeRequest, LocalizeResult)."""
        return f"{ROOT}/track/{worker}/localize"

    @staticmethod
    def mapper(mapper: str, question: str) -> str:
        """Queries to one mapper.

        open (OpenRequest, OpenReply), list (Empty, SessionList), delete (DeleteRequest, Empty),
        pin (PinRequest, Empty).
        """
        return f"{ROOT}/mapper/{mapper}/{question}"

    @staticmethod
    def session(session: str, epoch: int, question: str) -> str:
        """Queries to the owner of a session's map in one epoch.

        claim (ClaimRequest, ClaimReply), advance (Advance, AdvanceReply),
        context (ContextRequest, TrackingContext), candidates (CandidatesRequest, Candidates),
        keyframes (Empty, KeyframePoses), keyframe (KeyframeRequest, KeyframeReply),
        render (RenderRequest, RenderReply),
        export (ExportRequest, ExportChunk),
        refine (RefineRequest, JobStatus), refinement (Empty, JobStatus), interrupt (Empty,
        JobStatus), save (SaveRequest, SaveReply), info (Empty, MapInfo),
        trajectory (TrajectoryRequest, Trajectory).
        """
        return f"{ROOT}/session/{session}/{epoch}/{question}"

    @staticmethod
    def revisions(session: str) -> str:
        """Publications of KeyframePoses."""
        return f"{ROOT}/revision/{session}"

    @staticmethod
    def advanced(session: str) -> str:
        """Publications of Advanced."""
        return f"{ROOT}/advanced/{session}"

    @staticmethod
    def alive(role: str, name: str) -> str:
        """Liveliness token of a process; role is tracking or mapping."""
        return f"{ROOT}/alive/{role}/{name}"

    @staticmethod
    def fields(key: str) -> dict[str, str | int]:
        """Session and epoch that a key is about, for the log."""
        parts = key.split("/")
        if len(parts) < 5 or parts[2] != "session" or not parts[4].isdecimal():
            return {}
        return {"session": parts[3], "epoch": int(parts[4])}

    @staticmethod
    def priority(key: str) -> Priority:
        """Of a question and its answer: what a camera waits for before what a person waits for."""
        return _PRIORITIES.get(key.rpartition("/")[2], Priority.DATA)


_PRIORITIES = {
    "claim": Priority.DATA_HIGH,
    "context": Priority.DATA_HIGH,
    "candidates": Priority.DATA_HIGH,
    "localize": Priority.DATA_LOW,
    "render": Priority.DATA_LOW,
    "trajectory": Priority.DATA_LOW,
    "export": Priority.BACKGROUND,
}
