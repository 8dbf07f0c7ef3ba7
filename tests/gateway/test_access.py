"""Every route and RPC of a gateway that wants keys: without one, a wrong one, another's."""

import asyncio
import json
import time
from contextlib import contextmanager
from typing import Any

import grpc
import httpx
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from benchmarks.local_gateway import free_port, gateway_process
from pointslam.client import Client
from services.gateway.access.authority import Authority
from services.gateway.access.routes import ANY, GRPC, HTTP, OPEN, names_of
from services.gateway.app import create_app, open_sessions
from services.gateway.config import AccessConfig, GatewayConfig
from shared import codec
from shared.api_keys import KeyStore, NewKey, Scope, key_id
from shared.errors import NotFoundError, RateLimitedError, UnauthenticatedError
from shared.stream import FrameReply

SECOND = 1_000_000_000
CLOSED_HTTP = [name for name, access in HTTP.items() if access != OPEN]
CLOSED_RPC = [method for method, access in GRPC.items() if access != OPEN]
BURST, FRAMES = 80, 20  # that a key may save up, at a rate that no test waits for


class Guarded:
    """A gateway that wants keys, and its store."""

    def __init__(self, folder, ports):
        self.url = f"http://127.0.0.1:{ports[0]}"
        self.grpc_address = f"127.0.0.1:{ports[1]}"
        self.audit = folder / "audit.jsonl"
        self.store = KeyStore.open(folder / "keys.sqlite")
        self._keys = {}
        self.revoked = self.new_key()
        self.store.revoke(str(key_id(self.revoked)))
        self.expired = self.store.create(NewKey(expires_s=time.time() + 1.0))
        time.sleep(1.0)

    def new_key(self):
        return self.store.create(NewKey("acme"))

    def key(self, tenant="acme", scopes=frozenset(Scope)):
        """One of these; the same each time, because the disk takes long over a new one."""
        what = (tenant, frozenset(scopes))
        if what not in self._keys:
            self._keys[what] = self.store.create(NewKey(*what))
        return self._keys[what]

    def audited(self, key):
        """The last entry of a key, which follows the answer to its action."""
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline:
            entries = map(json.loads, self.audit.read_text().splitlines())
            if found := [entry for entry in entries if entry["key"] == key_id(key)]:
                return found[-1]
        raise AssertionError(f"no entry of {key_id(key)}")


@pytest.fixture(scope="module")
def guarded(gateway, tmp_path_factory):
    folder = tmp_path_factory.mktemp("access")
    ports = (free_port(), free_port())
    guarded = Guarded(folder, ports)
    access = ("--keys", str(folder / "keys.sqlite"), "--audit-log", str(guarded.audit))
    settings = (
        "access.requests_per_s=1",
        "access.frames_per_s=0.25",
        "access.burst_s=80",
        "access.recheck_s=0.1",
    )
    with gateway_process(gateway.router, ports, *settings, access=access):
        with Client(guarded.url) as client:
            while not client.ready():
                pass
        yield guarded


@pytest.fixture(scope="module")
def theirs(guarded, calibration):
    """A session of the tenant acme."""
    with Client(guarded.url, guarded.key()) as client:
        session = client.create_session(calibration, name="kitchen", mode="offline")
        yield session
        session.delete()


@pytest.fixture(scope="module")
def channel(guarded):
    with grpc.insecure_channel(guarded.grpc_address) as channel:
        yield channel


def bearer(key):
    return {"Authorization": f"Bearer {key}"} if key else {}


def status_of(guarded, name, key, query=""):
    """The HTTP status of a route of the table; of a socket that of its refusal."""
    method, path = name.split(" ", 1)
    for word, value in {"name": "kitchen", "seq": "0", "format": "tum"}.items():
        path = path.replace(f"{{{word}}}", value)
    url = guarded.url + path + query
    if method != "WS":
        return httpx.request(method, url, headers=bearer(key)).status_code
    try:
        with connect(url.replace("http", "ws", 1), additional_headers=bearer(key)):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def rpc_code(channel, method, key, session="kitchen"):
    """The status of a method, called with nothing but the name of a session (always field 1)."""
    request = b"\x0a" + bytes([len(session)]) + session.encode()
    metadata = tuple((k.lower(), v) for k, v in bearer(key).items())
    stream = "TrackFrames" in method
    streamed = stream or method.endswith(("WatchPoses", "ExportMap"))
    try:
        if stream:
            list(channel.stream_stream(method)(iter([request]), metadata=metadata, timeout=60))
        elif streamed:
            list(channel.unary_stream(method)(request, metadata=metadata, timeout=60))
        else:
            channel.unary_unary(method)(request, metadata=metadata, timeout=60)
    except grpc.RpcError as error:
        failed: Any = error
        return failed.code()
    return grpc.StatusCode.OK


