"""Reads /metrics with Prometheus' own parser of OpenMetrics, and holds names, units and labels to its conventions.

Called with the address of an API. Ends with 0 and "ok" on the last line.
"""

import sys
from urllib.request import urlopen

from prometheus_client.openmetrics.parser import text_string_to_metric_families

answer = urlopen(f"{sys.argv[1]}/metrics", timeout=20)
assert answer.headers["Content-Type"].startswith("application/openmetrics-text; version=1.0.0"), answer.headers
families = list(text_string_to_metric_families(answer.read().decode()))
assert len(families) > 30, len(families)
wrong = []
for family in families:
    name = family.name
    if not name.startswith("bumpless_"):
        wrong.append(f"{name}: no prefix")
    if not family.documentation:
        wrong.append(f"{name}: no help")
    if family.unit and not name.endswith("_" + family.unit):
        wrong.append(f"{name}: unit {family.unit} is not at its end")
    if family.type == "histogram" and family.unit != "seconds":
        wrong.append(f"{name}: a histogram of {family.unit or 'nothing'}")
    if family.type not in ("counter", "gauge", "histogram", "info"):
        wrong.append(f"{name}: {family.type}")
    if any(part in name.split("_") for part in ("ms", "us", "ns", "percent", "mb", "kb", "minutes", "hours")):
        wrong.append(f"{name}: base units only")
    for sample in family.samples:
        labels = set(sample.labels) - {"le"}
        if labels - {"loop", "host", "event", "method", "status", "route", "version"}:
            wrong.append(f"{sample.name}: labels {sorted(labels)}")
assert not wrong, "\n".join(wrong)
by_name = {family.name: family for family in families}
for name in ("bumpless_loop_step_seconds", "bumpless_loop_jitter_seconds", "bumpless_loop_commit_seconds"):
    counts = [s.value for s in by_name[name].samples if s.name == f"{name}_count" and s.labels == {"loop": "loop-0"}]
    assert counts and counts[0] >= 5, (name, counts)
print(len(families), "families")
print("ok")
