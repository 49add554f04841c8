"""A collector that reads OTLP with OpenTelemetry's own messages, and says when it has seen what it waits for.

Prints its address on the first line, and "ok" once it had metrics of a loop and the spans of an upload and of a change. Whoever
started it ends it.
"""

from http.server import BaseHTTPRequestHandler, HTTPServer

from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

WANTED = {"upload", "compile", "trial", "keep", "change", "try", "make ready", "switch", "POST /v1/components", "PUT /v1/loops/{name}"}
spans: dict[str, object] = {}
metrics: dict[str, object] = {}


def text(value) -> str:
    return value.string_value


class Collector(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        assert self.headers["content-type"] == "application/x-protobuf", self.headers
        assert self.headers["api-key"] == "secret", self.headers
        body = self.rfile.read(int(self.headers["content-length"]))
        if self.path == "/v1/traces":
            for of in ExportTraceServiceRequest.FromString(body).resource_spans:
                names = {one.key: text(one.value) for one in of.resource.attributes}
                assert names["service.name"] == "bumpless" and names["host.name"] == "plant", names
                for scope in of.scope_spans:
                    for span in scope.spans:
                        assert span.end_time_unix_nano >= span.start_time_unix_nano > 0, span
                        spans[span.name] = span
        elif self.path == "/v1/metrics":
            for of in ExportMetricsServiceRequest.FromString(body).resource_metrics:
                for scope in of.scope_metrics:
                    metrics.update((metric.name, metric) for metric in scope.metrics)
        else:
            raise AssertionError(self.path)
        self.send_response(200)
        self.end_headers()
        look()

    def log_message(self, *_) -> None:
        pass


told = False


def look() -> None:
    global told
    step = metrics.get("bumpless_loop_step_seconds")
    if told or not WANTED <= spans.keys() or step is None:
        return
    points = [p for p in step.histogram.data_points if {a.key: text(a.value) for a in p.attributes} == {"loop": "loop-0"}]
    if not points:
        return
    assert step.unit == "s" and sum(points[0].bucket_counts) == points[0].count, points
    assert len(points[0].bucket_counts) == len(points[0].explicit_bounds) + 1, points
    taken = metrics["bumpless_cycles_taken"].sum
    assert taken.is_monotonic and taken.aggregation_temporality == 2, taken
    # Parts lie within their whole, in one trace.
    for part, whole in (("compile", "upload"), ("trial", "upload"), ("switch", "change")):
        assert spans[part].trace_id == spans[whole].trace_id, (part, whole)
    told = True
    print("ok", flush=True)


server = HTTPServer(("127.0.0.1", 0), Collector)
print(f"http://127.0.0.1:{server.server_port}", flush=True)
server.serve_forever()
