//! The only place that names generated types and the core's nouns together.
//!
//! Never: judges a value; limits and checks are elsewhere.

use bumpless_core::{
    Cycle, Descriptor, Direction, Fault, Frame, LogLevel, Mode, NoData, ParameterSpec, PortKind, PortSpec, Priority,
    Quality, Reading, limits::PORTS_MAX,
};

use crate::{
    Origin,
    bindings::{
        bumpless::control::{alarm, io, log, types},
        exports::bumpless::control::control as wit,
    },
    sandbox::cut,
};

/// A reading as the guest sees it; `at_ns` is when its frame was frozen.
pub(crate) fn reading(reading: &Reading, at_ns: u64) -> io::Reading {
    // A value that is not finite is no value, whatever its quality says.
    let value = reading.value.ok().filter(|v| v.is_finite());
    let quality = match (value, reading.quality) {
        (None, _) | (_, Quality::Bad) => types::Quality::Bad,
        (_, Quality::Uncertain) => types::Quality::Uncertain,
        // What a person forces is meant to be acted on; the components' interface knows no more than "usable".
        (_, Quality::Good | Quality::Forced) => types::Quality::Good,
    };
    let last_good = if reading.last_good.is_finite() {
        reading.last_good
    } else {
        0.0
    };
    io::Reading {
        value: value.unwrap_or(last_good),
        quality,
        age_ns: at_ns.saturating_sub(reading.at_ns),
        fresh: reading.fresh,
    }
}

/// The cycle of a frame for a component with `ports` ports.
pub(crate) fn cycle(frame: &Frame, ports: usize) -> wit::Cycle {
    let Cycle {
        seq,
        at_ns,
        dt_ns,
        mode,
        setpoint,
    } = frame.cycle;
    let connected = (0..)
        .zip(frame.readings.iter().take(ports.min(PORTS_MAX)))
        .fold(0, |mask, (port, r)| {
            if r.value == Err(NoData::NotConnected) {
                mask
            } else {
                mask | 1_u64 << port
            }
        });
    let mode = match mode {
        Mode::Manual => types::Mode::Manual,
        Mode::Automatic => types::Mode::Automatic,
    };
    wit::Cycle {
        sequence: seq,
        time_ns: at_ns,
        dt_ns,
        mode,
        setpoint,
        connected,
    }
}

/// Where a state comes from.
pub(crate) fn origin(from: &Origin) -> wit::Origin {
    wit::Origin {
        name: from.name.clone(),
        version: from.version.clone(),
        state_layout: from.state_layout,
    }
}

/// A fault in the guest's words, cut to a text's length.
pub(crate) fn fault(fault: &types::Fault) -> Fault {
    match fault {
        types::Fault::BadParameter(text) => Fault::BadParameter(cut(text)),
        types::Fault::BadState(text) => Fault::BadState(cut(text)),
        types::Fault::BadInput(text) => Fault::BadInput(cut(text)),
        types::Fault::Failed(text) => Fault::Failed(cut(text)),
    }
}

/// What the guest says of itself, unchecked.
pub(crate) fn descriptor(said: wit::Descriptor) -> Descriptor {
    Descriptor {
        name: said.name,
        version: said.version,
        text: said.text,
        ports: said.ports.into_iter().map(port).collect(),
        parameters: said.parameters.into_iter().map(parameter).collect(),
        state_layout: said.state_layout,
    }
}

fn port(said: wit::Port) -> PortSpec {
    PortSpec {
        name: said.name,
        direction: match said.direction {
            wit::Direction::Input => Direction::Input,
            wit::Direction::Output => Direction::Output,
        },
        kind: match said.kind {
            wit::Kind::Analog => PortKind::Analog,
            wit::Kind::Digital => PortKind::Digital,
        },
        unit: said.unit,
        required: said.required,
        text: said.text,
    }
}

fn parameter(said: wit::Parameter) -> ParameterSpec {
    ParameterSpec {
        name: said.name,
        unit: said.unit,
        default: said.default,
        minimum: said.minimum,
        maximum: said.maximum,
        choices: said.choices,
        text: said.text,
    }
}

/// How urgent an alarm is.
pub(crate) fn priority(said: alarm::Priority) -> Priority {
    match said {
        alarm::Priority::Low => Priority::Low,
        alarm::Priority::Medium => Priority::Medium,
        alarm::Priority::High => Priority::High,
    }
}

/// How much a line matters.
pub(crate) fn log_level(said: log::Level) -> LogLevel {
    match said {
        log::Level::Debug => LogLevel::Debug,
        log::Level::Info => LogLevel::Info,
        log::Level::Warning => LogLevel::Warning,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_value_reads_as_the_last_good_one_and_bad() {
        let r = reading(&Reading::missing(NoData::CommsLost, 4.5, 70), 100);
        assert_eq!(
            (r.value, r.quality, r.age_ns, r.fresh),
            (4.5, types::Quality::Bad, 30, false)
        );
        let r = reading(&Reading::good(f64::NAN, 100), 100);
        assert_eq!((r.value, r.quality), (0.0, types::Quality::Bad));
        // A sample stamped after the frame was frozen is no older than the frame.
        assert_eq!(reading(&Reading::good(1.0, 200), 100).age_ns, 0);
    }

    #[test]
    fn unconnected_ports_are_missing_from_the_mask() {
        let frame = Frame {
            cycle: Cycle {
                seq: 1,
                at_ns: 2,
                dt_ns: 3,
                mode: Mode::Automatic,
                setpoint: 4.0,
            },
            readings: vec![
                Reading::good(1.0, 0),
                Reading::unconnected(),
                Reading::missing(NoData::CommsLost, 0.0, 0),
                Reading::good(1.0, 0),
            ],
            messages: vec![],
        };
        assert_eq!(cycle(&frame, 3).connected, 0b101);
    }
}
