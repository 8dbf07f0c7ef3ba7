"""The one place that lets a request in or refuses it, whichever door it came by."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

from services.gateway.access.caller import Caller
from services.gateway.access.identity import Identity, Verifier
from services.gateway.access.rates import Budget, TokenBucket
from services.gateway.access.routes import Access
from services.gateway.access.tickets import Tickets
from services.gateway.config import AccessConfig
from shared.api_keys import PREFIX
from shared.errors import ForbiddenError, StorageError, UnauthenticatedError

LOGGER = logging.getLogger(__name__)

KEYS, JWT = "keys", "jwt"
_LOCAL = Caller("local")
_MAX_BUDGETS = 4096


@dataclass(frozen=True)
class Shown:
    """What a request shows of itself."""

    authorization: str = ""
    ticket: str = ""


@dataclass
class Authority:
    """Knows callers by their keys, tokens and tickets; without verifiers everybody is local."""

    config: AccessConfig
    verifiers: Mapping[str, Verifier] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.tickets = Tickets(self.config.ticket_s)
        self._budgets: dict[tuple[str, str], Budget] = {}

    @property
    def is_local(self) -> bool:
        """Whether everybody who reaches this gateway may do everything."""
        return not self.verifiers

    def admit(self, shown: Shown, access: Access) -> Caller:
        """Who it is, if they may do this now.

        Raises:
            UnauthenticatedError: no key, or none that is accepted.
            ForbiddenError: the key has none of the scopes.
            RateLimitedError: the key asked for too much.
        """
        caller = self._identified(shown, access)
        if not caller.scopes & access.scopes:
            wanted = " or ".join(sorted(access.scopes))
            raise ForbiddenError(f"this needs the scope {wanted}; the key {caller.id} has it not")
        caller.budget.take_request()
        return caller

    def is_valid(self, caller: Caller) -> bool:
        """Whether a caller admitted earlier has a key that is still accepted."""
        if self.is_local:
            return True
        identity = Identity(caller.id, caller.tenant, caller.scopes, caller.expires_s)
        return self._verifier_of(caller.id).is_valid(identity)

    def has_ended(self, caller: Caller) -> bool:
        """Whether the key of an open stream has ended, as far as can be told now.

        A store that is busy is asked again next time: an error would end who looks, not the stream.
        """
        try:
            return not self.is_valid(caller)
        except StorageError as error:
            LOGGER.warning("whether %s may go on is asked again: %s", caller.id, error)
            return False

    def _identified(self, shown: Shown, access: Access) -> Caller:
        if self.is_local:
            return _LOCAL
        if shown.ticket and access.takes_ticket:
            caller = self.tickets.use(shown.ticket)
            if not self.is_valid(caller):
                raise UnauthenticatedError(f"the key {caller.id} is no longer accepted")
            return caller
        scheme, _, token = shown.authorization.partition(" ")
        if scheme.lower() != "bearer" or not token:
            raise UnauthenticatedError("a key is needed; send Authorization: Bearer <key>")
        return self._caller(self._verifier_of_token(token.strip()).identify(token.strip()))

    def _verifier_of_token(self, token: str) -> Verifier:
        verifier = self.verifiers.get(KEYS if token.startswith(PREFIX) else JWT)
        if verifier is None:
            raise UnauthenticatedError("the key is not known here")
        return verifier

    def _verifier_of(self, id: str) -> Verifier:
        return self.verifiers[JWT if id.startswith(f"{JWT}:") else KEYS]

    def _caller(self, identity: Identity) -> Caller:
        budget = self._budget(identity.tenant, identity.id)
        return Caller(identity.id, identity.tenant, identity.scopes, identity.expires_s, budget)

    def _budget(self, tenant: str, id: str) -> Budget:
        """The caller's, the same for all of its connections; the longest unseen is forgotten."""
        budget = self._budgets.pop((tenant, id), None) or self._new_budget()
        while len(self._budgets) >= _MAX_BUDGETS:
            del self._budgets[next(iter(self._budgets))]
        self._budgets[tenant, id] = budget
        return budget

    def _new_budget(self) -> Budget:
        burst_s = self.config.burst_s
        return Budget(
            TokenBucket(self.config.requests_per_s, burst_s),
            TokenBucket(self.config.frames_per_s, burst_s),
        )
