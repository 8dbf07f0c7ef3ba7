"""What cannot be started is refused before anything is."""

from pathlib import Path

import pytest

from pointslam.launcher import Access, LaunchOptions
from pointslam.settings import read_settings
from shared.errors import ConfigError


@pytest.mark.parametrize(
    "change", [{"num_trackers": 0}, {"num_mappers": 0}, {"http_port": 99999}, {"grpc_port": -1}]
)
def test_impossible_services_are_refused(change):
    with pytest.raises(ConfigError):
        LaunchOptions(Path("data"), Path("logs"), **change)


@pytest.mark.parametrize(
    ("access", "words", "expected"),
    [
        (Access(), (), ("--insecure-local",)),
        (Access(keys=Path("keys.db")), (), ("--keys", "keys.db")),
        (Access(), ("gateway.access.jwt.key_file=issuer.pem",), ()),
        (Access(), ("gateway.access.jwt.issuer=somebody",), ("--insecure-local",)),
    ],
)
def test_everybody_is_let_in_only_where_nobody_could_show_a_key_or_a_token(access, words, expected):
    settings = read_settings(None, words).services

    assert access.arguments(settings) == expected


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", "http://127.0.0.1:80"),
        ("::1", "http://[::1]:80"),
        ("0.0.0.0", "http://127.0.0.1:80"),
        ("::", "http://127.0.0.1:80"),
    ],
)
def test_a_gateway_is_found_at_an_address_of_this_machine(host, expected):
    assert Access(host).url(80) == expected
