"""Who may use this gateway, from its command line: one must say it, or it does not start."""

from __future__ import annotations

import ipaddress
import logging
import socket
import ssl
from argparse import ArgumentParser, Namespace
from dataclasses import dataclass
from pathlib import Path

from services.gateway.access import audit
from services.gateway.access.authority import JWT, KEYS, Authority
from services.gateway.access.identity import JwtVerifier, KeyVerifier, Verifier
from services.gateway.config import AccessConfig
from shared.api_keys import KeyStore
from shared.errors import ConfigError

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tls:
    """Files of a certificate (with its chain) and of its private key, both PEM."""

    certificate: Path
    key: Path

    def check(self) -> None:
        """Raise ConfigError unless both can be read and belong together."""
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key)
        except (OSError, ssl.SSLError) as error:
            raise ConfigError(
                f"--tls-certificate {self.certificate} with --tls-key {self.key}: {error}"
            ) from None


def add_access_arguments(parser: ArgumentParser) -> None:
    """The options of who may do what."""
    parser.add_argument("--keys", type=Path, metavar="FILE", help="made by `pointslam keys create`")
    parser.add_argument(
        "--insecure-local",
        action="store_true",
        help="no keys: whoever is on this machine may do everything",
    )
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE", help="PEM, with its chain")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="PEM")
    parser.add_argument("--audit-log", type=Path, metavar="FILE", help="instead of the log")


def authority_from(arguments: Namespace, config: AccessConfig) -> Authority:
    """The authority that the options ask for.

    Raises:
        ConfigError: they ask for none, or for one that would let anybody in over a network.
    """
    if arguments.audit_log is not None:
        audit.log_to(arguments.audit_log)
    verifiers = _verifiers(arguments, config)
    if arguments.insecure_local:
        _check_local(arguments.http_host, verifiers)
    elif not verifiers:
        raise ConfigError(
            "nobody could use this gateway: make a key with `pointslam keys create --store "
            "keys.sqlite` and pass --keys keys.sqlite, or pass --insecure-local to let everybody "
            "on this machine do everything"
        )
    elif arguments.tls_certificate is None and not is_loopback(arguments.http_host):
        LOGGER.warning("without --tls-certificate keys travel in clear, but for a proxy's TLS")
    return Authority(config, verifiers)


def tls_from(arguments: Namespace) -> Tls | None:
    """The certificate to show, if any.

    Raises:
        ConfigError: only one of its files is named, or they do not fit.
    """
    certificate, key = arguments.tls_certificate, arguments.tls_key
    if (certificate is None) != (key is None):
        raise ConfigError("--tls-certificate and --tls-key go together")
    if certificate is None:
        return None
    tls = Tls(certificate, key)
    tls.check()
    return tls


def is_loopback(host: str) -> bool:
    """Whether a host's every address is of this machine alone."""
    try:
        found = socket.getaddrinfo(host, None)
    except OSError:
        return False
    return all(ipaddress.ip_address(address[4][0]).is_loopback for address in found)


def _check_local(host: str, verifiers: dict[str, Verifier]) -> None:
    if verifiers:
        raise ConfigError("--insecure-local asks nobody for a key; leave --keys and access.jwt out")
    if not is_loopback(host):
        raise ConfigError(
            f"--insecure-local with --http-host {host} would let the whole network in; listen on "
            "127.0.0.1, or make keys with `pointslam keys create` and pass --keys, or name "
            "an issuer of JSON web tokens in access.jwt"
        )


def _verifiers(arguments: Namespace, config: AccessConfig) -> dict[str, Verifier]:
    verifiers: dict[str, Verifier] = {}
    if arguments.keys is not None:
        verifiers[KEYS] = KeyVerifier(KeyStore.open_to_read(arguments.keys))
    if config.jwt.key_file:
        verifiers[JWT] = JwtVerifier(config.jwt)
    return verifiers
