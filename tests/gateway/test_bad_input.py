"""Bad input over the real network: the error names the field and the session goes on."""

import dataclasses
import json
import socket
import struct
import zlib
from urllib.parse import urlsplit

import httpx
import msgpack
import numpy as np
import pytest

from benchmarks.cluster import wait_for
from benchmarks.local_gateway import free_port, gateway_process
from pointslam.client import Client
from pointslam.client.frame_stream import open_stream
from shared import codec, images
from shared.errors import NotFoundError
from shared.frames import ColourEncoding, ColourImage, DepthEncoding, TrackingStatus
from shared.stream import DepthMessage, FrameReply

SECOND = 1_000_000_000
LIMIT_BYTES = 32 << 20


@pytest.fixture
def good(offline, rgb, depth):
    return offline.frame(rgb, depth, SECOND)


def post(gateway, session, data):
    return httpx.post(f"{gateway.url}/v1/sessions/{session.name}/frames", content=data)


def png_header(width, height, bit_depth, colour_type):
    head = struct.pack(">IIBBBBB", width, height, bit_depth, colour_type, 0, 0, 0)
    chunk = b"IHDR" + head
    crc = struct.pack(">I", zlib.crc32(chunk))
    end = struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + crc + bytes(32) + end


def jpeg_header(width, height):
    return b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", height, width) + b"\x03\xff\xd9"


def with_rgb(message, encoding, data):
    return dataclasses.replace(message, rgb=ColourImage(encoding, data))


def with_depth(message, encoding, data, scale=None):
    return dataclasses.replace(message, depth=DepthMessage(encoding, data, scale))


def truncated_jpeg(message):
    return with_rgb(message, ColourEncoding.JPEG, message.rgb.bytes[:-400])


def deep_colour_png(message):
    deep = images.encode_png(np.zeros((48, 64), np.uint16))
    return with_rgb(message, ColourEncoding.PNG, deep)


def shallow_depth_png(message):
    shallow = images.encode_png(np.zeros((48, 64), np.uint8))
    return with_depth(message, DepthEncoding.PNG16, shallow)


def small_depth_png(message):
    small = images.encode_png(np.zeros((24, 32), np.uint16))
    return with_depth(message, DepthEncoding.PNG16, small)


def huge_jpeg(message):
    return with_rgb(message, ColourEncoding.JPEG, jpeg_header(60000, 60000))


def huge_colour_png(message):
    return with_rgb(message, ColourEncoding.PNG, png_header(60000, 60000, 8, 2))


def huge_depth_png(message):
    return with_depth(message, DepthEncoding.PNG16, png_header(60000, 60000, 16, 0))


BAD_FRAMES = {
    "truncated JPEG": (truncated_jpeg, "rgb.bytes", "truncated JPEG"),
    "no JPEG": (lambda m: with_rgb(m, ColourEncoding.JPEG, b"hello"), "rgb.bytes", "JPEG"),
    "JPEG without a frame": (
        lambda m: with_rgb(m, ColourEncoding.JPEG, b"\xff\xd8" + bytes(20)),
        "rgb.bytes",
        "without a frame header",
    ),
    "empty image": (lambda m: with_rgb(m, ColourEncoding.PNG, b""), "rgb.bytes", "PNG"),
    "16 bit colour PNG": (deep_colour_png, "rgb.bytes", "8 bit"),
    "8 bit depth PNG": (shallow_depth_png, "depth.bytes", "16 bit"),
    "depth of another size": (small_depth_png, "depth.bytes", "32x24"),
    "raw depth of another size": (
        lambda m: with_depth(m, DepthEncoding.RAW16, bytes(100)),
        "depth.bytes",
        "6144 bytes",
    ),
    "raw colour of another size": (
        lambda m: with_rgb(m, ColourEncoding.RGB8, bytes(100)),
        "rgb.bytes",
        "9216 bytes",
    ),
    "too much zlib": (
        lambda m: with_depth(m, DepthEncoding.ZLIB16, bytes(7000)),
        "depth.bytes",
        "zlib",
    ),
    "60000x60000 JPEG": (huge_jpeg, "rgb.bytes", "60000x60000"),
    "60000x60000 PNG": (huge_colour_png, "rgb.bytes", "60000x60000"),
    "60000x60000 depth": (huge_depth_png, "depth.bytes", "60000x60000"),
    "another depth scale": (
        lambda m: with_depth(m, m.depth.encoding, m.depth.bytes, 5000.0),
        "depth.scale",
        "1000",
    ),
    "unknown flag": (lambda m: dataclasses.replace(m, flags=("fly",)), "flags", "no_keyframe"),
    "negative seq": (lambda m: dataclasses.replace(m, seq=-1), "seq", "must be 0 to"),
    "seq beyond its bits": (lambda m: dataclasses.replace(m, seq=1 << 60), "seq", "must be 0 to"),
    "time beyond int64": (lambda m: dataclasses.replace(m, t_ns=1 << 63), "t_ns", "must be 0 to"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_bad_frame_is_refused_by_field_and_the_session_goes_on(gateway, offline, good, case):
    spoil, field, reason = BAD_FRAMES[case]

    response = post(gateway, offline, codec.pack(spoil(good)))

    problem = response.json()
    assert (response.status_code, problem["field"]) == (422, field)
    assert reason in problem["reason"]
    assert post(gateway, offline, codec.pack(good)).status_code == 200


def nested(depth):
    value = {"seq": 1}
    for _ in range(depth):
        value = {"prior": value}
    return value


def test_msgpack_with_extra_nesting_is_refused(gateway, offline, good):
    plain = codec.to_plain(good) | {"depth": nested(3)}

    problem = post(gateway, offline, msgpack.packb(plain)).json()

    assert problem["field"] == "depth.prior"
    assert "unknown field" in problem["reason"]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x81" * 5000,
        b"\xdf\xff\xff\xff\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\xc7\x05\x01hello",
        msgpack.packb(nested(400)),
    ],
    ids=["empty", "reserved", "bottomless", "huge map", "huge list", "bad array", "deep"],
)
def test_bytes_that_are_no_frame_are_refused(gateway, offline, good, data):
    response = post(gateway, offline, data)

    assert response.status_code in (400, 422)
    assert response.json()["code"] == "invalid_input"
    assert post(gateway, offline, codec.pack(good)).status_code == 200


