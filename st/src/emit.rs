//! From a checked program to a component: the module, its memory, its functions and names.
//!
//! ```text
//!   address   what
//!   16        what a call returns: 16 bytes
//!   32        a reading: 32 bytes
//!   64        the descriptor, texts, the first state, tables     (never written)
//!             first values of all frames                         (never written)
//!             frames
//!             from here: what the host hands in, and the states that go out; given back after each call
//! ```
//! Nothing that a call leaves in memory is read by a later one: frames are filled from their first values, and globals are set by
//! each step. So any replica may step, and a fresh instance gives the same answer.
//! Never: finds anything wrong with a text; only a state that is too large is said here.

mod body;
mod fixed;
mod lines;
mod operation;
mod state;
mod world;

use std::borrow::Cow;

use wasm_encoder::{
    BlockType, CodeSection, ConstExpr, CustomSection, DataSection, EntityType, ExportKind, ExportSection, Function,
    FunctionSection, GlobalSection, GlobalType, ImportSection, Instruction, MemArg, MemorySection, MemoryType, Module,
    NameMap, NameSection, TypeSection, ValType,
};
use wit_component::{ComponentEncoder, StringEncoding, embed_component_metadata};
use wit_parser::Resolve;

use crate::{ast::PouKind, check::Checked, error::Error, types::Scalar};

pub(crate) use lines::Text;
pub(crate) use state::Layout;

/// Where a call's result lies.
const RESULT_AT: i32 = 16;
/// Where a reading lies.
const READING_AT: i32 = 32;
/// Where constant data begins.
const DATA_AT: u32 = 64;
/// Bytes of a page.
const PAGE: u64 = 65_536;

/// Globals by their number.
#[derive(Debug, Clone, Copy)]
#[repr(u32)]
enum Global {
    Heap,
    Fault,
    Setpoint,
    Automatic,
    Track,
    First,
    Dt,
    Cycle,
    Clock,
    Parameters,
}

const GLOBALS: [ValType; 10] = [
    ValType::I32,
    ValType::I32,
    ValType::F64,
    ValType::I32,
    ValType::I32,
    ValType::I32,
    ValType::I64,
    ValType::I64,
    ValType::I64,
    ValType::I32,
];

/// The functions that a component imports.
const READ: u32 = 0;
const WRITE: u32 = 1;
const IMPORTS: u32 = 2;

/// Code of one function that is being written.
#[derive(Debug, Default)]
struct Code {
    parameters: Vec<ValType>,
    results: Vec<ValType>,
    locals: Vec<ValType>,
    instructions: Vec<Instruction<'static>>,
    /// Blocks that are open.
    depth: u32,
    /// Number of an instruction, and the place in the text from which on it and those behind it come.
    marks: Vec<(usize, u32)>,
}

impl Code {
    fn new(parameters: &[ValType], results: &[ValType]) -> Self {
        Self {
            parameters: parameters.to_vec(),
            results: results.to_vec(),
            ..Self::default()
        }
    }

    fn push(&mut self, instruction: Instruction<'static>) {
        match instruction {
            Instruction::Block(_) | Instruction::Loop(_) | Instruction::If(_) => self.depth += 1,
            Instruction::End => self.depth = self.depth.saturating_sub(1),
            _ => {}
        }
        self.instructions.push(instruction);
    }

