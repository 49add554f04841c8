//! From families of metrics to the messages of OTLP.
//!
//! Counters are cumulative sums since the process began, histograms cumulative with the same bounds, gauges as they are. Units are
//! those of UCUM that the semantic conventions ask for. Never: drops a label or changes a name.

use opentelemetry_proto::tonic::{
    collector::metrics::v1::ExportMetricsServiceRequest,
    common::v1::{AnyValue, InstrumentationScope, KeyValue, any_value},
    metrics::v1::{
        AggregationTemporality, Gauge, Histogram, HistogramDataPoint, Metric, NumberDataPoint, ResourceMetrics,
        ScopeMetrics, Sum, metric, number_data_point,
    },
    resource::v1::Resource,
};

use crate::{
    Identity,
    open_metrics::{Family, Kind, Labels},
};

/// When the numbers were read, and since when they count, in ns of Unix time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Times {
    pub(crate) began_ns: u64,
    pub(crate) now_ns: u64,
}

fn attribute(key: &str, value: &str) -> KeyValue {
    KeyValue {
        key: key.to_owned(),
        value: Some(AnyValue {
            value: Some(any_value::Value::StringValue(value.to_owned())),
        }),
        ..KeyValue::default()
    }
}

fn attributes(labels: &Labels) -> Vec<KeyValue> {
    labels.iter().map(|(key, value)| attribute(key, value)).collect()
}

/// UCUM codes of the units that Prometheus spells out.
fn unit(word: &str) -> &str {
    match word {
        "seconds" => "s",
        "bytes" => "By",
        "ratio" => "1",
        other => other,
    }
}

fn data(family: &Family, times: Times) -> metric::Data {
    let cumulative = AggregationTemporality::Cumulative as i32;
    let points = || {
        let point = |(labels, value): &(Labels, f64)| NumberDataPoint {
            attributes: attributes(labels),
            start_time_unix_nano: if family.kind == Kind::Counter {
                times.began_ns
            } else {
                0
            },
            time_unix_nano: times.now_ns,
            value: Some(number_data_point::Value::AsDouble(*value)),
            ..NumberDataPoint::default()
        };
        family.values.iter().map(point).collect()
    };
    match family.kind {
        Kind::Counter => metric::Data::Sum(Sum {
            data_points: points(),
            aggregation_temporality: cumulative,
            is_monotonic: true,
        }),
        Kind::Gauge => metric::Data::Gauge(Gauge { data_points: points() }),
        Kind::Histogram => {
            let point = |(labels, histogram): &(Labels, crate::open_metrics::Histogram)| {
                let mut before = 0;
                let counts = histogram.buckets.iter().map(|(_, up_to)| {
                    let count = up_to.saturating_sub(before);
                    before = *up_to;
                    count
                });
                HistogramDataPoint {
                    attributes: attributes(labels),
                    start_time_unix_nano: times.began_ns,
                    time_unix_nano: times.now_ns,
                    count: histogram.count,
                    sum: Some(histogram.sum),
                    bucket_counts: counts.collect(),
                    // The last bucket has no bound.
                    explicit_bounds: histogram
                        .buckets
                        .iter()
                        .map(|(bound, _)| *bound)
                        .filter(|b| b.is_finite())
                        .collect(),
                    ..HistogramDataPoint::default()
                }
            };
            metric::Data::Histogram(Histogram {
                data_points: family.histograms.iter().map(point).collect(),
                aggregation_temporality: cumulative,
            })
        }
    }
}

/// One message with all families that have a value.
pub(crate) fn request(families: &[Family], identity: &Identity, times: Times) -> ExportMetricsServiceRequest {
    let metrics = families
        .iter()
        .filter(|family| !family.values.is_empty() || !family.histograms.is_empty())
        .map(|family| Metric {
            name: family.name.clone(),
            description: family.help.clone(),
            unit: unit(&family.unit).to_owned(),
            data: Some(data(family, times)),
            ..Metric::default()
        });
    let scope = ScopeMetrics {
        scope: Some(InstrumentationScope {
            name: "bumpless".to_owned(),
            version: identity.version.clone(),
            ..InstrumentationScope::default()
        }),
        metrics: metrics.collect(),
        ..ScopeMetrics::default()
    };
    let attributes = identity.attributes();
    ExportMetricsServiceRequest {
        resource_metrics: vec![ResourceMetrics {
            resource: Some(Resource {
                attributes: attributes.map(|(key, value)| attribute(key, value)).to_vec(),
                ..Resource::default()
            }),
            scope_metrics: vec![scope],
            ..ResourceMetrics::default()
        }],
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;
    use crate::{
        open_metrics::{families, tests::TEXT},
        tests::identity,
    };

    #[test]
    fn the_text_becomes_sums_gauges_and_histograms() {
        let times = Times { began_ns: 1, now_ns: 9 };
        let request = request(&families(TEXT).0, &identity(), times);
        let of = &request.resource_metrics[0];
        let host = attribute("host.name", "a");
        assert!(of.resource.as_ref().unwrap().attributes.contains(&host));
        let [cycles, step, age, _build] = of.scope_metrics[0].metrics.as_slice() else {
            panic!("four families")
        };
        let Some(metric::Data::Sum(sum)) = &cycles.data else {
            panic!("a counter is a sum")
        };
        assert!(sum.is_monotonic && sum.aggregation_temporality == 2);
        assert_eq!(sum.data_points[1].attributes, [attribute("loop", "b")]);
        assert_eq!(sum.data_points[1].value, Some(number_data_point::Value::AsDouble(7.0)));
        assert_eq!(
            (
                sum.data_points[1].start_time_unix_nano,
                sum.data_points[1].time_unix_nano
            ),
            (1, 9)
        );
        let Some(metric::Data::Histogram(histogram)) = &step.data else {
            panic!("a histogram stays one")
        };
        assert_eq!(step.unit, "s");
        let point = &histogram.data_points[0];
        assert_eq!(point.bucket_counts, [1, 2], "counts of each bucket alone");
        assert_eq!(point.explicit_bounds, [0.1]);
        assert_eq!((point.count, point.sum), (3, Some(0.5)));
        assert!(matches!(age.data, Some(metric::Data::Gauge(_))));
    }
}