def test_a_damaged_image_with_a_good_header_is_refused_by_the_tracker(
    gateway, offline, good, trackers
):
    for tracker in trackers:
        tracker.decodes = True
    damaged = with_depth(good, DepthEncoding.PNG16, png_header(64, 48, 16, 0))

    problem = post(gateway, offline, codec.pack(damaged)).json()

    assert (problem["code"], problem["field"]) == ("invalid_input", "depth.bytes")
    assert post(gateway, offline, codec.pack(good)).status_code == 200


@pytest.mark.parametrize(("number", "field"), [("seq", "seq"), ("t_ns", "t_ns")])
def test_a_repeated_frame_is_a_conflict(gateway, offline, good, number, field):
    post(gateway, offline, codec.pack(good))
    again = dataclasses.replace(good, seq=5, t_ns=5 * SECOND)
    again = dataclasses.replace(again, **{number: getattr(good, number)})

    response = post(gateway, offline, codec.pack(again))

    assert (response.status_code, response.json()["field"]) == (409, field)
    next_one = dataclasses.replace(good, seq=6, t_ns=6 * SECOND)
    assert post(gateway, offline, codec.pack(next_one)).status_code == 200


def test_a_frame_out_of_order_is_a_conflict(gateway, offline, good):
    post(gateway, offline, codec.pack(dataclasses.replace(good, seq=9, t_ns=9 * SECOND)))

    response = post(gateway, offline, codec.pack(good))

    assert (response.status_code, response.json()["code"]) == (409, "conflict")


@pytest.mark.parametrize("rest", ["", "/pose", "/render", "/trajectory", "/map.ply"])
def test_an_unknown_session_is_not_found(gateway, rest):
    response = httpx.get(f"{gateway.url}/v1/sessions/nobody{rest}")

    assert (response.status_code, response.json()["code"]) == (404, "not_found")


def test_a_stream_of_an_unknown_session_is_not_found(gateway):
    url = gateway.url.replace("http", "ws") + "/v1/sessions/nobody/stream"

    with pytest.raises(NotFoundError, match="nobody"), open_stream(url):
        pass


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"fx": float("nan")}, "calibration.colour.fx"),
        ({"fy": -525.0}, "calibration.colour.fy"),
        ({"cx": float("inf")}, "calibration.colour.cx"),
        ({"width": 60000}, "calibration.colour.width"),
        ({"height": 0}, "calibration.colour.height"),
    ],
)
def test_impossible_intrinsics_are_refused_by_field(gateway, calibration, change, field):
    body = {"calibration": codec.to_json(calibration)}
    body["calibration"]["colour"]["intrinsics"].update(change)

    response = httpx.post(gateway.url + "/v1/sessions", content=json.dumps(body))

    assert (response.status_code, response.json()["field"]) == (422, field)


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ("{", None),
        ("[]", None),
        ("{}", "calibration"),
        ('{"calibration": {}, "colour": 1}', "colour"),
        ("[" * 100_000, None),
    ],
)
def test_a_session_of_nonsense_is_refused(gateway, body, field):
    response = httpx.post(gateway.url + "/v1/sessions", content=body)

    assert response.status_code in (400, 422)
    assert field is None or response.json()["field"] == field