def without(access):
    return frozenset(Scope) - access.scopes


def test_the_table_names_every_route_and_no_other(gateway):
    async def names():
        sessions = open_sessions(gateway.bus, GatewayConfig())
        return set(names_of(create_app(sessions, Authority(AccessConfig())).routes))

    served = {name for name in asyncio.run(names()) if not name.startswith("HEAD ")}

    assert served == set(HTTP)


def test_the_table_names_every_rpc_and_no_other(channel):
    database = ProtoReflectionDescriptorDatabase(channel)
    pool = DescriptorPool(database)
    methods = {
        f"/{service}/{method.name}"
        for service in database.get_services()
        for method in pool.FindServiceByName(service).methods
    }

    assert methods == set(GRPC)


@pytest.mark.parametrize("name", CLOSED_HTTP)
def test_a_route_without_a_valid_key_is_unauthorized(guarded, theirs, name):
    keys = [None, "ps_nonsense", "a.b.c", guarded.expired, guarded.revoked]

    assert [status_of(guarded, name, key) for key in keys] == [401] * len(keys)


@pytest.mark.parametrize("name", [name for name in CLOSED_HTTP if HTTP[name] != ANY])
def test_a_route_without_its_scope_is_forbidden(guarded, theirs, name):
    if scopes := without(HTTP[name]):
        assert status_of(guarded, name, guarded.key(scopes=scopes)) == 403


@pytest.mark.parametrize("name", [name for name in CLOSED_HTTP if "{name}" in name])
def test_another_tenants_session_does_not_exist(guarded, theirs, name):
    query = "?format=ply" if name.endswith("/map") else ""

    assert status_of(guarded, name, guarded.key("globex"), query) == 404


@pytest.mark.parametrize("method", CLOSED_RPC)
def test_an_rpc_without_a_valid_key_is_unauthenticated(guarded, channel, theirs, method):
    keys = [None, "ps_nonsense", guarded.expired, guarded.revoked]

    codes = {rpc_code(channel, method, key) for key in keys}

    assert codes == {grpc.StatusCode.UNAUTHENTICATED}


@pytest.mark.parametrize("method", [method for method in CLOSED_RPC if GRPC[method] != ANY])
def test_an_rpc_without_its_scope_is_denied(guarded, channel, theirs, method):
    key = guarded.key(scopes=without(GRPC[method]))

    assert rpc_code(channel, method, key) is grpc.StatusCode.PERMISSION_DENIED


@pytest.mark.parametrize(
    "method", [m for m in CLOSED_RPC if not m.endswith(("CreateSession", "ListSessions"))]
)
def test_another_tenants_session_is_not_found_by_rpc(guarded, channel, theirs, method):
    code = rpc_code(channel, method, guarded.key("globex"))

    assert code is grpc.StatusCode.NOT_FOUND


def test_a_tenant_lists_its_own_sessions_alone_by_its_own_names(guarded, theirs, offline):
    with (
        Client(guarded.url, guarded.key()) as own,
        Client(guarded.url, guarded.key("globex")) as other,
    ):
        own_names = [row["session"] for row in own.sessions()]

        assert "kitchen" in own_names and offline.name not in own_names
        assert other.sessions() == []


@pytest.mark.parametrize("name", ["acme.kitchen", "acme%2Ekitchen", ".kitchen", "acme/kitchen"])
def test_no_name_spells_another_tenants_session(guarded, theirs, name):
    key = guarded.key("default")

    response = httpx.get(f"{guarded.url}/v1/sessions/{name}", headers=bearer(key))

    assert response.status_code == 404


def test_two_tenants_may_have_sessions_of_one_name(guarded, theirs, calibration, rgb, depth):
    with Client(guarded.url, guarded.key("globex")) as client:
        session = client.create_session(calibration, name="kitchen", mode="offline")
        session.track(rgb, depth, SECOND)
        theirs.track(rgb, depth, SECOND)

        assert len(session.trajectory()) == 1
        assert session.info()["session"] == "kitchen"
        session.delete()
        with pytest.raises(NotFoundError):
            session.info()
    assert theirs.info()["session"] == "kitchen"


