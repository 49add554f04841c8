//! Ports and parameters of the ISA-form controllers, and their handles.
//!
//! [`PORTS`] and [`PARAMETERS`] are what every law around the block has; [`BLOCK_PORTS`] and [`BLOCK_PARAMETERS`] go on with what
//! only the block by itself has (`pid`, `pidplus`): out of service, bypass, and its place in a chain of loops.
//!
//! Names and meanings follow ISA-TR5.9-2023 (PID algorithms and performance) and the Foundation Fieldbus PID block
//! (`BAL_TIME`, `FF_GAIN`, `TRK_IN_D`, `TRK_VAL`). Never: a value; those ride in the state.

use bumpless_sdk::{Input, Output, Parameter, ParameterSpec, PortSpec, joined};

/// The ports.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement, in the unit of the setpoint").required(),
    PortSpec::analog_input("ff", "", "Feedforward: times ff-gain, added to the output"),
    PortSpec::analog_input("track", "", "Value that the output follows while track-on is on"),
    PortSpec::digital_input("track-on", "Makes the output follow the track input"),
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
    PortSpec::analog_input(
        "remote-sp",
        "",
        "Setpoint while remote-on is on; while it is bad, its last value stays",
    ),
    PortSpec::digital_input("remote-on", "Takes the setpoint from remote-sp, not from the loop"),
    PortSpec::digital_input("hold", "Stops the integral"),
    PortSpec::analog_input(
        "reset",
        "",
        "External reset: what the integral follows instead of the actuator's reading",
    ),
    PortSpec::digital_input(
        "no-rise",
        "Bars the integral from raising the output: more would be of no use",
    ),
    PortSpec::digital_input("no-fall", "Bars the integral from lowering the output"),
];

/// The ports of the block by itself.
pub const BLOCK_PORTS: &[PortSpec] = &joined::<_, { PORTS.len() + 2 }>(
    PORTS,
    &[
        PortSpec::digital_input("bypass-on", "Sends the setpoint through to the output"),
        PortSpec::digital_input("oos", "Out of service: the output stays, and nothing is looked at"),
    ],
);

/// Measurement.
pub const PV: Input = Input::of(PORTS, "pv");
/// Feedforward.
pub const FF: Input = Input::of(PORTS, "ff");
/// Value to follow.
pub const TRACK: Input = Input::of(PORTS, "track");
/// Follow it now?
pub const TRACK_ON: Input = Input::of(PORTS, "track-on");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");
/// Setpoint from elsewhere.
pub const REMOTE_SP: Input = Input::of(PORTS, "remote-sp");
/// Is it used?
pub const REMOTE_ON: Input = Input::of(PORTS, "remote-on");
/// Is more output of no use?
pub const NO_RISE: Input = Input::of(PORTS, "no-rise");
/// Is less output of no use?
pub const NO_FALL: Input = Input::of(PORTS, "no-fall");
/// Does the setpoint go through?
pub const BYPASS_ON: Input = Input::of(BLOCK_PORTS, "bypass-on");
/// Is the block out of service?
pub const OOS: Input = Input::of(BLOCK_PORTS, "oos");
/// Does the integral stand still?
pub const HOLD: Input = Input::of(PORTS, "hold");
/// What the integral follows.
pub const RESET: Input = Input::of(PORTS, "reset");

