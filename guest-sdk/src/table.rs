//! Tables of ports and parameters as constants, and the handles that are looked up in them while compiling.
//!
//! Owns the checks that a description passes before it is built into a component. Never: looks up a name at run time.
//!
//! ```compile_fail
//! use bumpless_sdk::{Input, PortSpec};
//! const PORTS: &[PortSpec] = &[PortSpec::analog_input("pv", "", "")];
//! const PV: Input = Input::of(PORTS, "vp"); // no port of that name
//! # let _ = PV;
//! ```
//! ```compile_fail
//! use bumpless_sdk::{Description, PortSpec};
//! const TWICE: &[PortSpec] = &[PortSpec::analog_output("out", "", ""), PortSpec::analog_output("out", "", "")];
//! const D: Description =
//!     Description { name: "x", version: "1.0.0", text: "", ports: TWICE, parameters: &[], state_layout: 1 };
//! const _: () = D.check(); // two ports share a name
//! ```

/// Which way a port's values flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the process to the controller.
    Input,
    /// From the controller to the process.
    Output,
}

/// What kind of number a port carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A quantity in the port's unit.
    Analog,
    /// 0 is off, anything else is on.
    Digital,
}

/// One row of the table of ports. A port's position in the table is its number.
#[derive(Debug, Clone, Copy)]
pub struct PortSpec {
    /// 1 to 32 lower-case letters, digits and dashes.
    pub name: &'static str,
    /// Which way its values flow.
    pub direction: Direction,
    /// What its numbers mean.
    pub kind: Kind,
    /// Unit as text; empty for none, or for any.
    pub unit: &'static str,
    /// Must a loop connect it?
    pub required: bool,
    /// One line for people.
    pub text: &'static str,
}

impl PortSpec {
    const fn new(name: &'static str, direction: Direction, kind: Kind, unit: &'static str, text: &'static str) -> Self {
        Self {
            name,
            direction,
            kind,
            unit,
            required: false,
            text,
        }
    }

    /// An optional input with a quantity.
    #[must_use]
    pub const fn analog_input(name: &'static str, unit: &'static str, text: &'static str) -> Self {
        Self::new(name, Direction::Input, Kind::Analog, unit, text)
    }

    /// An optional input that is on or off.
    #[must_use]
    pub const fn digital_input(name: &'static str, text: &'static str) -> Self {
        Self::new(name, Direction::Input, Kind::Digital, "", text)
    }

    /// An optional output with a quantity.
    #[must_use]
    pub const fn analog_output(name: &'static str, unit: &'static str, text: &'static str) -> Self {
        Self::new(name, Direction::Output, Kind::Analog, unit, text)
    }

    /// An optional output that is on or off.
    #[must_use]
    pub const fn digital_output(name: &'static str, text: &'static str) -> Self {
        Self::new(name, Direction::Output, Kind::Digital, "", text)
    }

    /// The same port, which a loop must connect.
    #[must_use]
    pub const fn required(mut self) -> Self {
        self.required = true;
        self
    }
}

/// One row of the table of parameters. Values are always given in the table's order.
#[derive(Debug, Clone, Copy)]
pub struct ParameterSpec {
    /// 1 to 32 lower-case letters, digits and dashes.
    pub name: &'static str,
    /// Unit as text; empty for none.
    pub unit: &'static str,
    /// Value where the loop sets none.
    pub default: f64,
    /// Least value allowed.
    pub minimum: f64,
    /// Greatest value allowed.
    pub maximum: f64,
    /// Where not empty, the value is an index into these words.
    pub choices: &'static [&'static str],
    /// One line for people.
    pub text: &'static str,
}

impl ParameterSpec {
    /// A number within a range.
    #[must_use]
    pub const fn number(
        name: &'static str,
        unit: &'static str,
        default: f64,
        minimum: f64,
        maximum: f64,
        text: &'static str,
    ) -> Self {
        Self {
            name,
            unit,
            default,
            minimum,
            maximum,
            choices: &[],
            text,
        }
    }

