"""Whom a bearer token stands for: our own keys, and JWTs of somebody else's."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from services.gateway.config import JwtConfig
from shared.api_keys import KeyStore, Scope, check_tenant
from shared.errors import ConfigError, InputError, UnauthenticatedError

# Signatures only: with a shared secret among them a public key could be passed off as one.
ALGORITHMS = ("RS256", "ES256", "EdDSA")
_LEEWAY_S = 10


@dataclass(frozen=True)
class Identity:
    """Whom a token stands for; seconds since 1970."""

    id: str
    tenant: str
    scopes: frozenset[Scope] = field(default_factory=frozenset)
    expires_s: float | None = None


class Verifier(Protocol):
    """One way to tell who holds a token."""

    def identify(self, token: str) -> Identity:
        """Whom the token stands for; raises UnauthenticatedError."""
        ...

    def is_valid(self, identity: Identity) -> bool:
        """Whether one identified earlier would still be."""
        ...


class KeyVerifier:
    """Our own keys."""

    def __init__(self, store: KeyStore) -> None:
        self._store = store

    def identify(self, token: str) -> Identity:
        """Whose key this is.

        Raises:
            UnauthenticatedError: it is no key of ours, expired, or revoked.
        """
        record = self._store.find(token)
        if record is None:
            raise UnauthenticatedError("the key is not known here")
        if (refusal := record.refusal(time.time())) is not None:
            raise UnauthenticatedError(f"the key {record.id} is {refusal}")
        return Identity(record.id, record.tenant, record.scopes, record.expires_s)

    def is_valid(self, identity: Identity) -> bool:
        """Whether the key has neither expired nor been revoked since."""
        record = self._store.record(identity.id)
        return record is not None and record.refusal(time.time()) is None


class JwtVerifier:
    """JSON web tokens (RFC 7519) with the claims sub, tenant, scope, exp, iss and aud."""

    def __init__(self, config: JwtConfig) -> None:
        try:
            import jwt
        except ImportError:
            raise ConfigError("access.jwt needs PyJWT: pip install 'pointslam[jwt]'") from None
        self._jwt = jwt
        self._config = config
        self._keys = self._read_keys(Path(config.key_file))

    def identify(self, token: str) -> Identity:
        """Whom the token's claims name.

        Raises:
            UnauthenticatedError: signature, issuer, audience, time or a claim is wrong.
        """
        try:
            claims = self._claims(token)
            scopes = frozenset(Scope(word) for word in claims["scope"].split() if word in _SCOPES)
            check_tenant(claims["tenant"])
            return Identity(f"jwt:{claims['sub']}", claims["tenant"], scopes, float(claims["exp"]))
        except (self._jwt.PyJWTError, InputError, AttributeError, TypeError) as error:
            raise UnauthenticatedError(f"the token is not accepted: {error}") from None

    def is_valid(self, identity: Identity) -> bool:
        """Whether the token has not expired since."""
        return identity.expires_s is not None and time.time() < identity.expires_s + _LEEWAY_S

    def _claims(self, token: str) -> dict[str, Any]:
        return self._jwt.decode(
            token,
            self._keys[self._name_of_key(token)],
            algorithms=list(ALGORITHMS),
            audience=self._config.audience,
            issuer=self._config.issuer,
            leeway=_LEEWAY_S,
            options={"require": ["exp", "iss", "aud", "sub", "tenant", "scope"]},
        )

    def _name_of_key(self, token: str) -> str:
        name = self._jwt.get_unverified_header(token).get("kid", "")
        name = name if len(self._keys) > 1 else next(iter(self._keys))
        if name not in self._keys:
            raise UnauthenticatedError("the token names no key of the issuer's that is known here")
        return name

    def _read_keys(self, file: Path) -> dict[str, Any]:
        """Public keys by name: one PEM, or a JWK set (RFC 7517)."""
        try:
            text = file.read_text()
            if not text.lstrip().startswith("{"):
                return {"": text}
            keys = self._jwt.PyJWKSet.from_dict(json.loads(text)).keys
            return {key.key_id or "": key for key in keys}
        except (OSError, ValueError, self._jwt.PyJWTError) as error:
            raise ConfigError(f"access.jwt.key_file {file}: {error}") from None


_SCOPES = frozenset(str(scope) for scope in Scope)