    fn all<const N: usize>(&mut self, instructions: [Instruction<'static>; N]) {
        for instruction in instructions {
            self.push(instruction);
        }
    }

    /// A new local; gives its number.
    fn local(&mut self, ty: ValType) -> u32 {
        self.locals.push(ty);
        (self.parameters.len() + self.locals.len() - 1) as u32
    }

    /// Opens a block; gives what [`Code::branch`] takes.
    fn block(&mut self) -> u32 {
        self.push(Instruction::Block(BlockType::Empty));
        self.depth
    }

    fn repeat(&mut self) -> u32 {
        self.push(Instruction::Loop(BlockType::Empty));
        self.depth
    }

    fn when(&mut self) {
        self.push(Instruction::If(BlockType::Empty));
    }

    fn end(&mut self) {
        self.push(Instruction::End);
    }

    fn branch(&mut self, label: u32) {
        let up = self.depth - label;
        self.push(Instruction::Br(up));
    }

    fn branch_if(&mut self, label: u32) {
        let up = self.depth - label;
        self.push(Instruction::BrIf(up));
    }

    fn int(&mut self, value: u32) {
        self.push(Instruction::I32Const(value as i32));
    }

    fn get(&mut self, local: u32) {
        self.push(Instruction::LocalGet(local));
    }

    fn set(&mut self, local: u32) {
        self.push(Instruction::LocalSet(local));
    }

    fn global(&mut self, global: Global) {
        self.push(Instruction::GlobalGet(global as u32));
    }

    fn set_global(&mut self, global: Global) {
        self.push(Instruction::GlobalSet(global as u32));
    }

    fn copy(&mut self) {
        self.push(Instruction::MemoryCopy { src_mem: 0, dst_mem: 0 });
    }

    fn load(&mut self, scalar: Scalar, offset: u32) {
        let at = at(offset);
        self.push(match scalar {
            Scalar::Bool | Scalar::Usint | Scalar::Byte => Instruction::I32Load8U(at),
            Scalar::Sint => Instruction::I32Load8S(at),
            Scalar::Int => Instruction::I32Load16S(at),
            Scalar::Uint | Scalar::Word => Instruction::I32Load16U(at),
            Scalar::Dint | Scalar::Udint | Scalar::Dword => Instruction::I32Load(at),
            Scalar::Real => Instruction::F32Load(at),
            Scalar::Lreal => Instruction::F64Load(at),
            Scalar::Lint | Scalar::Ulint | Scalar::Lword | Scalar::Time => Instruction::I64Load(at),
        });
    }

    fn store(&mut self, scalar: Scalar, offset: u32) {
        let at = at(offset);
        self.push(match scalar.bits() {
            8 => Instruction::I32Store8(at),
            16 => Instruction::I32Store16(at),
            32 if scalar == Scalar::Real => Instruction::F32Store(at),
            32 => Instruction::I32Store(at),
            _ if scalar == Scalar::Lreal => Instruction::F64Store(at),
            _ => Instruction::I64Store(at),
        });
    }

    fn mark(&mut self, place: u32) {
        self.marks.push((self.instructions.len(), place));
    }

    /// The function, and its marks with offsets in bytes.
    fn function(&self) -> (Function, Vec<(u32, u32)>) {
        let mut function = Function::new_with_locals_types(self.locals.iter().copied());
        let mut marks = self.marks.iter().peekable();
        let mut places: Vec<(u32, u32)> = Vec::new();
        for (n, instruction) in self.instructions.iter().enumerate() {
            // Of marks at one instruction the innermost counts.
            while let Some((_, place)) = marks.next_if(|(at, _)| *at == n) {
                let offset = function.byte_len() as u32;
                places.pop_if(|(last, _)| *last == offset);
                places.push((offset, *place));
            }
            function.instruction(instruction);
        }
        function.instruction(&Instruction::End);
        (function, places)
    }
}

/// Memory access without a promise of alignment: values lie packed.
const fn at(offset: u32) -> MemArg {
    MemArg {
        offset: offset as u64,
        align: 0,
        memory_index: 0,
    }
}

const fn val_type(scalar: Scalar) -> ValType {
    match scalar {
        Scalar::Real => ValType::F32,
        Scalar::Lreal => ValType::F64,
        Scalar::Lint | Scalar::Ulint | Scalar::Lword | Scalar::Time => ValType::I64,
        _ => ValType::I32,
    }
}

/// Constant data that is being laid out.
#[derive(Debug)]
struct Data {
    bytes: Vec<u8>,
}

impl Data {
    /// Puts bytes behind the others; gives their address.
    fn put(&mut self, bytes: &[u8]) -> u32 {
        while !self.bytes.len().is_multiple_of(8) {
            self.bytes.push(0);
        }
        let address = DATA_AT + self.bytes.len() as u32;
        self.bytes.extend_from_slice(bytes);
        address
    }

