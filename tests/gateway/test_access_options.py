"""Who may use a gateway, as its command line says it; tokens of an issuer; TLS."""

import argparse
import base64
import datetime
import hmac
import json
import sqlite3
import time
from ipaddress import ip_address
from pathlib import Path

import grpc
import httpx
import jwt
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from jwt.algorithms import ECAlgorithm

from benchmarks.local_gateway import free_port, gateway_process
from pointslam.client import Client
from services.gateway.access.arguments import add_access_arguments, authority_from, tls_from
from services.gateway.access.authority import Shown
from services.gateway.access.identity import JwtVerifier
from services.gateway.access.rates import TokenBucket
from services.gateway.access.routes import ADMIN, POSE
from services.gateway.config import AccessConfig, JwtConfig
from shared.api_keys import KeyStore, NewKey, Scope, key_id
from shared.errors import ConfigError, ForbiddenError, UnauthenticatedError

ISSUER, AUDIENCE = "https://id.example", "pointslam"


def options(*words):
    parser = argparse.ArgumentParser()
    parser.add_argument("--http-host", default="127.0.0.1")
    add_access_arguments(parser)
    return parser.parse_args(words)


@pytest.fixture
def store(tmp_path):
    KeyStore.open(tmp_path / "keys.sqlite").create(NewKey())
    return str(tmp_path / "keys.sqlite")


def test_a_gateway_without_a_word_about_keys_does_not_start():
    with pytest.raises(ConfigError, match="pointslam keys create .* --insecure-local"):
        authority_from(options(), AccessConfig())


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1"])
def test_an_insecure_gateway_listens_on_loopback_alone(host):
    with pytest.raises(ConfigError, match="let the whole network in"):
        authority_from(options("--insecure-local", "--http-host", host), AccessConfig())


def test_keys_and_insecure_local_contradict_each_other(store):
    with pytest.raises(ConfigError, match="leave --keys"):
        authority_from(options("--insecure-local", "--keys", store), AccessConfig())


def test_keys_may_be_asked_for_on_every_address(store):
    authority = authority_from(options("--keys", store, "--http-host", "0.0.0.0"), AccessConfig())

    assert not authority.is_local


def test_a_stream_goes_on_while_the_store_of_its_key_is_locked_and_ends_when_it_is_revoked(store):
    writer = KeyStore.open(Path(store))
    text = writer.create(NewKey())
    authority = authority_from(options("--keys", store), AccessConfig())
    caller = authority.admit(Shown(f"Bearer {text}"), POSE)
    lock = sqlite3.connect(store, isolation_level=None)
    lock.execute("BEGIN EXCLUSIVE")

    while_locked = authority.has_ended(caller)
    lock.execute("ROLLBACK")
    writer.revoke(str(key_id(text)))

    assert not while_locked
    assert authority.has_ended(caller)


def test_half_a_certificate_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="go together"):
        tls_from(options("--tls-key", str(tmp_path / "key.pem")))


def test_a_certificate_that_is_none_is_refused(tmp_path):
    (tmp_path / "x.pem").write_text("hello")
    word = str(tmp_path / "x.pem")

    with pytest.raises(ConfigError, match="--tls-certificate"):
        tls_from(options("--tls-certificate", word, "--tls-key", word))


def test_a_bucket_gives_its_burst_and_then_its_rate():
    bucket = TokenBucket(0.5, 10.0)

    waits = [bucket.take() for _ in range(7)]

    assert waits[:5] == [0.0] * 5
    assert waits[5] == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def private_key():
    return ec.generate_private_key(ec.SECP256R1())


@pytest.fixture(scope="module")
def pem(private_key, tmp_path_factory):
    file = tmp_path_factory.mktemp("jwt") / "issuer.pem"
    public = serialization.PublicFormat.SubjectPublicKeyInfo
    file.write_bytes(private_key.public_key().public_bytes(serialization.Encoding.PEM, public))
    return file


def claims(**changes):
    good = {
        "sub": "ana",
        "tenant": "acme",
        "scope": "pose openid render",
        "iss": ISSUER,
        "aud": AUDIENCE,
        "exp": time.time() + 600,
    }
    return {key: value for key, value in (good | changes).items() if value is not None}


def test_a_token_of_the_issuer_names_caller_tenant_and_scopes(private_key, pem):
    config = AccessConfig(jwt=JwtConfig(str(pem), ISSUER, AUDIENCE))
    authority = authority_from(options(), config)
    token = jwt.encode(claims(), private_key, "ES256")

    caller = authority.admit(Shown(f"Bearer {token}"), POSE)

    assert (caller.id, caller.tenant, caller.scopes) == (
        "jwt:ana",
        "acme",
        {Scope.POSE, Scope.RENDER},
    )
    assert authority.is_valid(caller)
    with pytest.raises(ForbiddenError):
        authority.admit(Shown(f"Bearer {token}"), ADMIN)


