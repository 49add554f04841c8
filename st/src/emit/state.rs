//! The form of a program's state.
//!
//! ```text
//!   offset      size  what
//!   0           1     mark of components' states: 0xB1
//!   1           1     n, length of the name
//!   2           n     the name
//!   2+n         4     version of the layout
//!   6+n         1     m, number of parameters
//!   7+n         8·m   their values
//!   7+n+8m      4     mark of this compiler's states: "BST1"
//!   …           4     number of entries
//!   …           8     per variable: 48 bits of a hash of its path and type, 16 bits of its length in bytes
//!   …                 the variables, packed, in the order of the entries
//! ```
//! The front is that of the SDK's components. The entries make a state tell of itself what another version needs: `migrate` takes
//! over every variable whose path and type it has too. Never: an address; a state lies wherever the host puts it.

use crate::{
    ast::Retain,
    check::Checked,
    error::Error,
    types::{Scalar, Ty, Types},
};

/// What begins every state of the SDK's form.
pub(super) const MARK: u8 = 0xB1;
/// What begins the part that this compiler writes.
pub(super) const OWN_MARK: u32 = u32::from_le_bytes(*b"BST1");
/// Greatest state, in bytes, as the host has it.
const STATE_MAX: usize = 64 * 1024;
/// The custom section that says what a state consists of: a line `packed 1`, then `name: type` for each value in its order.
pub(super) const FORM_SECTION: &str = "bumpless:state";
/// Of the variables: a clock for timers, then one byte that tells what the next step is.
pub(super) const HIDDEN: u32 = 9;
pub(super) const FLAG_AT: u32 = 8;
/// The flag of a state that `start` made, and of one that `migrate` took over from the same program.
pub(super) const FIRST: u8 = 2;
pub(super) const CHANGED: i32 = 1;

/// How far a variable lives on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub(super) enum Life {
    /// It begins anew.
    Never,
    /// In a program of the same name.
    SameName,
    /// In any program.
    Always,
}

/// One variable in the state.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) word: u64,
    pub(super) offset: u32,
    pub(super) life: Life,
}

/// The form of a program's state.
#[derive(Debug)]
pub(crate) struct Layout {
    /// A number of the entries.
    pub(crate) version: u32,
    /// The first state.
    pub(super) template: Vec<u8>,
    pub(super) entries: Vec<Entry>,
    /// Where the parameters' values lie.
    pub(super) parameters: u32,
    /// Where the variables lie.
    pub(super) variables: u32,
    /// Length of the name.
    pub(super) name: u32,
    /// The variables in words, for who reads a state: the custom section of [`FORM_SECTION`].
    pub(super) form: String,
}

fn fnv(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

struct Leaves<'a> {
    types: &'a Types,
    checked: &'a Checked<'a>,
    entries: Vec<Entry>,
    form: String,
}

/// What a value is called in the form.
fn word(types: &Types, ty: &Ty) -> String {
    match ty {
        Ty::Scalar(Scalar::Bool) => "bool".to_owned(),
        Ty::Scalar(Scalar::Time) => "time".to_owned(),
        Ty::Scalar(scalar) if scalar.is_real() => format!("f{}", scalar.bits()),
        Ty::Scalar(scalar) if scalar.is_int() => {
            format!("{}{}", if scalar.signed() { 'i' } else { 'u' }, scalar.bits())
        }
        Ty::Scalar(scalar) => format!("hex{}", scalar.bits()),
        Ty::Enum(number) => {
            let values = types
                .enumerations
                .get(*number)
                .map(|e| e.values.as_slice())
                .unwrap_or_default();
            let values: Vec<String> = values.iter().map(|(name, value)| format!("{name}={value}")).collect();
            format!("enum({})", values.join(","))
        }
        // Of arrays of structures the bytes are told: the variable that is looked for seldom lies there.
        Ty::Array(array) if types.structure(&array.of).is_none() => {
            let count: u64 = array.ranges.iter().map(|(_, count)| u64::from(*count)).product();
            format!("{count}*{}", word(types, &array.of))
        }
        other => format!("{}*hex8", types.size(other)),
    }
}

impl Leaves<'_> {
    fn leaf(&mut self, path: &str, ty: &Ty, offset: u32, life: Life) {
        let text = format!("{path}:{}", self.types.signature(ty));
        let size = self.types.size(ty);
        let name = path.strip_prefix('.').unwrap_or(path);
        self.form.push_str(&format!("{name}: {}\n", word(self.types, ty)));
        self.entries.push(Entry {
            word: (fnv(&text) & !0xffff) | u64::from(size & 0xffff),
            offset,
            life,
        });
    }

    fn walk(&mut self, path: &str, ty: &Ty, offset: u32, life: Life) {
        let Some(structure) = self.types.structure(ty) else {
            return self.leaf(path, ty, offset, life);
        };
        let retains = match ty {
            Ty::Block(number) => self.checked.pous.get(*number).map(|pou| pou.retains.as_slice()),
            _ => None,
        };
        for (n, field) in structure.fields.iter().enumerate() {
            let own = match retains.and_then(|retains| retains.get(n)) {
                _ if life == Life::Never => Life::Never,
                Some(Retain::Always) => Life::Always,
                Some(Retain::Never) => Life::Never,
                _ => life,
            };
            self.walk(&format!("{path}.{}", field.name), &field.ty, offset + field.offset, own);
        }
    }
}

impl Layout {
    /// Lays the state of a program out.
    ///
    /// # Errors
    /// [`Error::State`] where it is too large for a record.
    pub(super) fn of(checked: &Checked<'_>) -> Result<Self, Error> {
        let interface = &checked.interface;
        let mut leaves = Leaves {
            types: &checked.types,
            checked,
            entries: Vec::new(),
            form: "packed 1\n".to_owned(),
        };
        leaves.leaf("#CLOCK", &Ty::Scalar(Scalar::Time), 0, Life::Always);
        leaves.leaf("#FLAG", &Ty::Scalar(Scalar::Byte), FLAG_AT, Life::Never);
        leaves.walk("", &Ty::Block(checked.program), HIDDEN, Life::SameName);
        let Leaves { entries, form, .. } = leaves;
        let mut all = String::new();
        for entry in &entries {
            all.push_str(&format!("{:016x}", entry.word));
        }
        // Never 0, which plants have.
        let version = (fnv(&all) >> 32) as u32 | 1;

        let name = interface.name.as_bytes();
        let mut template = vec![MARK, name.len() as u8];
        template.extend_from_slice(name);
        template.extend_from_slice(&version.to_le_bytes());
        template.push(interface.parameters.len() as u8);
        let parameters = template.len() as u32;
        for parameter in &interface.parameters {
            template.extend_from_slice(&parameter.default.to_le_bytes());
        }
        template.extend_from_slice(&OWN_MARK.to_le_bytes());
        template.extend_from_slice(&(entries.len() as u32).to_le_bytes());
        for entry in &entries {
            template.extend_from_slice(&entry.word.to_le_bytes());
        }
        let variables = template.len() as u32;
        template.extend_from_slice(&0_i64.to_le_bytes());
        template.push(FIRST);
        if let Some(program) = checked.types.blocks.get(checked.program) {
            for field in &program.fields {
                template.extend_from_slice(&field.init);
            }
        }
        if template.len() > STATE_MAX {
            return Err(Error::State {
                bytes: template.len(),
                max: STATE_MAX,
            });
        }
        Ok(Self {
            version,
            template,
            entries,
            parameters,
            variables,
            name: name.len() as u32,
            form,
        })
    }

    /// Length of a state.
    pub(crate) const fn bytes(&self) -> usize {
        self.template.len()
    }
}