    /// Address and length of a text, as the interface passes it.
    fn text(&mut self, text: &str) -> [u8; 8] {
        let address = if text.is_empty() { 0 } else { self.put(text.as_bytes()) };
        pair(address, text.len() as u32)
    }
}

fn pair(a: u32, b: u32) -> [u8; 8] {
    (u64::from(a) | (u64::from(b) << 32)).to_le_bytes()
}

/// Functions that are written, in the order of their numbers.
#[derive(Debug, Default)]
struct Functions {
    codes: Vec<(String, Code)>,
    /// Names under which functions are exported.
    exports: Vec<(String, u32)>,
}

impl Functions {
    fn add(&mut self, name: &str, code: Code) -> u32 {
        self.codes.push((name.to_owned(), code));
        IMPORTS + self.codes.len() as u32 - 1
    }

    fn export(&mut self, name: &str, export: &str, code: Code) {
        let number = self.add(name, code);
        self.exports.push((export.to_owned(), number));
    }
}

/// What functions need to know of each other and of memory.
#[derive(Debug)]
struct Plan<'a> {
    checked: &'a Checked<'a>,
    fixed: fixed::Fixed,
    /// Numbers of the functions of POUs; none where one is not reached.
    pous: Vec<Option<u32>>,
    /// Address of the first values of all frames.
    templates: u32,
    /// Address of all frames.
    frames: u32,
}

/// Writes the component, with lines where its text is given. Gives its bytes and what lies in its state.
pub(crate) fn emit(checked: &Checked<'_>, text: Option<Text<'_>>) -> Result<(Vec<u8>, Layout), Error> {
    let layout = Layout::of(checked)?;
    let mut data = Data { bytes: Vec::new() };
    let tables = world::Tables::put(&mut data, checked, &layout);
    let templates = data.put(&checked.frames);
    let frames = data.put(&[]);
    let heap = (frames + checked.frames.len() as u32).next_multiple_of(16);
    data.bytes.truncate((frames - DATA_AT) as usize);

    let mut functions = Functions::default();
    let fixed = fixed::Fixed::add(&mut functions, heap);
    let first = IMPORTS + functions.codes.len() as u32;
    let reached = checked.pous.iter().scan(first, |next, pou| {
        Some(pou.body.as_ref().map(|_| {
            *next += 1;
            *next - 1
        }))
    });
    let plan = Plan {
        checked,
        fixed,
        pous: reached.collect(),
        templates,
        frames,
    };
    for (number, pou) in checked.pous.iter().enumerate() {
        if pou.body.is_some() {
            functions.add(&pou.ast.name.upper, body::code(&plan, number));
        }
    }
    world::add(&mut functions, &plan, &layout, &tables);
    let module = module(&functions, &data, heap, &layout.form, text)?;
    Ok((component(module)?, layout))
}