@pytest.mark.parametrize(
    "changes",
    [
        {"iss": "https://other.example"},
        {"aud": "another"},
        {"exp": 1.0},
        {"nbf": 4e9},
        {"exp": None},
        {"sub": None},
        {"tenant": None},
        {"tenant": "a.b"},
        {"tenant": 7},
        {"scope": None},
        {"scope": 7},
    ],
    ids=str,
)
def test_a_token_with_a_wrong_claim_is_not_accepted(private_key, pem, changes):
    verifier = JwtVerifier(JwtConfig(str(pem), ISSUER, AUDIENCE))

    with pytest.raises(UnauthenticatedError):
        verifier.identify(jwt.encode(claims(**changes), private_key, "ES256"))


def _encoded(data):
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def _part(value):
    return _encoded(json.dumps(value).encode())


def test_a_token_without_a_signature_by_the_issuer_is_not_accepted(pem):
    verifier = JwtVerifier(JwtConfig(str(pem), ISSUER, AUDIENCE))
    stranger = jwt.encode(claims(), ec.generate_private_key(ec.SECP256R1()), "ES256")
    unsigned = jwt.encode(claims(), "", "none")
    # The public key taken for a shared secret, in a token that is written by hand.
    body = f"{_part({'alg': 'HS256', 'typ': 'JWT'})}.{_part(claims())}"
    signature = hmac.digest(pem.read_bytes(), body.encode(), "sha256")
    confused = f"{body}.{_encoded(signature)}"

    for token in (stranger, unsigned, confused, "a.b.c", ""):
        with pytest.raises(UnauthenticatedError):
            verifier.identify(token)


def test_a_key_set_serves_the_key_that_a_token_names(private_key, tmp_path):
    jwk = json.loads(ECAlgorithm.to_jwk(private_key.public_key()))
    other = json.loads(ECAlgorithm.to_jwk(ec.generate_private_key(ec.SECP256R1()).public_key()))
    file = tmp_path / "jwks.json"
    file.write_text(json.dumps({"keys": [other | {"kid": "old"}, jwk | {"kid": "new"}]}))
    verifier = JwtVerifier(JwtConfig(str(file), ISSUER, AUDIENCE))

    assert verifier.identify(jwt.encode(claims(), private_key, "ES256", {"kid": "new"})).id
    for header in ({"kid": "old"}, {"kid": "none"}, {}):
        with pytest.raises(UnauthenticatedError):
            verifier.identify(jwt.encode(claims(), private_key, "ES256", header))


def test_an_issuer_must_be_named():
    with pytest.raises(ConfigError, match="issuer"):
        JwtConfig("issuer.pem")


def test_a_key_where_only_tokens_are_taken_is_unknown(pem):
    authority = authority_from(options(), AccessConfig(jwt=JwtConfig(str(pem), ISSUER, AUDIENCE)))

    with pytest.raises(UnauthenticatedError, match="not known"):
        authority.admit(Shown("Bearer ps_0123"), POSE)


def _certificate(folder, private_key):
    """A certificate of 127.0.0.1, signed by itself, and its key, as PEM files."""
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(private_key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1"))]), False
        )
        .sign(private_key, hashes.SHA256())
    )
    files = (folder / "certificate.pem", folder / "key.pem")
    pem = serialization.Encoding.PEM
    files[0].write_bytes(certificate.public_bytes(pem))
    pkcs8, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    files[1].write_bytes(private_key.private_bytes(pem, pkcs8, plain))
    return files


def test_every_door_speaks_tls_with_the_certificate(
    gateway, tmp_path, monkeypatch, private_key, store, calibration, rgb, depth
):
    certificate, key_file = _certificate(tmp_path, private_key)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    key = KeyStore.open(tmp_path / "keys.sqlite").create(NewKey("acme"))
    tls = ("--tls-certificate", str(certificate), "--tls-key", str(key_file))
    ports = (free_port(), free_port())
    with gateway_process(gateway.router, ports, access=("--keys", store, *tls)):
        with Client(f"https://127.0.0.1:{ports[0]}", key) as client:
            while not client.ready():
                pass
            session = client.create_session(calibration, mode="offline")
            (reply,) = session.stream([session.frame(rgb, depth, 1)])
            session.delete()
        trusted = grpc.ssl_channel_credentials(certificate.read_bytes())
        with grpc.secure_channel(f"127.0.0.1:{ports[1]}", trusted) as channel:
            method = channel.unary_unary("/pointslam.v1.SessionService/ListSessions")
            listed = method(b"", metadata=(("authorization", f"Bearer {key}"),), timeout=60)
        with pytest.raises(httpx.TransportError):
            httpx.get(f"http://127.0.0.1:{ports[0]}/healthz")
        monkeypatch.delenv("SSL_CERT_FILE")
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"https://127.0.0.1:{ports[0]}/healthz")

    assert reply.error is None
    assert listed == b""
