"""Who may connect to a router and what they may do there: real zenoh, users, TLS."""

import subprocess
import sys
import threading
import time

import pytest
import zenoh

from benchmarks.local_gateway import free_port
from shared.access import AccessConfig
from shared.bus import Bus, Keys, open_bus, open_router
from shared.errors import ConfigError, GoneError, UnavailableError
from shared.fabric import BusConfig, RouterConfig, client_config
from shared.maps import DeleteRequest, Empty
from shared.service import bus_settings

USERS = ("router", "gateway", "tracker", "mapper", "stranger")
ACCESS = AccessConfig(gateway=("gateway",), tracking=("tracker",), mapping=("mapper",))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("secrets")
    (folder / "users").write_text("".join(f"{user}:secret-{user}\n" for user in USERS))
    for user in USERS:
        (folder / user).write_text(f"secret-{user}\n")
    return folder


def user(folder, name):
    return BusConfig(user=name, password_file=str(folder / name), lease_s=60.0)


@pytest.fixture(scope="module")
def endpoint(folder):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = RouterConfig(
        bus=user(folder, "router"), users_file=str(folder / "users"), access=ACCESS
    )
    router = open_router(endpoint, config)
    yield endpoint
    router.close()


@pytest.fixture(scope="module")
def buses(endpoint, folder):
    buses = {name: open_bus([endpoint], user(folder, name)) for name in USERS[1:]}
    yield buses
    for bus in buses.values():
        bus.close()


def is_answered(bus, key):
    try:
        return bus.query(key, Empty(), Empty, 60.0) == Empty()
    except GoneError:
        return False


def wait_for(condition):
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_each_role_may_do_what_it_needs(buses):
    key = Keys.session("a", 1, "context")
    buses["tracker"].serve(Keys.track("w"), Empty, lambda request: request)
    buses["mapper"].serve(key, Empty, lambda request: request)
    buses["tracker"].declare_alive("tracking", "w")
    heard, alive = [], []
    buses["gateway"].subscribe(Keys.revisions("a"), Empty, heard.append)
    buses["gateway"].watch_alive("tracking", lambda name, is_alive: alive.append(name))

    wait_for(lambda: is_answered(buses["gateway"], Keys.track("w")))
    wait_for(lambda: is_answered(buses["tracker"], key))
    wait_for(lambda: buses["mapper"].publish(Keys.revisions("a"), Empty()) or heard)

    assert alive == ["w"]


def test_who_has_no_rights_is_not_answered(buses):
    buses["tracker"].serve(Keys.track("v"), Empty, lambda request: request)
    wait_for(lambda: is_answered(buses["gateway"], Keys.track("v")))

    assert not is_answered(buses["stranger"], Keys.track("v"))


def test_who_has_no_rights_is_not_heard(buses):
    heard = []
    buses["gateway"].subscribe(Keys.revisions("b"), DeleteRequest, heard.append)
    said = {"stranger": DeleteRequest("forged"), "mapper": DeleteRequest("real")}

    def publish():
        for name, message in said.items():
            buses[name].publish(Keys.revisions("b"), message)
        return heard

    wait_for(publish)
    assert set(heard) == {DeleteRequest("real")}


def test_who_has_no_rights_answers_nobody(buses):
    buses["stranger"].serve(Keys.track("forged"), Empty, lambda request: request)
    buses["tracker"].serve(Keys.track("u"), Empty, lambda request: request)
    wait_for(lambda: is_answered(buses["gateway"], Keys.track("u")))

    assert not is_answered(buses["gateway"], Keys.track("forged"))


@pytest.mark.parametrize("name", ["stranger", "mapper"])
def test_a_worker_token_without_the_right_is_refused_by_name(buses, name):
    with pytest.raises(ConfigError, match=f"user '{name}' not be tracking"):
        buses[name].declare_alive("tracking", "forged")

    assert "forged" not in buses["gateway"].alive("tracking")


def test_a_tracker_may_ask_a_map_only_for_what_it_tracks_with(buses):
    buses["mapper"].serve(Keys.mapper("m", "delete"), Empty, lambda request: request)
    wait_for(lambda: is_answered(buses["gateway"], Keys.mapper("m", "delete")))

    assert not is_answered(buses["tracker"], Keys.mapper("m", "delete"))


@pytest.mark.parametrize("config", [None, "wrong"], ids=["no user", "wrong password"])
def test_who_cannot_say_who_it_is_cannot_connect(endpoint, folder, config):
    if config:
        (folder / "wrong").write_text("guess")
        config = BusConfig(user="gateway", password_file=str(folder / "wrong"))

    with pytest.raises(UnavailableError, match="does not let us in"):
        open_bus([endpoint], config, wait_s=30.0)


def test_a_user_without_a_password_is_a_setting_that_is_missing(monkeypatch):
    monkeypatch.delenv("POINTSLAM_BUS_PASSWORD", raising=False)

    with pytest.raises(ConfigError, match="POINTSLAM_BUS_PASSWORD"):
        client_config(["tcp/127.0.0.1:1"], BusConfig(user="gateway"))


def test_a_password_may_come_from_the_environment(endpoint, monkeypatch):
    monkeypatch.setenv("POINTSLAM_BUS_PASSWORD", "secret-gateway")

    with open_bus([endpoint], BusConfig(user="gateway")) as bus:
        assert isinstance(bus, Bus)


