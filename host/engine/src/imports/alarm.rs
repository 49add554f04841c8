//! The controller's own alarms: raised and cleared with the step's other effects.

use bumpless_core::{
    AlarmChange, Priority,
    limits::{ALARM_CHANGES_PER_STEP_MAX, NAME_CHARS_MAX, TEXT_CHARS_MAX},
};

use super::{in_step, limit};
use crate::{bindings::bumpless::control::alarm, convert, sandbox::Sandbox};

impl alarm::Host for Sandbox {
    fn raise(&mut self, name: String, priority: alarm::Priority, text: String) -> wasmtime::Result<()> {
        if text.chars().count() > TEXT_CHARS_MAX {
            return limit(format!("an alarm text of more than {TEXT_CHARS_MAX} characters"));
        }
        change(self, name, Some((convert::priority(priority), text)))
    }

    fn clear(&mut self, name: String) -> wasmtime::Result<()> {
        change(self, name, None)
    }
}

fn change(sandbox: &mut Sandbox, name: String, raised: Option<(Priority, String)>) -> wasmtime::Result<()> {
    in_step(sandbox, "change an alarm")?;
    if name.is_empty() || name.chars().count() > NAME_CHARS_MAX {
        return limit(format!("an alarm's name has 1 to {NAME_CHARS_MAX} characters"));
    }
    if sandbox.alarms.len() >= ALARM_CHANGES_PER_STEP_MAX {
        return limit(format!(
            "more than {ALARM_CHANGES_PER_STEP_MAX} alarm changes in one step"
        ));
    }
    sandbox.alarms.push(AlarmChange { name, raised });
    Ok(())
}
