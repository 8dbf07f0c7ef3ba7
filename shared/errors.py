"""Errors that this project raises on purpose, one family.

A broken invariant inside our code is an `assert`; bad input at a border is one of these; an
expected outcome (tracking lost, a view of nothing) is a value in a result.
"""


class PointSlamError(Exception):
    """Root of every error this project raises on purpose."""

    code = "error"


class ConfigError(PointSlamError):
    """A setting is unknown or outside its range."""

    code = "config"


class InputError(PointSlamError):
    """A request holds a field that cannot be used; names the field and what would do."""

    code = "invalid_input"

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(f"{field}: {reason}")
        self.field = field
        self.reason = reason


class SequenceError(PointSlamError):
    """A recorded sequence cannot be read; names the file and what is wrong with it."""

    code = "sequence"

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = str(path)
        self.reason = reason


class NotFoundError(PointSlamError):
    """The session, frame or map that a request names does not exist."""

    code = "not_found"


class ConflictError(PointSlamError):
    """The request contradicts the present state, such as a frame out of order."""

    code = "conflict"


class ClaimLostError(ConflictError):
    """Another gateway advances the session by now: go on there, or claim the session anew."""

    code = "claim_lost"


class UnavailableError(PointSlamError):
    """A service that the request needs is absent, gone or too slow: try again later."""

    code = "unavailable"


class GoneError(UnavailableError):
    """Nobody answered: the process that did is gone. Another may be asked at once."""


class SteppedDownError(GoneError):
    """This process answers no longer for what it was asked, and must be as silent as if gone."""


class TimedOutError(UnavailableError):
    """The process is there but frozen or too slow."""


class StorageError(PointSlamError):
    """The disk refused (full, read-only) or holds a file that fails its checksum."""

    code = "storage"


class UnauthenticatedError(PointSlamError):
    """A request without a key that is known and valid."""

    code = "unauthenticated"


class ForbiddenError(PointSlamError):
    """A key that is known but may not do this."""

    code = "forbidden"


class RateLimitedError(PointSlamError):
    """A key has asked for more than its share: try again after `retry_after_s` seconds."""

    code = "rate_limited"

    def __init__(self, message: str, retry_after_s: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
