//! Reads the OpenMetrics text format (prometheus.io/docs/specs/om/open_metrics_spec), as far as this program writes it: counters,
//! gauges and histograms.
//!
//! Never: guesses. A line that is none of these is passed over and counted.

use std::collections::BTreeMap;

/// Label names and values, in the order of the text.
pub(crate) type Labels = Vec<(String, String)>;

/// What a family's numbers mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Counter,
    Gauge,
    Histogram,
}

/// One histogram: upper bounds with the counts up to each, as the text has them.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Histogram {
    /// (upper bound, observations up to it), ascending, the last one +Inf.
    pub(crate) buckets: Vec<(f64, u64)>,
    pub(crate) sum: f64,
    pub(crate) count: u64,
}

/// Metrics of one name.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Family {
    /// Without the suffixes of samples.
    pub(crate) name: String,
    pub(crate) help: String,
    /// `seconds`, `bytes` and so on; empty for none.
    pub(crate) unit: String,
    pub(crate) kind: Kind,
    /// Of counters and gauges.
    pub(crate) values: Vec<(Labels, f64)>,
    /// Of histograms.
    pub(crate) histograms: Vec<(Labels, Histogram)>,
}

/// The families of a text, and how many lines made no sense.
pub(crate) fn families(text: &str) -> (Vec<Family>, usize) {
    let mut read = Reader::default();
    for line in text.lines() {
        if read.line(line).is_none() {
            read.strange += 1;
        }
    }
    let mut all = read.done;
    all.extend(read.now);
    (all, read.strange)
}

#[derive(Default)]
struct Reader {
    done: Vec<Family>,
    now: Option<Family>,
    help: BTreeMap<String, String>,
    units: BTreeMap<String, String>,
    strange: usize,
}

impl Reader {
    /// None where the line makes no sense.
    fn line(&mut self, line: &str) -> Option<()> {
        let Some(comment) = line.strip_prefix('#') else {
            return self.sample(line);
        };
        let mut words = comment.trim_start().splitn(3, ' ');
        match (words.next()?, words.next(), words.next()) {
            ("EOF", ..) => {}
            ("HELP", Some(name), text) => {
                let text = text.unwrap_or_default().to_owned();
                match self.now.as_mut().filter(|now| now.name == name) {
                    Some(now) => now.help = text,
                    None => _ = self.help.insert(name.to_owned(), text),
                }
            }
            ("UNIT", Some(name), text) => {
                let text = text.unwrap_or_default().to_owned();
                match self.now.as_mut().filter(|now| now.name == name) {
                    Some(now) => now.unit = text,
                    None => _ = self.units.insert(name.to_owned(), text),
                }
            }
            ("TYPE", Some(name), Some(kind)) => {
                // What is only told is a gauge of 1, by the name of its sample.
                let (kind, told) = match kind {
                    "counter" => (Kind::Counter, ""),
                    "gauge" => (Kind::Gauge, ""),
                    "histogram" => (Kind::Histogram, ""),
                    "info" => (Kind::Gauge, "_info"),
                    _ => return None,
                };
                self.done.extend(self.now.take());
                self.now = Some(Family {
                    name: format!("{name}{told}"),
                    help: self.help.remove(name).unwrap_or_default(),
                    unit: self.units.remove(name).unwrap_or_default(),
                    kind,
                    values: Vec::new(),
                    histograms: Vec::new(),
                });
            }
            _ => return None,
        }
        Some(())
    }

    fn sample(&mut self, line: &str) -> Option<()> {
        let (name, mut labels, value) = sample(line)?;
        let family = self.now.as_mut()?;
        let suffix = name.strip_prefix(family.name.as_str())?;
        match (family.kind, suffix) {
            (Kind::Gauge, "") | (Kind::Counter, "_total") => family.values.push((labels, value)),
            (Kind::Histogram, "_bucket") => {
                let at = labels.iter().position(|(name, _)| name == "le")?;
                let bound = number(&labels.remove(at).1)?;
                family.histogram(labels).buckets.push((bound, value as u64));
            }
            (Kind::Histogram, "_sum") => family.histogram(labels).sum = value,
            (Kind::Histogram, "_count") => family.histogram(labels).count = value as u64,
            _ => return None,
        }
        Some(())
    }
}