def test_what_is_open_needs_no_key(guarded):
    for path in ("/healthz", "/readyz", "/docs", "/openapi.json"):
        assert httpx.get(guarded.url + path).status_code == 200


def test_a_refusal_says_how_to_come_in(guarded):
    response = httpx.get(guarded.url + "/v1/sessions")

    assert response.headers["www-authenticate"] == "Bearer"
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json()["code"] == "unauthenticated"


def test_the_client_finds_its_key_in_the_environment(guarded, monkeypatch):
    monkeypatch.setenv("POINTSLAM_API_KEY", guarded.key("initech"))
    with Client(guarded.url) as client:
        assert client.sessions() == []

    monkeypatch.setenv("POINTSLAM_API_KEY", "ps_nonsense")
    with Client(guarded.url) as client, pytest.raises(UnauthenticatedError):
        client.sessions()


def ticket(guarded, key):
    return httpx.post(guarded.url + "/v1/tickets", headers=bearer(key)).json()


@contextmanager
def socket(guarded, query="", **options):
    url = guarded.url.replace("http", "ws") + "/v1/sessions/kitchen/stream" + query
    with connect(url, compression=None, **options) as connection:
        yield connection


def test_a_ticket_opens_a_socket_once(guarded, theirs, rgb, depth):
    told = ticket(guarded, guarded.key())
    query = f"?ticket={told['ticket']}"

    with socket(guarded, query) as connection:
        connection.send(codec.pack(theirs.frame(rgb, depth, 2 * SECOND)))
        answer = connection.recv()
    again = status_of(guarded, "WS /v1/sessions/{name}/stream", None, query)

    assert told["expires_in_s"] == 30.0
    assert isinstance(answer, bytes) and codec.unpack(FrameReply, answer).error is None
    assert again == 401


def test_a_ticket_is_of_its_keys_tenant_and_scopes(guarded, theirs):
    name = "WS /v1/sessions/{name}/stream"
    other = ticket(guarded, guarded.key("globex"))["ticket"]
    weak = ticket(guarded, guarded.key(scopes={Scope.POSE}))["ticket"]

    assert status_of(guarded, name, None, f"?ticket={other}") == 404
    assert status_of(guarded, name, None, f"?ticket={weak}") == 403


def test_a_ticket_opens_an_event_stream_and_nothing_else(guarded, theirs):
    query = f"?ticket={ticket(guarded, guarded.key())['ticket']}"

    assert status_of(guarded, "GET /v1/sessions/{name}", None, query) == 401
    # 404: the session was never refined.
    assert status_of(guarded, "GET /v1/sessions/{name}/refine/events", None, query) == 404


def test_a_ticket_dies_with_its_key(guarded, theirs):
    key = guarded.new_key()
    query = f"?ticket={ticket(guarded, key)['ticket']}"
    guarded.store.revoke(str(key_id(key)))

    assert status_of(guarded, "WS /v1/sessions/{name}/stream", None, query) == 401


def test_an_open_socket_ends_when_its_key_is_revoked(guarded, theirs):
    key = guarded.new_key()
    with socket(guarded, additional_headers=bearer(key)) as connection:
        guarded.store.revoke(str(key_id(key)))

        with pytest.raises(ConnectionClosed) as closed:
            connection.recv(timeout=60)

    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008


def test_an_open_rpc_stream_ends_when_its_key_is_revoked(guarded, channel, theirs):
    key = guarded.new_key()
    method = channel.unary_stream("/pointslam.v1.PoseService/WatchPoses")
    call = method(b"\x0a\x07kitchen", metadata=(("authorization", f"Bearer {key}"),), timeout=60)
    call.initial_metadata()
    guarded.store.revoke(str(key_id(key)))

    with pytest.raises(grpc.RpcError) as ended:
        next(call)

    failed: Any = ended.value
    assert failed.code() is grpc.StatusCode.UNAUTHENTICATED


