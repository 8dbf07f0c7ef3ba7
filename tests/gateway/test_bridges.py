"""A recording streamed to a gateway as a camera would be."""

from __future__ import annotations

import pytest

from pointslam.bridges import RecordedSource, StreamRequest, stream_source
from pointslam.client import Client
from pointslam.datasets import open_sequence
from pointslam.synth import Noise, SynthOptions, write_sequence
from shared.camera import Intrinsics


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bridge") / "room"
    camera = Intrinsics(65.0, 65.0, 31.5, 23.5, 64, 48)
    options = SynthOptions(num_frames=30, num_views=0, noise=Noise.NONE, camera=camera)
    write_sequence(folder, options, lambda done: None)
    return open_sequence(folder)


def test_a_recording_becomes_a_session(gateway, recording):
    name = stream_source(RecordedSource(recording), StreamRequest(gateway.url, "bridged"), print)

    with Client(gateway.url) as client:
        assert client.session(name).info()["tracking"]["last_seq"] == len(recording) - 1


def test_a_session_of_that_name_is_gone_on_with(gateway, recording):
    request = StreamRequest(gateway.url, "twice")
    stream_source(RecordedSource(recording), request, print)
    with Client(gateway.url) as client:
        before = client.session("twice").next_seq

    stream_source(_Later(recording), request, print)

    with Client(gateway.url) as client:
        assert client.session("twice").next_seq == 2 * before


class _Later(RecordedSource):
    """The same again, with a clock that went on."""

    def frames(self):
        for frame in super().frames():
            yield type(frame)(frame.t_ns + 10_000_000_000, frame.rgb, frame.depth)


def test_what_is_streamed_can_be_recorded(gateway, recording, tmp_path):
    path = tmp_path / "kept.mcap"

    stream_source(RecordedSource(recording), StreamRequest(gateway.url, record=path), print)

    assert len(open_sequence(path)) == len(recording)
