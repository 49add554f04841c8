//! From what people write to a checked specification. Pure: the component and the points are arguments.
//!
//! Never: keeps anything, or takes a specification that a cycle would choke on.

use std::collections::BTreeMap;

use bumpless_core::{
    Descriptor, Digest, Direction, HostId, LoopId, LoopSpec, OnBump, OutputLimit, PointId, SpecError, Wiring,
    limits::{PERIOD_NS_MAX, PERIOD_NS_MIN},
};

use crate::{
    draft::{Change, LoopDraft},
    error::{Error, Words},
    self_watch::HOST_BOARD,
};

/// What a plan needs to know of a point.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PointFacts {
    pub(crate) low: f64,
    pub(crate) high: f64,
    pub(crate) unit: String,
    pub(crate) writable: bool,
    /// Another loop that writes it.
    pub(crate) taken_by: Option<LoopId>,
}

/// The points of the loop's home.
pub(crate) struct Ground<'a> {
    pub(crate) home: &'a HostId,
    pub(crate) point: &'a dyn Fn(&PointId) -> Option<PointFacts>,
}

fn invalid(error: &SpecError) -> Error {
    Error::Invalid(Words::new(crate::error::chain(error), ""))
}

/// The name in a draft.
pub(crate) fn loop_id(name: &str) -> Result<LoopId, Error> {
    let id = LoopId::new(name).map_err(|error| Error::invalid(error.to_string(), ""))?;
    // Steps that are asked for from outside travel under this name.
    if id.as_str() == "call" {
        return Err(Error::invalid(
            "\"call\" cannot be the name of a loop, the host uses it itself",
            "choose another name",
        ));
    }
    // The alarms of a host itself stand under this name.
    if id.as_str().starts_with(HOST_BOARD) {
        return Err(Error::invalid(
            format!("{id:?} cannot be the name of a loop, names that begin with {HOST_BOARD:?} are the hosts' own"),
            "choose another name",
        ));
    }
    Ok(id)
}

/// The points in a draft.
pub(crate) fn points(draft: &LoopDraft) -> Result<BTreeMap<String, PointId>, Error> {
    let point = |(port, point): (&String, &String)| match PointId::new(point) {
        Ok(id) => Ok((port.clone(), id)),
        Err(error) => Err(Error::invalid(format!("port {port:?}: {error}"), "")),
    };
    draft.ports.iter().map(point).collect()
}

/// A draft as a specification without a revision number, complete and checked.
pub(crate) fn spec(
    draft: &LoopDraft,
    digest: Digest,
    descriptor: &Descriptor,
    ground: &Ground<'_>,
) -> Result<LoopSpec, Error> {
    let period_ns = draft.period_ms * 1e6;
    let possible = PERIOD_NS_MIN as f64..=PERIOD_NS_MAX as f64;
    if !possible.contains(&period_ns) {
        return Err(Error::invalid(
            format!("period_ms = {}: a loop's period is 1 ms to 1 h", draft.period_ms),
            "give 1 to 3600000",
        ));
    }
    let spec = LoopSpec {
        id: loop_id(&draft.name)?,
        revision: 0,
        digest,
        period_ns: period_ns.round() as u64,
        ports: points(draft)?,
        parameters: draft.parameters.clone(),
        setpoint: draft.setpoint,
        setpoint_range: draft.setpoint_range.unwrap_or((f64::NAN, f64::NAN)),
        mode: draft.mode,
        strategy: draft.strategy,
        replicas: draft.replicas,
        limits: draft.limits.clone(),
        listens: draft.listens.clone(),
        fallback: fallback_digest(draft)?,
        fallback_parameters: draft.fallback_parameters.clone(),
        prefer: draft.prefer.clone(),
        policy: draft.policy,
    };
    complete(spec, descriptor, ground)
}

/// The fallback in a draft that reached the loop's home: its digest by then.
fn fallback_digest(draft: &LoopDraft) -> Result<Option<Digest>, Error> {
    if draft.fallback.is_none() && !draft.fallback_parameters.is_empty() {
        return Err(Error::invalid(
            "fallback_parameters are given, and no fallback",
            "name a fallback, or leave its parameters out",
        ));
    }
    let parse = |text: &String| {
        text.parse().map_err(|_| {
            Error::invalid(
                format!("fallback = {text:?} is no component's digest"),
                "name a component of the library",
            )
        })
    };
    draft.fallback.as_ref().map(parse).transpose()
}