/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number(
        "k",
        "out/pv",
        1.0,
        0.0,
        1e6,
        "Gain: output units per unit of the measurement",
    ),
    ParameterSpec::number("ti", "s", 60.0, 0.0, 1e6, "Integral time; 0 for no integral action"),
    ParameterSpec::number("td", "s", 0.0, 0.0, 1e5, "Derivative time; 0 for no derivative action"),
    ParameterSpec::number(
        "n",
        "",
        10.0,
        1.0,
        100.0,
        "Derivative filter: its time is td / n; usual are 5 to 20",
    ),
    ParameterSpec::number(
        "beta",
        "",
        1.0,
        0.0,
        1.0,
        "Part of the setpoint in the proportional action",
    ),
    ParameterSpec::number(
        "gamma",
        "",
        0.0,
        0.0,
        1.0,
        "Part of the setpoint in the derivative action",
    ),
    ParameterSpec::choice(
        "action",
        &["reverse", "direct"],
        "reverse: a rising measurement lowers the output; direct: raises it",
    ),
    ParameterSpec::number("out-low", "out", 0.0, -1e9, 1e9, "Least output"),
    ParameterSpec::number("out-high", "out", 100.0, -1e9, 1e9, "Greatest output"),
    ParameterSpec::number(
        "out-rate",
        "out/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the output per second; 0 for no limit",
    ),
    ParameterSpec::number(
        "dead-band",
        "pv",
        0.0,
        0.0,
        1e9,
        "Errors up to this size, both ways, count as none",
    ),
    ParameterSpec::number(
        "ff-gain",
        "out/ff",
        1.0,
        -1e6,
        1e6,
        "Output units per unit of the feedforward",
    ),
    ParameterSpec::number("bias", "out", 50.0, -1e9, 1e9, "Output at no error, where ti is 0"),
    ParameterSpec::number(
        "balance-time",
        "s",
        60.0,
        0.0,
        1e6,
        "Time constant with which the output returns to the bias after a bumpless transfer, where ti is 0",
    ),
    ParameterSpec::number(
        "pv-filter",
        "s",
        0.0,
        0.0,
        1e5,
        "Time constant of the filter on the measurement; 0 for none",
    ),
    // Since layout 2 of the state. New ones go to the end: an older state is read by position.
    ParameterSpec::choice(
        "form",
        &["standard", "series", "parallel"],
        "What k, ti and td mean: K(1 + 1/Tis + Tds), K(1 + 1/Tis)(1 + Tds), or k + 1/(ti s) + td s",
    ),
    ParameterSpec::number("sp-low", "pv", -1e9, -1e9, 1e9, "Least setpoint that the law follows"),
    ParameterSpec::number(
        "sp-high",
        "pv",
        1e9,
        -1e9,
        1e9,
        "Greatest setpoint that the law follows",
    ),
    ParameterSpec::number(
        "sp-rate",
        "pv/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the setpoint per second; 0 for no limit",
    ),
    ParameterSpec::choice(
        "sp-track",
        &["off", "on"],
        "on: in manual and while tracking, the setpoint of the law follows the measurement",
    ),
    ParameterSpec::number(
        "hi-hi",
        "pv",
        1e9,
        -1e9,
        1e9,
        "Alarm of high priority above it; 1e9 for none",
    ),
    ParameterSpec::number(
        "hi",
        "pv",
        1e9,
        -1e9,
        1e9,
        "Alarm of medium priority above it; 1e9 for none",
    ),
    ParameterSpec::number(
        "lo",
        "pv",
        -1e9,
        -1e9,
        1e9,
        "Alarm of medium priority below it; -1e9 for none",
    ),
    ParameterSpec::number(
        "lo-lo",
        "pv",
        -1e9,
        -1e9,
        1e9,
        "Alarm of high priority below it; -1e9 for none",
    ),
    ParameterSpec::number(
        "dv-hi",
        "pv",
        1e9,
        0.0,
        1e9,
        "Alarm of low priority while the measurement is so far above the setpoint; 1e9 for none",
    ),
    ParameterSpec::number(
        "dv-lo",
        "pv",
        1e9,
        0.0,
        1e9,
        "Alarm of low priority while the measurement is so far below the setpoint; 1e9 for none",
    ),
    ParameterSpec::number(
        "alarm-band",
        "pv",
        0.0,
        0.0,
        1e9,
        "How far the measurement must come back before an alarm goes",
    ),
    // Since layout 3 of `pid`.
    ParameterSpec::number(
        "arw-low",
        "out",
        -1e9,
        -1e9,
        1e9,
        "Below this output the integral does not lower it further; -1e9 for none",
    ),
    ParameterSpec::number(
        "arw-high",
        "out",
        1e9,
        -1e9,
        1e9,
        "Above this output the integral does not raise it further; 1e9 for none",
    ),
    ParameterSpec::number(
        "ff-span",
        "ff",
        0.0,
        0.0,
        1e9,
        "Range of the feedforward: where it is not 0, ff-gain is in parts of the output's range per part of this one",
    ),
    ParameterSpec::choice(
        "on-uncertain",
        &["use", "hold", "bad"],
        "What a measurement of uncertain quality, as at the end of its instrument's range, is for the law: as good, no food for the integral, or none",
    ),
    ParameterSpec::choice(
        "tell",
        &["nothing", "mode", "quality", "both"],
        "Whether an alarm of low priority tells that the block works in another mode than it was put in, or with inputs that are not good",
    ),
];

