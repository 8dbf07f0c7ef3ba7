"""What a change of worker costs: the neighbourhood built, sent and derived for its first frame."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from services.mapping.keyframes.store import KeyframeStore
from services.tracking.config import TrackingConfig
from services.tracking.local_map import derive
from shared import codec
from shared.tracks import TrackingContext

_SAMPLES = 10


@dataclass(frozen=True)
class ColdWorker:
    """Medians over keyframes of the finished map, milliseconds; a warm worker pays none of it.

    `build` is the map's owner's, `wire` packing and unpacking, `derive` the worker's voxels. The
    transport itself is not in it.
    """

    build_ms: float
    wire_ms: float
    derive_ms: float
    context_kb: float


def cold_worker(store: KeyframeStore, config: TrackingConfig) -> ColdWorker:
    """Measure on keyframes from all over the map."""
    seqs = store.seqs()
    _measure(store, seqs[0], config)  # compiles for arrays from the wire
    chosen = seqs[:: max(1, len(seqs) // _SAMPLES)]
    build, wire, derived, size = np.median([_measure(store, s, config) for s in chosen], axis=0)
    return ColdWorker(float(build), float(wire), float(derived), float(size))


def _measure(store: KeyframeStore, seq: int, config: TrackingConfig) -> tuple[float, ...]:
    start = time.perf_counter()
    context = store.context(seq)
    built = time.perf_counter()
    data = codec.pack(context)
    received = codec.unpack(TrackingContext, data)
    sent = time.perf_counter()
    derive(received, config.registration)
    end = time.perf_counter()
    return 1e3 * (built - start), 1e3 * (sent - built), 1e3 * (end - sent), len(data) / 1e3