    /// One of some words; the first is the default.
    #[must_use]
    pub const fn choice(name: &'static str, choices: &'static [&'static str], text: &'static str) -> Self {
        let last = if choices.is_empty() { 0 } else { choices.len() - 1 };
        // At most 128 words (see `Description::check`), so the number is exact.
        Self {
            name,
            unit: "",
            default: 0.0,
            minimum: 0.0,
            maximum: last as f64,
            choices,
            text,
        }
    }
}

/// Two tables as one, the first one's rows first: `N` is the number of all rows. Stops the build where it is not.
///
/// ```
/// use bumpless_sdk::{PortSpec, joined};
/// const SHARED: &[PortSpec] = &[PortSpec::analog_output("out", "", "To the actuator")];
/// const PORTS: &[PortSpec] = &joined::<_, 2>(&[PortSpec::analog_input("pv", "", "Measurement")], SHARED);
/// assert_eq!(PORTS[1].name, "out");
/// ```
#[must_use]
pub const fn joined<T: Copy, const N: usize>(first: &[T], second: &[T]) -> [T; N] {
    assert!(
        first.len() + second.len() == N && !first.is_empty(),
        "the number of rows is not the sum of both tables"
    );
    let mut rows = [first[0]; N];
    let mut i = 1;
    while i < N {
        rows[i] = if i < first.len() {
            first[i]
        } else {
            second[i - first.len()]
        };
        i += 1;
    }
    rows
}

/// What a controller says of itself.
#[derive(Debug, Clone, Copy)]
pub struct Description {
    /// Name of the algorithm: 1 to 32 lower-case letters, digits and dashes.
    pub name: &'static str,
    /// Three numbers; `env!("CARGO_PKG_VERSION")` is a good one.
    pub version: &'static str,
    /// One line for people.
    pub text: &'static str,
    /// The ports, at most 64.
    pub ports: &'static [PortSpec],
    /// The parameters, at most 128.
    pub parameters: &'static [ParameterSpec],
    /// Grows with each change of [`crate::Controller::State`].
    pub state_layout: u32,
}

impl Description {
    /// Stops the build with the reason when a host would refuse the description. Made for `const` contexts; [`crate::export!`] calls it.
    pub const fn check(&self) {
        assert!(
            is_name(self.name),
            "the controller's name must have 1 to 32 lower-case letters, digits and dashes"
        );
        assert!(self.ports.len() <= 64, "a controller may have at most 64 ports");
        assert!(
            self.parameters.len() <= 128,
            "a controller may have at most 128 parameters"
        );
        let mut outputs = 0;
        let mut i = 0;
        while i < self.ports.len() {
            assert!(
                is_name(self.ports[i].name),
                "a port's name must have 1 to 32 lower-case letters, digits and dashes"
            );
            assert!(
                port_index(self.ports, self.ports[i].name) == i,
                "two ports share a name"
            );
            if matches!(self.ports[i].direction, Direction::Output) {
                outputs += 1;
            }
            i += 1;
        }
        assert!(outputs > 0, "a controller needs at least one output port");
        let mut i = 0;
        while i < self.parameters.len() {
            let p = &self.parameters[i];
            assert!(
                is_name(p.name),
                "a parameter's name must have 1 to 32 lower-case letters, digits and dashes"
            );
            assert!(
                parameter_index(self.parameters, p.name) == i,
                "two parameters share a name"
            );
            assert!(
                p.minimum.is_finite() && p.maximum.is_finite() && p.minimum <= p.default && p.default <= p.maximum,
                "minimum <= default <= maximum must hold for a parameter, all finite"
            );
            assert!(p.choices.len() <= 128, "a choice may have at most 128 words");
            i += 1;
        }
    }

    /// How many ports are outputs: the length of `track`.
    #[must_use]
    pub const fn output_count(&self) -> usize {
        let mut count = 0;
        let mut i = 0;
        while i < self.ports.len() {
            if matches!(self.ports[i].direction, Direction::Output) {
                count += 1;
            }
            i += 1;
        }
        count
    }
}

/// Handle of an input port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Input {
    pub(crate) number: u32,
}

impl Input {
    /// Looks the port up. In a `const`, a name that is no input of the table stops the build.
    #[must_use]
    pub const fn of(ports: &[PortSpec], name: &str) -> Self {
        let index = port_index(ports, name);
        assert!(index < ports.len(), "no port of that name");
        assert!(
            matches!(ports[index].direction, Direction::Input),
            "the port is an output"
        );
        Self { number: index as u32 }
    }

    /// Its number in the frame.
    #[must_use]
    pub const fn number(self) -> u32 {
        self.number
    }
}

/// Handle of an output port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Output {
    pub(crate) number: u32,
    /// Position among the output ports: its place in `track`.
    pub(crate) ordinal: usize,
}

impl Output {
    /// Looks the port up. In a `const`, a name that is no output of the table stops the build.
    #[must_use]
    pub const fn of(ports: &[PortSpec], name: &str) -> Self {
        let index = port_index(ports, name);
        assert!(index < ports.len(), "no port of that name");
        assert!(
            matches!(ports[index].direction, Direction::Output),
            "the port is an input"
        );
        let mut ordinal = 0;
        let mut i = 0;
        while i < index {
            if matches!(ports[i].direction, Direction::Output) {
                ordinal += 1;
            }
            i += 1;
        }
        Self {
            number: index as u32,
            ordinal,
        }
    }

    /// Its number in the frame.
    #[must_use]
    pub const fn number(self) -> u32 {
        self.number
    }
}

/// Handle of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Parameter {
    pub(crate) index: usize,
}

impl Parameter {
    /// Looks the parameter up. In a `const`, a name that is not in the table stops the build.
    #[must_use]
    pub const fn of(parameters: &[ParameterSpec], name: &str) -> Self {
        let index = parameter_index(parameters, name);
        assert!(index < parameters.len(), "no parameter of that name");
        Self { index }
    }

    /// Its place in the table.
    #[must_use]
    pub const fn index(self) -> usize {
        self.index
    }
}

/// The first port of that name, or the table's length.
const fn port_index(ports: &[PortSpec], name: &str) -> usize {
    let mut i = 0;
    while i < ports.len() && !same(ports[i].name, name) {
        i += 1;
    }
    i
}

/// The first parameter of that name, or the table's length.
const fn parameter_index(parameters: &[ParameterSpec], name: &str) -> usize {
    let mut i = 0;
    while i < parameters.len() && !same(parameters[i].name, name) {
        i += 1;
    }
    i
}

/// `==` of texts, for constant functions.
pub(crate) const fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    if a.len() != b.len() {
        return false;
    }
    let mut i = 0;
    while i < a.len() {
        if a[i] != b[i] {
            return false;
        }
        i += 1;
    }
    true
}

/// 1 to 32 lower-case letters, digits and dashes: the host's own rule.
const fn is_name(text: &str) -> bool {
    let bytes = text.as_bytes();
    let mut i = 0;
    while i < bytes.len() {
        if !(bytes[i].is_ascii_lowercase() || bytes[i].is_ascii_digit() || bytes[i] == b'-') {
            return false;
        }
        i += 1;
    }
    !bytes.is_empty() && bytes.len() <= 32
}
