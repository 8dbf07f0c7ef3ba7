"""What a mapper counts, and the state of its open sessions when Prometheus asks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from prometheus_client import REGISTRY
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from shared.maps import MapInfo
from shared.metrics import seconds

LOG_SECONDS = seconds("log_append_seconds", "Time to write a log entry; keyframes reach the disk")
SNAPSHOT_SECONDS = seconds("snapshot_seconds", "Time to write a snapshot")

_GAUGES: tuple[tuple[str, str, Callable[[MapInfo], float]], ...] = (
    ("map_epoch", "Grows with every change of owner", lambda info: info.epoch),
    ("map_keyframes", "Keyframes", lambda info: info.keyframes),
    ("map_anchors", "Anchors", lambda info: info.primary_anchors + info.secondary_anchors),
    ("map_iterations", "Iterations of the optimization", lambda info: info.iterations),
    ("map_pending", "Log entries not yet worked through", lambda info: info.pending),
    ("map_bytes", "Anchors and networks", lambda info: info.map_bytes),
)


class SessionCollector(Collector):
    """One gauge a figure, labelled by session: as many as may be open, so bounded."""

    def __init__(self, infos: Callable[[], Iterable[MapInfo]]) -> None:
        self._infos = infos
        REGISTRY.register(self)

    def describe(self) -> Iterator[Metric]:
        """The families without values: registering must not visit a map."""
        for name, text, _ in _GAUGES:
            yield GaugeMetricFamily(f"pointslam_{name}", text, labels=("session",))
        yield _stages(())

    def collect(self) -> Iterator[Metric]:
        """The figures of every open session."""
        infos = list(self._infos())
        for name, text, value in _GAUGES:
            family = GaugeMetricFamily(f"pointslam_{name}", text, labels=("session",))
            for info in infos:
                family.add_metric((info.session,), float(value(info)))
            yield family
        yield _stages(infos)


def _stages(infos: Iterable[MapInfo]) -> Metric:
    labels = ("session", "stage")
    text = "Median time of a step of the optimization by stage"
    family = GaugeMetricFamily("pointslam_map_stage_seconds", text, labels=labels)
    for info in infos:
        for stage, milliseconds in info.stages_ms.items():
            family.add_metric((info.session, stage), milliseconds / 1e3)
    return family
