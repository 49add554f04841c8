//! The form of a Parquet file with flat columns of whole numbers and numbers: one page for each column of each row group.
//!
//! Owns: those bytes, after the Apache Parquet format 2.10 (`parquet.thrift`, `Encodings.md`) and the Thrift compact protocol: data
//! pages of version 1, plain values, definition levels as one bit-packed run, each page as a raw LZ4 block.
//! Never: reads one; that other programs do is tested with one of them.
//!
//! ```text
//! "PAR1" | row group: page of column 1 | page of column 2 | … | next row group … | metadata | its length (4) | "PAR1"
//! ```

/// First and last bytes of a file.
const MAGIC: &[u8; 4] = b"PAR1";

/// `Type`: INT64, DOUBLE.
const INT64: i64 = 2;
const DOUBLE: i64 = 5;
/// `CompressionCodec`: LZ4_RAW.
const LZ4_RAW: i64 = 7;
/// `Encoding`: PLAIN, RLE.
const PLAIN: i64 = 0;
const RLE: i64 = 3;
/// `ConvertedType`: TIMESTAMP_MICROS.
const TIMESTAMP_MICROS: i64 = 10;

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Times in µs since 1970, UTC.
    Time,
    /// Whole numbers.
    Whole,
    /// Numbers.
    Number,
    /// Numbers, or nothing.
    MaybeNumber,
}

/// A column's values in one row group.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Values {
    /// Times, or whole numbers.
    Whole(Vec<i64>),
    /// Numbers.
    Number(Vec<f64>),
    /// Numbers, or nothing.
    MaybeNumber(Vec<Option<f64>>),
}

/// One page, as the metadata names it.
#[derive(Debug)]
struct Chunk {
    at: i64,
    plain_bytes: i64,
    bytes: i64,
}

/// A file on its way.
#[derive(Debug)]
pub(crate) struct File {
    columns: Vec<(String, Kind)>,
    groups: Vec<(i64, Vec<Chunk>)>,
    /// Bytes so far.
    at: i64,
}

impl File {
    /// A file with these columns, and its first bytes.
    pub(crate) fn begin(columns: Vec<(String, Kind)>) -> (Self, Vec<u8>) {
        let file = Self {
            columns,
            groups: Vec::new(),
            at: MAGIC.len() as i64,
        };
        (file, MAGIC.to_vec())
    }

    /// A row group: values of each column, all of one length. Gives its bytes.
    pub(crate) fn put(&mut self, rows: usize, values: &[Values]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut chunks = Vec::with_capacity(values.len());
        for values in values {
            let plain = page(values);
            let packed = lz4_flex::block::compress(&plain);
            let mut header = Thrift::default();
            header.int(1, 0);
            header.int(2, plain.len() as i64);
            header.int(3, packed.len() as i64);
            header.open(5);
            header.int(1, rows as i64);
            header.int(2, PLAIN);
            header.int(3, RLE);
            header.int(4, RLE);
            header.close();
            let header = header.end();
            chunks.push(Chunk {
                at: self.at + bytes.len() as i64,
                plain_bytes: (header.len() + plain.len()) as i64,
                bytes: (header.len() + packed.len()) as i64,
            });
            bytes.extend(header);
            bytes.extend(packed);
        }
        self.groups.push((rows as i64, chunks));
        self.at += bytes.len() as i64;
        bytes
    }

    /// The end of the file.
    pub(crate) fn end(self) -> Vec<u8> {
        let mut meta = Thrift::default();
        meta.int(1, 2);
        meta.list(2, STRUCT, self.columns.len() + 1);
        meta.element();
        meta.text(4, "history");
        meta.int(5, self.columns.len() as i64);
        meta.close();
        for (name, kind) in &self.columns {
            column(&mut meta, name, *kind);
        }
        meta.long(3, self.groups.iter().map(|(rows, _)| rows).sum());
        meta.list(4, STRUCT, self.groups.len());
        for (rows, chunks) in &self.groups {
            meta.element();
            meta.list(1, STRUCT, chunks.len());
            for (chunk, (name, kind)) in chunks.iter().zip(&self.columns) {
                meta.element();
                meta.long(2, chunk.at);
                meta.open(3);
                meta.int(1, kind.physical());
                meta.list(2, I32, 2);
                meta.zigzag(PLAIN);
                meta.zigzag(RLE);
                meta.list(3, BINARY, 1);
                meta.bytes(name.as_bytes());
                meta.int(4, LZ4_RAW);
                meta.long(5, *rows);
                meta.long(6, chunk.plain_bytes);
                meta.long(7, chunk.bytes);
                meta.long(9, chunk.at);
                meta.close();
                meta.close();
            }
            meta.long(2, chunks.iter().map(|chunk| chunk.plain_bytes).sum());
            meta.long(3, *rows);
            meta.close();
        }
        meta.text(6, concat!("bumpless version ", env!("CARGO_PKG_VERSION")));
        let mut bytes = meta.end();
        let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        bytes.extend(length.to_le_bytes());
        bytes.extend(MAGIC);
        bytes
    }
}

impl Kind {
    const fn physical(self) -> i64 {
        match self {
            Self::Time | Self::Whole => INT64,
            Self::Number | Self::MaybeNumber => DOUBLE,
        }
    }
}

/// A `SchemaElement`.
fn column(meta: &mut Thrift, name: &str, kind: Kind) {
    meta.element();
    meta.int(1, kind.physical());
    meta.int(3, i64::from(kind == Kind::MaybeNumber));
    meta.text(4, name);
    if kind == Kind::Time {
        meta.int(6, TIMESTAMP_MICROS);
        // LogicalType: TIMESTAMP { isAdjustedToUTC: true, unit: MICROS {} }.
        meta.open(10);
        meta.open(8);
        meta.yes(1);
        meta.open(2);
        meta.open(2);
        meta.close();
        meta.close();
        meta.close();
        meta.close();
    }
    meta.close();
}

