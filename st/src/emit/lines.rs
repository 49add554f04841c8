//! Which line of the text each instruction comes from, as DWARF 4 says it: what debuggers and the sandbox's tools read.
//!
//! Addresses are offsets in the code section, as "DWARF for WebAssembly" has it. Never: part of a component that is not asked for
//! with lines.

use gimli::{
    DW_AT_high_pc, DW_AT_low_pc, DW_AT_name, DW_AT_stmt_list, DW_TAG_subprogram, Encoding, Format, LineEncoding,
    LittleEndian,
    write::{Address, AttributeValue, DwarfUnit, EndianVec, LineProgram, LineString, Sections},
};

/// Code of one function: where it lies, and what text stands for which part of it.
#[derive(Debug)]
pub(super) struct Stretch {
    pub(super) name: String,
    pub(super) begin: u32,
    pub(super) end: u32,
    /// Offset in the code section, place in the text; both grow.
    pub(super) marks: Vec<(u32, u32)>,
}

/// The text that was compiled.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Text<'a> {
    /// What its file is called.
    pub(crate) file: &'a str,
    pub(crate) source: &'a str,
}

/// The sections, by their names.
///
/// # Errors
/// In the words of who writes them.
pub(super) fn sections(
    text: Text<'_>,
    stretches: &[Stretch],
) -> Result<Vec<(&'static str, Vec<u8>)>, gimli::write::Error> {
    let encoding = Encoding {
        address_size: 4,
        format: Format::Dwarf32,
        version: 4,
    };
    // What a version before 5 does not take: a name that is empty, or has a zero.
    let file = text.file.replace('\0', "");
    let file = if file.is_empty() { "program.st" } else { file.as_str() };
    let string = |text: &str| LineString::String(text.as_bytes().to_vec());
    let program = LineProgram::new(encoding, LineEncoding::default(), string("."), None, string(file), None);
    let mut dwarf = DwarfUnit::new(encoding);
    dwarf.unit.line_program = program;
    let program = &mut dwarf.unit.line_program;
    let id = program.add_file(string(file), program.default_directory(), None);
    let begins: Vec<u32> = std::iter::once(0)
        .chain(
            text.source
                .bytes()
                .enumerate()
                .filter(|(_, byte)| *byte == b'\n')
                .map(|(at, _)| at as u32 + 1),
        )
        .collect();
    for stretch in stretches {
        program.begin_sequence(Some(Address::Constant(u64::from(stretch.begin))));
        for (offset, place) in &stretch.marks {
            let line = begins.partition_point(|begin| begin <= place) as u64;
            let row = program.row();
            row.address_offset = u64::from(offset.saturating_sub(stretch.begin));
            row.file = id;
            row.line = line;
            program.generate_row();
        }
        program.end_sequence(u64::from(stretch.end.saturating_sub(stretch.begin)));
    }
    let root = dwarf.unit.root();
    let unit = dwarf.unit.get_mut(root);
    unit.set(DW_AT_name, AttributeValue::String(file.as_bytes().to_vec()));
    unit.set(DW_AT_stmt_list, AttributeValue::LineProgramRef);
    let all = stretches
        .iter()
        .map(|stretch| stretch.begin)
        .min()
        .zip(stretches.iter().map(|stretch| stretch.end).max());
    if let Some((begin, end)) = all {
        unit.set(
            DW_AT_low_pc,
            AttributeValue::Address(Address::Constant(u64::from(begin))),
        );
        unit.set(DW_AT_high_pc, AttributeValue::Udata(u64::from(end - begin)));
    }
    for stretch in stretches {
        let entry = dwarf.unit.add(root, DW_TAG_subprogram);
        let entry = dwarf.unit.get_mut(entry);
        entry.set(DW_AT_name, AttributeValue::String(stretch.name.as_bytes().to_vec()));
        entry.set(
            DW_AT_low_pc,
            AttributeValue::Address(Address::Constant(u64::from(stretch.begin))),
        );
        entry.set(
            DW_AT_high_pc,
            AttributeValue::Udata(u64::from(stretch.end - stretch.begin)),
        );
    }
    let mut sections = Sections::new(EndianVec::new(LittleEndian));
    dwarf.write(&mut sections)?;
    let mut written = Vec::new();
    sections.for_each(|id, data| {
        if !data.slice().is_empty() {
            written.push((id.name(), data.slice().to_vec()));
        }
        Ok::<_, gimli::write::Error>(())
    })?;
    Ok(written)
}