/// What a loop runs when its component keeps failing: the fallback with what it takes of ports and parameters. It comes in
/// whatever the bump, it has no probation that could lead back to what failed, and no fallback itself.
pub(crate) fn fall_back(current: &LoopSpec, digest: Digest, old: Option<&Descriptor>, new: &Descriptor) -> Swapped {
    let mut swapped = swap(current, digest, old, new);
    swapped.spec.fallback = None;
    let own = std::mem::take(&mut swapped.spec.fallback_parameters);
    swapped.spec.parameters.extend(own);
    swapped.spec.policy.on_bump = OnBump::Alarm;
    swapped.spec.policy.probation_cycles = 0;
    swapped
}

/// Fills in what the points say, and checks everything.
pub(crate) fn complete(mut spec: LoopSpec, descriptor: &Descriptor, ground: &Ground<'_>) -> Result<LoopSpec, Error> {
    spec.check_against(descriptor).map_err(|error| invalid(&error))?;
    let mut facts = BTreeMap::new();
    for (port, point) in &spec.ports {
        let found = (ground.point)(point).ok_or_else(|| {
            Error::not_found(
                format!("port {port:?}: point {point} is not served by host {}", ground.home),
                "all points of a loop must be served by one host; list the points for their names and hosts",
            )
        })?;
        facts.insert(port.clone(), found);
    }
    for (_, port) in descriptor.outputs() {
        let (Some(fact), Some(point)) = (facts.get(&port.name), spec.ports.get(&port.name)) else {
            if spec.limits.contains_key(&port.name) {
                return Err(Error::invalid(
                    format!("limits of {:?}: the port is not connected", port.name),
                    "connect it, or leave its limits out",
                ));
            }
            continue;
        };
        if !fact.writable {
            return Err(Error::invalid(
                format!("port {:?} is an output, and point {point} is an input", port.name),
                "connect it to a writable point",
            ));
        }
        if let Some(other) = &fact.taken_by {
            return Err(Error::refused(
                format!("port {:?}: loop {other} writes point {point} already", port.name),
                "an output has one loop; connect another point, or delete that loop",
            ));
        }
        let limit = spec.limits.entry(port.name.clone()).or_insert_with(|| OutputLimit {
            low: fact.low,
            high: fact.high,
            rate_per_s: None,
            // Without current or voltage, where the range allows it.
            safe: 0.0_f64.clamp(fact.low, fact.high),
        });
        if limit.low < fact.low || limit.high > fact.high {
            return Err(Error::invalid(
                format!(
                    "limits of {:?}: {} to {} is beyond the range of point {point}, {} to {} {}",
                    port.name, limit.low, limit.high, fact.low, fact.high, fact.unit
                ),
                "narrow the limits",
            ));
        }
    }
    if let Some(port) = two_outputs_of_one_point(&spec, descriptor) {
        return Err(Error::invalid(
            format!("port {port:?}: its point is connected to another output port too"),
            "connect one of them to another point",
        ));
    }
    if let Some(port) = spec.limits.keys().find(|name| {
        descriptor
            .ports
            .iter()
            .any(|p| p.name == **name && p.direction == Direction::Input)
    }) {
        return Err(Error::invalid(
            format!("limits of {port:?}: the port is an input"),
            "limits are for outputs; leave them out",
        ));
    }
    if spec.setpoint_range.0.is_nan() && spec.setpoint_range.1.is_nan() {
        let measured = measured_port(descriptor).and_then(|port| facts.get(port));
        spec.setpoint_range = measured.map(|f| (f.low, f.high)).ok_or_else(|| {
            Error::invalid(
                "the setpoint has no range, and no connected input gives one",
                "set setpoint_range",
            )
        })?;
    }
    spec.check().map_err(|error| invalid(&error))?;
    Wiring::new(&spec, descriptor).map_err(|error| invalid(&error))?;
    Ok(spec)
}

