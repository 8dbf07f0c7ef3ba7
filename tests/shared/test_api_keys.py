"""API keys: told once, kept as hashes, gone when revoked."""

import sqlite3
import stat
import time

import pytest

from pointslam.keys import main
from shared.api_keys import KeyStore, NewKey, Scope, key_id
from shared.errors import ConfigError, InputError, NotFoundError, StorageError


@pytest.fixture
def file(tmp_path):
    return tmp_path / "keys.sqlite"


@pytest.fixture
def store(file):
    return KeyStore.open(file)


def test_a_key_is_found_with_its_tenant_and_scopes(store):
    text = store.create(NewKey("acme", frozenset({Scope.POSE}), "robot 7"))

    record = store.find(text)

    assert record is not None
    assert (record.tenant, record.scopes, record.label) == ("acme", {Scope.POSE}, "robot 7")
    assert record.refusal(time.time()) is None
    assert record.id == key_id(text)


@pytest.mark.parametrize("days", ["nan", "inf", "1e12", "0"])
def test_a_life_that_no_calendar_holds_is_refused(file, days, capsys):
    KeyStore.open(file).create(NewKey())

    refused = main(["create", "--store", str(file), "--days", days])
    listed = main(["list", "--store", str(file)])

    assert (refused, listed) == (2, 0)
    assert "expires_s: must lie in the future" in capsys.readouterr().err


def test_a_key_has_256_random_bits_and_another_each_time(store):
    texts = {store.create(NewKey()) for _ in range(20)}

    assert len(texts) == 20
    assert all(len(text.split("_", 2)[2]) == 43 for text in texts)


@pytest.mark.parametrize("spoil", [lambda t: t[:-1] + "!", lambda t: "ps_000000000000" + t[15:]])
def test_a_key_that_differs_in_one_part_is_unknown(store, spoil):
    text = store.create(NewKey())

    assert store.find(spoil(text)) is None


def test_another_keys_secret_does_not_fit(store):
    one, other = store.create(NewKey()), store.create(NewKey())

    assert store.find(one[:16] + other[16:]) is None


def test_the_file_holds_no_key_and_is_its_owners_alone(store, file):
    secret = store.create(NewKey()).split("_", 2)[2]

    assert secret.encode() not in file.read_bytes()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_key_ends_when_its_time_is_over(store):
    text = store.create(NewKey(expires_s=time.time() + 60))
    record = store.find(text)

    assert record is not None
    assert record.refusal(time.time() + 61) == "expired"


def test_a_revoked_key_is_refused_by_a_store_that_was_open_before(store, file):
    text = store.create(NewKey())
    reader = KeyStore.open_to_read(file)

    store.revoke(str(key_id(text)))

    record = reader.find(text)
    assert record is not None and record.refusal(time.time()) == "revoked"


def test_a_store_that_is_read_cannot_be_written(store, file):
    with pytest.raises(StorageError):
        KeyStore.open_to_read(file).create(NewKey())


def test_a_missing_store_says_how_one_is_made(file):
    with pytest.raises(ConfigError, match="pointslam keys create --store"):
        KeyStore.open_to_read(file)


def test_a_file_that_is_no_store_is_refused(file):
    file.write_text("hello" * 1000)

    with pytest.raises(StorageError):
        KeyStore.open_to_read(file)


@pytest.mark.parametrize(
    ("new", "field"),
    [
        (NewKey("a.b"), "tenant"),
        (NewKey(""), "tenant"),
        (NewKey(scopes=frozenset()), "scopes"),
        (NewKey(expires_s=1.0), "expires_s"),
    ],
)
def test_a_key_that_cannot_be_is_refused_by_field(store, new, field):
    with pytest.raises(InputError) as refused:
        store.create(new)

    assert refused.value.field == field


def test_an_unknown_key_cannot_be_revoked(store):
    with pytest.raises(NotFoundError):
        store.revoke("000000000000")


def test_the_commands_make_list_and_revoke(file, capsys):
    words = ["--store", str(file)]
    assert (
        main(["create", "--tenant", "acme", "--scopes", "ingest,pose", "--days", "1", *words]) == 0
    )
    text = capsys.readouterr().out.strip()
    id = str(key_id(text))

    assert main(["revoke", id, *words]) == 0
    assert main(["list", *words]) == 0

    told = capsys.readouterr().out
    assert f"{id}  acme    ingest,pose" in told and "revoked" in told
    assert text not in told


@pytest.mark.parametrize("words", [["create", "--scopes", "all"], ["revoke", "000000000000"]])
def test_a_command_that_cannot_be_met_says_why_in_one_line(file, capsys, words):
    assert main([*words, "--store", str(file)]) == 2

    assert capsys.readouterr().err.startswith("error: ")


def test_the_columns_hold_what_they_say(store, file):
    store.create(NewKey("acme", frozenset({Scope.ADMIN, Scope.INGEST})))

    row = (
        sqlite3.connect(file).execute("SELECT tenant, scopes, length(digest) FROM keys").fetchone()
    )

    assert row == ("acme", "admin ingest", 32)
