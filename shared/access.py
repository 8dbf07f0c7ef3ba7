"""Who may do what on the bus: what each role needs of it, everything else is denied.

A router drops what it denies without a word, so `Bus.declare_alive` looks whether it is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from shared.keys import ROOT

_FRAMES = (f"{ROOT}/track/**",)
_MAPS = (f"{ROOT}/mapper/**", f"{ROOT}/session/**")
_CONTEXTS = (f"{ROOT}/session/*/*/context", f"{ROOT}/session/*/*/candidates")
_NEWS = (f"{ROOT}/revision/*", f"{ROOT}/advanced/*")


def _alive(role: str) -> tuple[str, ...]:
    return (f"{ROOT}/alive/{role}/*",)


@dataclass(frozen=True)
class AccessConfig:
    """Names of users, or common names of certificates, by role; all empty: no access list."""

    gateway: tuple[str, ...] = ()
    tracking: tuple[str, ...] = ()
    mapping: tuple[str, ...] = ()
    router: tuple[str, ...] = ()

    @property
    def is_set(self) -> bool:
        """Whether anybody is named; then everybody else may do nothing."""
        return any(getattr(self, role.name) for role in fields(self))


@dataclass(frozen=True)
class _Right:
    """Messages of some kinds, on some keys, from a role (ingress) or to it (egress)."""

    flow: str
    messages: tuple[str, ...]
    keys: tuple[str, ...]


def _asks(keys: tuple[str, ...]) -> tuple[_Right, ...]:
    return (
        _Right("ingress", ("query",), keys),
        _Right("egress", ("reply", "declare_queryable"), keys),
    )


def _answers(keys: tuple[str, ...]) -> tuple[_Right, ...]:
    return (
        _Right("ingress", ("declare_queryable", "reply"), keys),
        _Right("egress", ("query",), keys),
    )


def _publishes(keys: tuple[str, ...]) -> tuple[_Right, ...]:
    return _Right("ingress", ("put",), keys), _Right("egress", ("declare_subscriber",), keys)


def _subscribes(keys: tuple[str, ...]) -> tuple[_Right, ...]:
    return _Right("ingress", ("declare_subscriber",), keys), _Right("egress", ("put",), keys)


def _watches(role: str) -> tuple[_Right, ...]:
    watched = ("declare_liveliness_subscriber", "liveliness_query")
    return (
        _Right("ingress", watched, _alive(role)),
        _Right("egress", ("liveliness_token",), _alive(role)),
    )


def _lives(role: str) -> tuple[_Right, ...]:
    return (_Right("ingress", ("liveliness_token",), _alive(role)), *_watches(role))


_RIGHTS: dict[str, tuple[_Right, ...]] = {
    "gateway": (*_asks(_FRAMES), *_asks(_MAPS), *_subscribes(_NEWS), *_watches("*")),
    "tracking": (*_answers(_FRAMES), *_asks(_CONTEXTS), *_lives("tracking")),
    "mapping": (*_answers(_MAPS), *_publishes(_NEWS), *_lives("mapping")),
}
_EVERYTHING = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)


def access_control(access: AccessConfig, names: str) -> dict[str, Any]:
    """zenoh's `access_control` section; `names` is usernames or cert_common_names."""
    rules, policies, subjects = [], [], []
    for role in fields(access):
        members: tuple[str, ...] = getattr(access, role.name)
        if not members:
            continue
        of_role = _rules(role.name)
        rules += of_role
        subjects.append({"id": role.name, names: list(members)})
        policies.append({"rules": [rule["id"] for rule in of_role], "subjects": [role.name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(role: str) -> list[dict[str, Any]]:
    all_keys = (f"{ROOT}/**",)
    routed = tuple(_Right(flow, _EVERYTHING, all_keys) for flow in ("ingress", "egress"))
    return [
        {
            "id": f"{role}-{number}",
            "messages": list(right.messages),
            "flows": [right.flow],
            "permission": "allow",
            "key_exprs": list(right.keys),
        }
        for number, right in enumerate(_RIGHTS.get(role, routed))
    ]
