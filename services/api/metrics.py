"""Measurements for Prometheus: requests of this service, and what the processes report."""

import time
from collections.abc import Iterable
from typing import Protocol

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deltalight.services.api.events import EventHub
from deltalight.services.api.live_hub import LiveHub
from deltalight.services.api.problems import Problems
from deltalight.services.api.streams import ProcessWatch

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
# From a read out of the cache to a mesh that reaches the time limit of its check.
_SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 5, 20, 60)
NO_OPERATION = "none"  # refused before a route was found


class Reachable(Protocol):
    """Knows whether the render server answers."""

    @property
    def is_reachable(self) -> bool:
        """Whether it answered the last request."""


class Metrics:
    """The measurements of one application."""

    def __init__(
        self, problems: Problems, watch: ProcessWatch, link: Reachable, live: LiveHub, events: EventHub
    ) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        self._requests = Counter(
            "deltalight_api_requests", "Requests answered.", ("operation", "status"), registry=self._registry
        )
        self._seconds = Histogram(
            "deltalight_api_request_seconds",
            "Time from the head of a request to the end of its response, seconds.",
            ("operation",),
            buckets=_SECONDS,
            registry=self._registry,
        )
        self._registry.register(_Reported(problems, watch, link))
        self._registry.register(_Streams(live, events))

    def note(self, scope: Scope, status: int, seconds: float) -> None:
        """Counts a completed request."""
        # Not by address, because that would make the labels unbounded.
        operation = getattr(scope.get("route"), "name", NO_OPERATION)
        self._requests.labels(operation, status).inc()
        self._seconds.labels(operation).observe(seconds)

    def text(self) -> bytes:
        """Returns all measurements in the text format of Prometheus."""
        return generate_latest(self._registry)


class MetricsMiddleware:
    """Middleware that measures every request, including refused ones."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on and records how it ended."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began_s, status = time.perf_counter(), 500

        async def noting(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            self._metrics.note(scope, status, time.perf_counter() - began_s)


class _Reported(Collector):
    """Collects the counts of other parts of the service."""

    def __init__(self, problems: Problems, watch: ProcessWatch, link: Reachable) -> None:
        self._problems = problems
        self._watch = watch
        self._link = link

    def collect(self) -> Iterable[Metric]:
        """Returns all metric families."""
        refused = CounterMetricFamily(
            "deltalight_api_refused", "Refused requests, by kind of problem.", labels=["kind"]
        )
        for kind, count in self._problems.counts.copy().items():
            refused.add_metric([kind], count)
        answers = GaugeMetricFamily("deltalight_render_server_answers", "1 = the render server responds.")
        answers.add_metric([], float(self._link.is_reachable))
        return [refused, answers, *self._processes()]

    def _processes(self) -> Iterable[Metric]:
        age = GaugeMetricFamily(
            "deltalight_process_report_age_seconds", "Age of a process's newest report.", labels=["process"]
        )
        rate = GaugeMetricFamily(
            "deltalight_process_rate", "Rates reported by a process, 1/s.", labels=["process", "rate"]
        )
        drops = CounterMetricFamily(
            "deltalight_process_drops", "Losses of a process, by cause.", labels=["process", "cause"]
        )
        degraded = CounterMetricFamily(
            "deltalight_process_degraded", "How often a process became degraded.", labels=["process"]
        )
        for report in self._watch.reports():
            process = report.message.node
            degraded.add_metric([process], report.degraded)
            age.add_metric([process], report.age_s)
            for name, value in report.message.rates.items():
                rate.add_metric([process, name], value)
            for cause, count in report.lost.items():
                drops.add_metric([process, cause], count)
        return [age, rate, drops, degraded]


class _Streams(Collector):
    """Collects the numbers of viewers and listeners, and of frames and events sent to them."""

    def __init__(self, live: LiveHub, events: EventHub) -> None:
        self._live = live
        self._events = events

    def collect(self) -> Iterable[Metric]:
        """Returns all metric families."""
        live = self._live
        yield _gauge("deltalight_live_viewers", "Viewers of the live video.", live.viewers)
        yield _gauge("deltalight_live_encoders", "Views being encoded as H.264.", live.video.encoders)
        yield _counter("deltalight_live_frames_received", "Composites that came.", live.received)
        yield _counter("deltalight_live_frames_sent", "Frames sent, to all viewers together.", live.sent)
        yield _counter(
            "deltalight_live_frames_skipped", "Frames skipped because viewers were too slow.", live.skipped
        )
        yield _gauge("deltalight_event_listeners", "Clients subscribed to events.", self._events.listeners)
        since_s = live.state()[1]
        if since_s is not None:
            text = "Time since the newest composite arrived, seconds."
            yield _gauge("deltalight_live_frame_age_seconds", text, since_s)


def _gauge(name: str, text: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, text, value=value)


def _counter(name: str, text: str, value: float) -> CounterMetricFamily:
    return CounterMetricFamily(name, text, value=value)