fn module(functions: &Functions, data: &Data, heap: u32, form: &str, text: Option<Text<'_>>) -> Result<Vec<u8>, Error> {
    let mut types = TypeSection::new();
    let mut imports = ImportSection::new();
    types.ty().function([ValType::I32, ValType::I32], []);
    types.ty().function([ValType::I32, ValType::F64], []);
    let io = "bumpless:control/io@0.1.0";
    imports.import(io, "read", EntityType::Function(READ));
    imports.import(io, "write", EntityType::Function(WRITE));

    let mut section = FunctionSection::new();
    let mut codes = CodeSection::new();
    let mut names = NameMap::new();
    for (n, (name, code)) in functions.codes.iter().enumerate() {
        let number = IMPORTS + n as u32;
        types
            .ty()
            .function(code.parameters.iter().copied(), code.results.iter().copied());
        section.function(number);
        names.append(number, name);
    }
    let mut memories = MemorySection::new();
    memories.memory(MemoryType {
        // One page beside the data: states and parameters mostly fit without growing.
        minimum: u64::from(heap).div_ceil(PAGE) + 1,
        maximum: None,
        memory64: false,
        shared: false,
        page_size_log2: None,
    });
    let mut globals = GlobalSection::new();
    for (n, ty) in GLOBALS.iter().enumerate() {
        let init = match ty {
            ValType::F64 => ConstExpr::f64_const(0.0.into()),
            ValType::I64 => ConstExpr::i64_const(0),
            _ if n == Global::Heap as usize => ConstExpr::i32_const(heap as i32),
            _ => ConstExpr::i32_const(0),
        };
        let ty = GlobalType {
            val_type: *ty,
            mutable: true,
            shared: false,
        };
        globals.global(ty, &init);
    }
    let mut exports = ExportSection::new();
    exports.export("memory", ExportKind::Memory, 0);
    for (name, number) in &functions.exports {
        exports.export(name, ExportKind::Func, *number);
    }
    let mut segments = DataSection::new();
    segments.active(0, &ConstExpr::i32_const(DATA_AT as i32), data.bytes.iter().copied());
    let leb = |number: usize| (usize::BITS - number.leading_zeros()).div_ceil(7).max(1) as usize;
    let mut stretches = Vec::new();
    for (name, code) in &functions.codes {
        let (function, marks) = code.function();
        // Behind the number of functions, the functions before, and the length of this one.
        let begin = leb(functions.codes.len()) + codes.byte_len() + leb(function.byte_len());
        let at = |offset: usize| (begin + offset) as u32;
        if !marks.is_empty() {
            stretches.push(lines::Stretch {
                name: name.clone(),
                begin: at(0),
                end: at(function.byte_len()),
                marks: marks
                    .into_iter()
                    .map(|(offset, place)| (at(offset as usize), place))
                    .collect(),
            });
        }
        codes.function(&function);
    }
    let mut name_section = NameSection::new();
    name_section.functions(&names);
    let mut module = Module::new();
    module
        .section(&types)
        .section(&imports)
        .section(&section)
        .section(&memories)
        .section(&globals)
        .section(&exports)
        .section(&codes)
        .section(&segments)
        .section(&name_section)
        .section(&CustomSection {
            name: state::FORM_SECTION.into(),
            data: form.as_bytes().into(),
        });
    if let Some(text) = text {
        let sections = lines::sections(text, &stretches).map_err(|error| Error::Encode(error.to_string().into()))?;
        for (name, data) in &sections {
            module.section(&CustomSection {
                name: (*name).into(),
                data: data.as_slice().into(),
            });
        }
    }
    Ok(module.finish())
}

/// The module with the world's types around it.
fn component(mut module: Vec<u8>) -> Result<Vec<u8>, Error> {
    let failed = |error: &dyn std::fmt::Display| Error::Encode(Cow::Owned(format!("{error:#}")));
    let mut resolve = Resolve::default();
    let package = resolve
        .push_source("control.wit", include_str!("../../wit/control.wit"))
        .map_err(|error| failed(&error))?;
    let world = resolve
        .select_world(&[package], Some("controller"))
        .map_err(|error| failed(&error))?;
    embed_component_metadata(&mut module, &resolve, world, StringEncoding::UTF8).map_err(|error| failed(&error))?;
    ComponentEncoder::default()
        .module(&module)
        .map(|encoder| encoder.validate(true))
        .and_then(ComponentEncoder::encode)
        .map_err(|error| failed(&error))
}

/// Is it a function, whose code gives a value?
const fn is_function(kind: PouKind) -> bool {
    matches!(kind, PouKind::Function)
}