/// A page before compression: which values are there, then those.
fn page(values: &Values) -> Vec<u8> {
    match values {
        Values::Whole(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::Number(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::MaybeNumber(values) => {
            let groups = values.len().div_ceil(8);
            let mut levels = Vec::with_capacity(groups + 5);
            varint(&mut levels, (groups as u64) << 1 | 1);
            for eight in values.chunks(8) {
                let bits = eight
                    .iter()
                    .enumerate()
                    .map(|(i, value)| u8::from(value.is_some()) << i);
                levels.push(bits.fold(0, |byte, bit| byte | bit));
            }
            let length = u32::try_from(levels.len()).unwrap_or(u32::MAX);
            let mut page = length.to_le_bytes().to_vec();
            page.extend(levels);
            page.extend(values.iter().flatten().flat_map(|value| value.to_le_bytes()));
            page
        }
    }
}

fn varint(bytes: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        bytes.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
}

/// Types of the compact protocol.
const TRUE: u8 = 1;
const I32: u8 = 5;
const I64: u8 = 6;
const BINARY: u8 = 8;
const LIST: u8 = 9;
const STRUCT: u8 = 12;

/// A struct of the compact protocol on its way; structs within it are opened and closed.
#[derive(Default)]
struct Thrift {
    bytes: Vec<u8>,
    /// The last field of each struct that is open; the outermost is always.
    last: Vec<u8>,
    outer: u8,
}

impl Thrift {
    fn field(&mut self, id: u8, kind: u8) {
        let last = self.last.last_mut().unwrap_or(&mut self.outer);
        // All fields are numbered upwards, by less than sixteen.
        self.bytes.push(id.saturating_sub(*last) << 4 | kind);
        *last = id;
    }

    fn zigzag(&mut self, value: i64) {
        varint(&mut self.bytes, (value << 1 ^ value >> 63) as u64);
    }

    fn int(&mut self, id: u8, value: i64) {
        self.field(id, I32);
        self.zigzag(value);
    }

    fn long(&mut self, id: u8, value: i64) {
        self.field(id, I64);
        self.zigzag(value);
    }

    fn yes(&mut self, id: u8) {
        self.field(id, TRUE);
    }

    fn bytes(&mut self, bytes: &[u8]) {
        varint(&mut self.bytes, bytes.len() as u64);
        self.bytes.extend(bytes);
    }

    fn text(&mut self, id: u8, text: &str) {
        self.field(id, BINARY);
        self.bytes(text.as_bytes());
    }

    fn list(&mut self, id: u8, kind: u8, length: usize) {
        self.field(id, LIST);
        match u8::try_from(length) {
            Ok(length) if length < 15 => self.bytes.push(length << 4 | kind),
            _ => {
                self.bytes.push(0xf0 | kind);
                varint(&mut self.bytes, length as u64);
            }
        }
    }

    /// A struct as a field.
    fn open(&mut self, id: u8) {
        self.field(id, STRUCT);
        self.last.push(0);
    }

    /// A struct as an entry of a list.
    fn element(&mut self) {
        self.last.push(0);
    }

    fn close(&mut self) {
        self.bytes.push(0);
        self.last.pop();
    }

    fn end(mut self) -> Vec<u8> {
        self.bytes.push(0);
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_as_the_protocol_has_them() {
        let mut thrift = Thrift::default();
        thrift.int(1, -3);
        thrift.long(4, 150);
        thrift.open(5);
        thrift.yes(1);
        thrift.close();
        thrift.list(6, I32, 20);
        // Field 1 i32 zigzag 5; field 4 i64 300; field 5 struct, field 1 true, stop; field 6 long list of i32; stop.
        let wanted = [0x15, 5, 0x36, 0xac, 2, 0x1c, 0x11, 0, 0x19, 0xf5, 20, 0];
        assert_eq!(thrift.end(), wanted);
    }

    #[test]
    fn nothing_is_a_bit_and_no_value() {
        let values: Vec<Option<f64>> = (0..10).map(|i| (i % 3 == 0).then_some(f64::from(i))).collect();
        let page = page(&Values::MaybeNumber(values));
        // Length 3; two groups of eight in one bit-packed run; values 0, 3, 6 and 9.
        assert_eq!(page[..7], [3, 0, 0, 0, 5, 0b0100_1001, 0b0000_0010]);
        assert_eq!(page.len(), 7 + 4 * 8);
        assert_eq!(page[7 + 8..7 + 16], 3.0_f64.to_le_bytes());
    }

    #[test]
    fn places_are_those_of_the_pages() {
        let columns = vec![("time".to_owned(), Kind::Time), ("value".to_owned(), Kind::MaybeNumber)];
        let (mut file, mut bytes) = File::begin(columns);
        for _ in 0..2 {
            let values = [Values::Whole(vec![1, 2]), Values::MaybeNumber(vec![None, Some(1.5)])];
            bytes.extend(file.put(2, &values));
        }
        assert_eq!(file.at as usize, bytes.len());
        for (_, chunks) in &file.groups {
            for chunk in chunks {
                // A page's header begins with its type: field 1, i32 0.
                assert_eq!(bytes[chunk.at as usize..chunk.at as usize + 2], [0x15, 0]);
            }
        }
        let end = file.end();
        let length = end.len() - 8;
        assert_eq!(
            end[length..length + 4],
            u32::try_from(length).unwrap_or(0).to_le_bytes()
        );
        assert!(end.ends_with(MAGIC));
    }
}