impl Family {
    /// The histogram with these labels; a new one at the end where there is none yet.
    fn histogram(&mut self, labels: Labels) -> &mut Histogram {
        // Lines of one histogram stand together, so it is the last one or new.
        if self.histograms.last().is_none_or(|(last, _)| *last != labels) {
            let at = self.histograms.iter().position(|(known, _)| *known == labels);
            let row = match at {
                Some(at) => self.histograms.remove(at),
                None => (labels, Histogram::default()),
            };
            self.histograms.push(row);
        }
        let last = self.histograms.len() - 1;
        &mut self.histograms[last].1
    }
}

fn number(text: &str) -> Option<f64> {
    match text {
        "+Inf" => Some(f64::INFINITY),
        "-Inf" => Some(f64::NEG_INFINITY),
        _ => text.parse().ok(),
    }
}

/// `name{label="value",…} number …`.
fn sample(line: &str) -> Option<(&str, Labels, f64)> {
    let end = line.find(['{', ' '])?;
    let (name, rest) = line.split_at(end);
    let (labels, rest) = match rest.strip_prefix('{') {
        Some(rest) => labels(rest)?,
        None => (Labels::new(), rest),
    };
    let value = number(rest.split_ascii_whitespace().next()?)?;
    Some((name, labels, value))
}

/// The labels up to the closing brace, and what stands after it.
fn labels(mut text: &str) -> Option<(Labels, &str)> {
    let mut labels = Labels::new();
    loop {
        text = text.trim_start_matches(',');
        if let Some(rest) = text.strip_prefix('}') {
            return Some((labels, rest));
        }
        let (name, rest) = text.split_once("=\"")?;
        let mut value = String::new();
        let mut chars = rest.char_indices();
        let end = loop {
            match chars.next()? {
                (at, '"') => break at + 1,
                (_, '\\') => value.push(match chars.next()?.1 {
                    'n' => '\n',
                    other => other,
                }),
                (_, other) => value.push(other),
            }
        };
        labels.push((name.to_owned(), value));
        text = rest.get(end..)?;
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    pub(crate) const TEXT: &str = "\
# HELP b_cycles Cycles taken.
# TYPE b_cycles counter
b_cycles_total{loop=\"a \\\"b\\\\c\\nd\"} 5
b_cycles_total{loop=\"b\"} 7
# HELP b_step_seconds Time of a step.
# TYPE b_step_seconds histogram
# UNIT b_step_seconds seconds
b_step_seconds_sum{host=\"h\"} 0.5
b_step_seconds_count{host=\"h\"} 3
b_step_seconds_bucket{le=\"0.1\",host=\"h\"} 1
b_step_seconds_bucket{le=\"+Inf\",host=\"h\"} 3
# HELP b_age Age.
# TYPE b_age gauge
b_age NaN
# HELP b_build Told.
# TYPE b_build info
b_build_info{version=\"1\"} 1
# EOF
";

    #[test]
    fn families_come_with_names_units_labels_and_buckets() {
        let (families, strange) = families(TEXT);
        assert_eq!(strange, 0);
        let names: Vec<_> = families
            .iter()
            .map(|f| (f.name.as_str(), f.unit.as_str(), f.kind))
            .collect();
        assert_eq!(
            names,
            [
                ("b_cycles", "", Kind::Counter),
                ("b_step_seconds", "seconds", Kind::Histogram),
                ("b_age", "", Kind::Gauge),
                ("b_build_info", "", Kind::Gauge)
            ]
        );
        assert_eq!(families[0].help, "Cycles taken.");
        assert_eq!(
            families[0].values[0],
            (vec![("loop".into(), "a \"b\\c\nd".into())], 5.0)
        );
        let (labels, histogram) = &families[1].histograms[0];
        assert_eq!(labels, &[("host".to_owned(), "h".to_owned())]);
        assert_eq!(histogram.buckets, [(0.1, 1), (f64::INFINITY, 3)]);
        assert_eq!((histogram.sum, histogram.count), (0.5, 3));
        assert!(families[2].values[0].1.is_nan());
    }

    #[test]
    fn what_makes_no_sense_is_counted_and_hurts_nothing() {
        for line in [
            "alone 1",
            "# TYPE x summary",
            "b{",
            "b{l=\"",
            "b{l=\"x\\",
            "b{l=x} 1",
            "b x",
            "#",
            "# TYPE",
            "ü",
        ] {
            let text = format!("# TYPE b gauge\nb 1\n{line}\nb{{l=\"x\"}} 2\n");
            let (families, strange) = families(&text);
            assert_eq!(strange, 1, "{line}");
            assert_eq!(families[0].values.len(), 2, "{line}");
        }
    }
}
