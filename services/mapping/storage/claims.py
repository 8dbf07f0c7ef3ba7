"""Which gateway advances a session: the one with the newest claim, and no other."""

from __future__ import annotations

import logging
from dataclasses import replace

from services.mapping.storage.folders import SessionFolder, SessionRecord
from shared.errors import ClaimLostError
from shared.tracks import ClaimRequest

LOGGER = logging.getLogger(__name__)


class Claims:
    """The claims of one session, numbered; each is on disk before it holds."""

    def __init__(self, folder: SessionFolder, record: SessionRecord) -> None:
        self._folder = folder
        self._record = record

    @property
    def newest(self) -> int:
        """The number of the newest claim; 0 where there was none."""
        return self._record.claim

    def take(self, request: ClaimRequest) -> bool:
        """Make a new claim, unless the asker has the newest; returns whether it was made.

        Raises:
            StorageError: the disk refused; the old claim holds.
        """
        if request.held == self.newest and request.held > 0:
            return False
        claimed = replace(self._record, claim=self.newest + 1)
        self._folder.write_record(claimed)
        self._record = claimed
        LOGGER.info("%s: claim %d of %s", claimed.session, claimed.claim, request.gateway)
        return True

    def check(self, number: int) -> None:
        """Refuse a frame of an older claim.

        Raises:
            ClaimLostError: another gateway has claimed the session since.
        """
        if number < self.newest:
            name = self._record.session
            raise ClaimLostError(f"another gateway advances session {name} (claim {self.newest})")