@pytest.mark.parametrize("change", [{"name": "../etc"}, {"mode": "fast"}, {"seed": -1}])
def test_a_session_with_a_bad_option_is_refused(gateway, calibration, change):
    body = {"calibration": codec.to_json(calibration)} | change

    response = httpx.post(gateway.url + "/v1/sessions", json=body)

    assert (response.status_code, response.json()["field"]) == (422, next(iter(change)))


def test_a_body_over_the_limit_is_too_large(gateway, offline):
    response = post(gateway, offline, bytes(LIMIT_BYTES + 1))

    assert (response.status_code, response.json()["code"]) == (413, "too_large")


def test_a_message_longer_than_its_images_can_be_is_too_large(gateway, offline):
    response = post(gateway, offline, msgpack.packb([{}] * 100_000))

    assert (response.status_code, response.json()["code"]) == (413, "too_large")


def test_a_body_that_grows_over_the_limit_is_too_large(gateway, offline):
    pieces = (bytes(1 << 20) for _ in range(40))

    response = httpx.post(
        f"{gateway.url}/v1/sessions/{offline.name}/frames", content=pieces, timeout=60
    )

    assert response.status_code == 413


def raw_connection(gateway):
    parts = urlsplit(gateway.url)
    return socket.create_connection((parts.hostname, parts.port), timeout=60)


def test_a_client_that_disconnects_in_the_middle_of_a_post_hurts_nobody(gateway, offline, good):
    data = codec.pack(good)
    with raw_connection(gateway) as connection:
        head = f"POST /v1/sessions/{offline.name}/frames HTTP/1.1\r\nHost: localhost\r\n"
        connection.sendall(head.encode() + f"Content-Length: {len(data)}\r\n\r\n".encode())
        connection.sendall(data[:100])

    assert post(gateway, offline, data).status_code == 200


def test_a_client_that_disconnects_in_the_middle_of_a_stream_hurts_nobody(
    gateway, offline, good, trackers
):
    for tracker in trackers:
        tracker.delay_s = 0.2
    data = codec.pack(good)
    url = f"{gateway.url.replace('http', 'ws')}/v1/sessions/{offline.name}/stream"
    with open_stream(url) as connection:
        connection.send(data)
        connection.socket.shutdown(socket.SHUT_RDWR)
    wait_for(lambda: offline.info()["tracking"]["last_seq"] == 0)

    response = post(gateway, offline, codec.pack(dataclasses.replace(good, seq=1, t_ns=2 * SECOND)))

    assert response.status_code == 200
    assert codec.unpack(FrameReply, response.content).status is TrackingStatus.TRACKED


@pytest.fixture
def impatient(gateway):
    """A client of another gateway, which does not wait long for who does not read."""
    ports = (free_port(), free_port())
    settings = ("stream.send_timeout_s=1.0", "stream.unread_s=5.0")
    with (
        gateway_process(gateway.router, ports, *settings),
        Client(f"http://127.0.0.1:{ports[0]}") as client,
    ):
        wait_for(client.ready)
        yield client


def test_a_client_that_never_reads_is_cut_off_and_the_session_goes_on(impatient, offline, good):
    request = (
        f"GET /v1/sessions/{offline.name}/stream HTTP/1.1\r\nHost: localhost\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    nonsense = b"\x82\x81" + bytes(4) + b"\xc1"  # one masked binary message each
    with raw_connection(impatient) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        connection.sendall(request.encode())
        connection.settimeout(60.0)  # of a send; then the gateway has not cut us off
        with pytest.raises(ConnectionError):
            while True:
                connection.sendall(nonsense * 1000)

    assert post(impatient, offline, codec.pack(good)).status_code == 200


def receive(connection):
    data = connection.recv()
    assert isinstance(data, bytes)
    return codec.unpack(FrameReply, data)


def test_a_text_message_on_the_stream_is_refused_and_the_stream_goes_on(gateway, offline, good):
    url = f"{gateway.url.replace('http', 'ws')}/v1/sessions/{offline.name}/stream"
    with open_stream(url) as connection:
        connection.send("hello")
        refused = receive(connection)
        connection.send(codec.pack(good))

        answered = receive(connection)

    assert refused.error is not None
    assert (refused.error.field, refused.error.reason) == ("message", "must be a binary message")
    assert answered.status is TrackingStatus.TRACKED


def test_json_beyond_any_of_our_requests_is_refused_before_it_is_parsed(gateway):
    body = b"[" * (5 << 20)

    answer = httpx.post(f"{gateway.url}/v1/sessions", content=body)

    assert answer.status_code == 413
    assert "bytes of JSON" in answer.text