def test_a_service_reads_its_user_from_its_settings_file(tmp_path, folder):
    file = tmp_path / "tracker.yaml"
    file.write_text(
        f"bus:\n  user: tracker\n  password_file: {folder / 'tracker'}\n  lease_s: 60.0\nother: 1\n"
    )

    assert bus_settings(file) == user(folder, "tracker")


def test_an_access_list_of_nobody_in_particular_is_refused():
    with pytest.raises(ConfigError, match="who is who"):
        RouterConfig(access=ACCESS)


def run_openssl(folder, *words):
    subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """A root and certificates that it signed, for localhost, by common name."""
    folder = tmp_path_factory.mktemp("tls")
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1")
    new = ("req", *curve, "-nodes", "-subj")
    run_openssl(folder, *new, "/CN=root", "-x509", "-keyout", "root.key", "-out", "root.pem")
    (folder / "san").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1")
    for name in ("router", "gateway", "stranger"):
        run_openssl(folder, *new, f"/CN={name}", "-keyout", f"{name}.key", "-out", f"{name}.csr")
        sign = ("x509", "-req", "-CA", "root.pem", "-CAkey", "root.key", "-extfile", "san")
        run_openssl(folder, *sign, "-in", f"{name}.csr", "-out", f"{name}.pem")
    return folder


def certified(folder, name):
    root, certificate, key = (
        str(folder / file) for file in ("root.pem", f"{name}.pem", f"{name}.key")
    )
    return BusConfig(root_certificate=root, certificate=certificate, private_key=key)


@pytest.fixture(scope="module")
def tls_endpoint(certificates):
    endpoint = f"tls/localhost:{free_port()}"
    access = AccessConfig(gateway=("gateway",))
    router = open_router(
        endpoint, RouterConfig(bus=certified(certificates, "router"), access=access)
    )
    yield endpoint
    router.close()


def test_a_certificate_says_who_may_do_what(tls_endpoint, certificates):
    with (
        open_bus([tls_endpoint], certified(certificates, "gateway")) as bus,
        open_bus([tls_endpoint], certified(certificates, "stranger")) as stranger,
    ):
        heard = threading.Event()
        bus.watch_alive("tracking", lambda *_: heard.set())

        with pytest.raises(ConfigError, match=r"stranger.pem not be tracking"):
            stranger.declare_alive("tracking", "forged")
        assert not heard.is_set()


def test_without_a_certificate_nobody_connects_over_tls(tls_endpoint, certificates):
    anonymous = BusConfig(root_certificate=str(certificates / "root.pem"))

    with pytest.raises(UnavailableError, match="does not let us in"):
        open_bus([tls_endpoint], anonymous)


def test_a_certificate_without_its_key_is_refused():
    with pytest.raises(ConfigError, match="belong together"):
        BusConfig(certificate="gateway.pem")


def test_scouting_and_shared_memory_are_off_and_messages_bounded():
    config = client_config(["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"], BusConfig())

    told = {
        key: config.get_json(key)
        for key in (
            "scouting/multicast/enabled",
            "scouting/gossip/enabled",
            "transport/shared_memory/enabled",
            "transport/link/tx/lease",
            "transport/link/rx/max_message_size",
            "listen/endpoints",
        )
    }
    assert list(told.values()) == ["false", "false", "false", "2000", str(256 << 20), "[]"]


def test_bulk_comes_after_what_a_camera_waits_for():
    order = [Keys.priority(Keys.session("a", 1, q)) for q in ("context", "advance", "export")]

    assert order == [zenoh.Priority.DATA_HIGH, zenoh.Priority.DATA, zenoh.Priority.BACKGROUND]


def test_an_answer_has_the_priority_of_its_question(buses):
    key = Keys.session("c", 1, "export")
    buses["mapper"].serve(key, Empty, lambda request: request)
    wait_for(lambda: is_answered(buses["gateway"], key))

    replies = buses["gateway"]._session.get(key, payload=b"\x80", priority=Keys.priority(key))

    assert [reply.ok.priority for reply in replies] == [zenoh.Priority.BACKGROUND]


def test_a_service_goes_on_over_the_second_router_when_the_first_ends():
    endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
    second = open_router(endpoints[1])
    first = open_router(endpoints[0], RouterConfig(routers=(endpoints[1],)))
    with open_bus(endpoints) as bus, open_bus([endpoints[1]]) as other:
        other.serve("ps/v1/track/w/frame", Empty, lambda request: request)
        wait_for(lambda: is_answered(bus, "ps/v1/track/w/frame"))

        first.close()

        wait_for(lambda: is_answered(bus, "ps/v1/track/w/frame"))
    second.close()


def test_a_router_process_reads_users_and_rights_from_its_file(folder, tmp_path):
    endpoint, file = f"tcp/127.0.0.1:{free_port()}", tmp_path / "router.yaml"
    file.write_text(
        f"listen: [{endpoint}]\nusers_file: {folder / 'users'}\n"
        f"bus: {{user: router, password_file: {folder / 'router'}}}\n"
        "access: {gateway: [gateway]}\n"
    )
    command = [sys.executable, "-m", "pointslam.router", "--config", str(file)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline().startswith("READY")
        with open_bus([endpoint], user(folder, "gateway")) as bus:
            assert bus.alive("tracking") == set()
        with pytest.raises(UnavailableError, match="does not let us in"):
            open_bus([endpoint])
    finally:
        process.terminate()
        process.communicate(timeout=60)