/// The parameters of the block by itself.
pub const BLOCK_PARAMETERS: &[ParameterSpec] = &joined::<_, { PARAMETERS.len() + 4 }>(
    PARAMETERS,
    &[
        ParameterSpec::number(
            "bkcal-in",
            "",
            0.0,
            0.0,
            9999.0,
            "Number of the link by which the loop below reports, whose setpoint this output is; 0 for none",
        ),
        ParameterSpec::number(
            "bkcal-out",
            "",
            0.0,
            0.0,
            9999.0,
            "Number of the link by which this block reports to the loop above, whose output its remote setpoint is; 0 for none",
        ),
        ParameterSpec::choice(
            "bkcal-value",
            &["setpoint", "measurement"],
            "What it reports: the setpoint that it follows, or its measurement",
        ),
        ParameterSpec::number(
            "bkcal-band",
            "%",
            0.5,
            0.0,
            50.0,
            "How far the output must leave a limit, in % of its range, before the limit is reported no more",
        ),
    ],
);

macro_rules! handles {
    ($($(#[$doc:meta])* $handle:ident = $name:literal;)*) => {
        $($(#[$doc])* pub const $handle: Parameter = Parameter::of(BLOCK_PARAMETERS, $name);)*
    };
}

handles! {
    /// Gain.
    K = "k";
    /// Integral time.
    TI = "ti";
    /// Derivative time.
    TD = "td";
    /// Derivative filter.
    N = "n";
    /// Setpoint weight of P.
    BETA = "beta";
    /// Setpoint weight of D.
    GAMMA = "gamma";
    /// Direction.
    ACTION = "action";
    /// Least output.
    OUT_LOW = "out-low";
    /// Greatest output.
    OUT_HIGH = "out-high";
    /// Rate limit.
    OUT_RATE = "out-rate";
    /// Dead band.
    DEAD_BAND = "dead-band";
    /// Gain of the feedforward.
    FF_GAIN = "ff-gain";
    /// Bias without integral action.
    BIAS = "bias";
    /// Time of return to the bias.
    BALANCE_TIME = "balance-time";
    /// Measurement filter.
    PV_FILTER = "pv-filter";
    /// What k, ti and td mean.
    FORM = "form";
    /// Least setpoint.
    SP_LOW = "sp-low";
    /// Greatest setpoint.
    SP_HIGH = "sp-high";
    /// Rate limit of the setpoint.
    SP_RATE = "sp-rate";
    /// Does the setpoint follow the measurement in manual?
    SP_TRACK = "sp-track";
    /// Very high.
    HI_HI = "hi-hi";
    /// High.
    HI = "hi";
    /// Low.
    LO = "lo";
    /// Very low.
    LO_LO = "lo-lo";
    /// Above the setpoint.
    DV_HI = "dv-hi";
    /// Below the setpoint.
    DV_LO = "dv-lo";
    /// Hysteresis of the alarms.
    ALARM_BAND = "alarm-band";
    /// Lower anti-windup limit.
    ARW_LOW = "arw-low";
    /// Upper anti-windup limit.
    ARW_HIGH = "arw-high";
    /// Range of the feedforward.
    FF_SPAN = "ff-span";
    /// What an uncertain measurement is.
    ON_UNCERTAIN = "on-uncertain";
    /// What is told.
    TELL = "tell";
    /// Link to the loop below.
    BKCAL_IN = "bkcal-in";
    /// Link to the loop above.
    BKCAL_OUT = "bkcal-out";
    /// What is reported to it.
    BKCAL_VALUE = "bkcal-value";
    /// Hysteresis of the reported limits.
    BKCAL_BAND = "bkcal-band";
}