def test_too_many_requests_of_one_key_are_told_when_to_come_again(guarded):
    busy, other = guarded.new_key(), guarded.key()

    with httpx.Client(headers=bearer(busy)) as http:
        replies = [http.get(guarded.url + "/v1/sessions") for _ in range(2 * BURST)]

    refused = [reply for reply in replies if reply.status_code == 429]
    assert all(reply.status_code == 200 for reply in replies[:BURST]) and refused
    assert refused[0].json()["code"] == "rate_limited"
    assert refused[0].headers["retry-after"] == "1"
    assert status_of(guarded, "GET /v1/sessions", other) == 200


def test_too_many_rpcs_of_one_key_exhaust_it(guarded, channel):
    key = guarded.new_key()

    codes = [
        rpc_code(channel, "/pointslam.v1.SessionService/ListSessions", key)
        for _ in range(2 * BURST)
    ]

    assert set(codes[:BURST]) == {grpc.StatusCode.OK}
    assert grpc.StatusCode.RESOURCE_EXHAUSTED in codes


def test_too_many_frames_are_refused_each_and_the_stream_goes_on(guarded, calibration, rgb, depth):
    with Client(guarded.url, guarded.new_key()) as client:
        session = client.create_session(calibration, mode="offline")
        frames = (session.frame(rgb, depth, (i + 1) * SECOND) for i in range(2 * FRAMES))

        replies = list(session.stream(frames))

        errors = [reply.error.code for reply in replies if reply.error is not None]
        assert len(replies) == 2 * FRAMES and set(errors) == {"rate_limited"}
        with pytest.raises(RateLimitedError):
            for i in range(2 * FRAMES):
                session.track(rgb, depth, (100 + i) * SECOND)
        httpx.delete(
            f"{guarded.url}/v1/sessions/{session.name}", headers=bearer(guarded.key())
        ).raise_for_status()


@pytest.mark.parametrize("url", ["gateway", "guarded"])
def test_another_sites_page_is_refused(gateway, guarded, offline, url):
    base = {"gateway": gateway.url, "guarded": guarded.url}[url]
    foreign, own = {"Origin": "https://evil.example"}, {"Origin": base}

    posted = httpx.post(base + "/v1/tickets", headers=foreign | bearer(guarded.key()))
    welcome = httpx.post(base + "/v1/tickets", headers=own | bearer(guarded.key()))
    with pytest.raises(InvalidStatus) as refused:
        connect(
            f"{base.replace('http', 'ws')}/v1/sessions/{offline.name}/stream",
            additional_headers=foreign | bearer(guarded.key("default")),
        )

    assert (posted.status_code, welcome.status_code) == (403, 201)
    assert refused.value.response.status_code == 403


def test_a_local_gateway_answers_to_names_of_this_machine_alone(gateway):
    response = httpx.get(gateway.url + "/v1/sessions", headers={"Host": "evil.example:8080"})

    assert (response.status_code, response.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize("name", ["Host", "Origin"])
def test_a_header_that_is_no_address_is_refused(gateway, name):
    response = httpx.get(gateway.url + "/v1/sessions", headers={name: "http://[::1"})

    assert (response.status_code, response.json()["code"]) == (403, "forbidden")


def test_a_local_gateway_gives_tickets_too(gateway):
    assert set(httpx.post(gateway.url + "/v1/tickets").json()) == {"ticket", "expires_in_s"}


def test_an_admins_action_is_in_the_audit_log(guarded, theirs):
    key = guarded.new_key()

    theirs_again = Client(guarded.url, key).session("kitchen")
    theirs_again.save()

    entry = guarded.audited(key)
    assert (entry["event"], entry["key"], entry["tenant"]) == ("admin", key_id(key), "acme")
    assert (entry["action"], entry["outcome"]) == ("POST /v1/sessions/kitchen/save", "200")


def test_an_admins_rpc_is_in_the_audit_log(guarded, channel):
    key = guarded.new_key()

    rpc_code(channel, "/pointslam.v1.SessionService/DeleteSession", key, "nobody")

    entry = guarded.audited(key)
    assert (entry["event"], entry["key"], entry["outcome"]) == ("admin", key_id(key), "NOT_FOUND")


def test_a_refused_key_is_in_the_audit_log_by_its_id_alone(guarded):
    key = guarded.revoked

    status_of(guarded, "GET /v1/sessions", key)

    entry = guarded.audited(key)
    assert (entry["event"], entry["code"], entry["key"]) == (
        "refused",
        "unauthenticated",
        key_id(key),
    )
    assert key.split("_", 2)[2] not in guarded.audit.read_text()