fn two_outputs_of_one_point<'a>(spec: &'a LoopSpec, descriptor: &'a Descriptor) -> Option<&'a str> {
    let mut seen = std::collections::BTreeSet::new();
    let outputs = descriptor.outputs().map(|(_, port)| port.name.as_str());
    outputs
        .into_iter()
        .find(|name| spec.ports.get(*name).is_some_and(|point| !seen.insert(point)))
}

/// The port that a setpoint is for: `pv` by convention, else the first input.
pub(crate) fn measured_port(descriptor: &Descriptor) -> Option<&str> {
    let inputs = || descriptor.ports.iter().filter(|p| p.direction == Direction::Input);
    inputs()
        .find(|p| p.name == "pv")
        .or_else(|| inputs().next())
        .map(|p| p.name.as_str())
}

/// A running loop's specification with another component, and what could not be taken along.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Swapped {
    pub(crate) spec: LoopSpec,
    pub(crate) parameters: Vec<String>,
    pub(crate) ports: Vec<String>,
    /// For people: what did not come over, and why.
    pub(crate) notes: Vec<String>,
}

/// Why a parameter does not come over; none where it does. The same name with another unit is another quantity: a reset time
/// of 3 minutes is none of 3 seconds.
fn left_out(name: &str, value: f64, old: Option<&Descriptor>, new: &Descriptor) -> Option<String> {
    let of = |descriptor: &Descriptor| descriptor.parameters.iter().find(|p| p.name == name).cloned();
    let before = old.and_then(of);
    let unit = before.as_ref().map_or("", |p| p.unit.as_str());
    let said = if unit.is_empty() {
        format!("parameter {name} = {value} was left out:")
    } else {
        format!("parameter {name} = {value} {unit} was left out:")
    };
    let Some(after) = of(new) else {
        return Some(format!("{said} {} has none of this name", new.name));
    };
    if before.is_some_and(|p| p.unit != after.unit) {
        return Some(format!(
            "{said} {} has it in {:?}; it begins with {}",
            new.name, after.unit, after.default
        ));
    }
    let (low, high) = (after.minimum, after.maximum);
    (!(low..=high).contains(&value)).then(|| {
        format!(
            "{said} {} allows {low} to {high}; it begins with {}",
            new.name, after.default
        )
    })
}

/// Keeps what the new component has by the same name: parameters of the same unit whose value is in its range, and ports. An
/// input that it does not have is disconnected; an output is not, for its actuator would be left alone, so the check refuses
/// it.
pub(crate) fn swap(current: &LoopSpec, digest: Digest, old: Option<&Descriptor>, new: &Descriptor) -> Swapped {
    let mut spec = current.clone();
    spec.digest = digest;
    let (mut parameters, mut ports, mut notes) = (Vec::new(), Vec::new(), Vec::new());
    spec.parameters
        .retain(|name, value| match left_out(name, *value, old, new) {
            Some(note) => {
                parameters.push(name.clone());
                notes.push(note);
                false
            }
            None => true,
        });
    spec.ports.retain(|name, _| {
        let keep = new.port(name).is_some() || current.limits.contains_key(name);
        // A port that neither component knows is for the check to complain about.
        let keep = keep || old.is_some_and(|old| old.port(name).is_none());
        if !keep {
            ports.push(name.clone());
            notes.push(format!(
                "port {name} was disconnected: {} has none of this name",
                new.name
            ));
        }
        keep
    });
    Swapped {
        spec,
        parameters,
        ports,
        notes,
    }
}

/// A running loop's specification with other parameters or another strategy.
pub(crate) fn set(current: &LoopSpec, change: &Change) -> LoopSpec {
    let mut spec = current.clone();
    spec.parameters
        .extend(change.parameters.iter().map(|(name, value)| (name.clone(), *value)));
    if let Some(strategy) = change.strategy {
        spec.strategy = strategy;
    }
    spec
}

/// Do two specifications say the same, whatever their numbers?
pub(crate) fn same(a: &LoopSpec, b: &LoopSpec) -> bool {
    let mut b = b.clone();
    b.revision = a.revision;
    *a == b
}
