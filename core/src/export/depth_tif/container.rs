//! The TIFF container: header and image file directories, little endian, classic or big.

/// Which TIFF.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Container {
    /// TIFF 6.0: places are 32 bits, up to 4 GB.
    Classic,
    /// BigTIFF: places are 64 bits.
    Big,
}

/// A tag and its value.
pub(super) struct Entry(pub u16, pub Value);

/// What a tag holds.
pub(super) enum Value {
    /// 16 bits.
    Short(Vec<u16>),
    /// 32 bits.
    Long(Vec<u32>),
    /// Places in the file: as wide as the container needs.
    Place(Vec<u64>),
    /// Floating point.
    Double(Vec<f64>),
    /// ASCII; the final zero is added.
    Text(String),
}

impl Value {
    /// The field type's number, the count and the bytes.
    fn encode(&self, container: Container) -> (u16, u64, Vec<u8>) {
        match self {
            Value::Short(v) => (3, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Value::Long(v) => (4, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Value::Place(v) if container == Container::Big => {
                (16, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Value::Place(v) => (4, v.len() as u64, v.iter().flat_map(|x| (*x as u32).to_le_bytes()).collect()),
            Value::Double(v) => (12, v.len() as u64, v.iter().flat_map(|x| x.to_le_bytes()).collect()),
            Value::Text(text) => (2, text.len() as u64 + 1, [text.as_bytes(), &[0]].concat()),
        }
    }
}

impl Container {
    /// Writes a count or a place in the container's width.
    fn wide(self, value: u64) -> Vec<u8> {
        match self {
            Container::Classic => (value as u32).to_le_bytes().to_vec(),
            Container::Big => value.to_le_bytes().to_vec(),
        }
    }

    fn header(self) -> Vec<u8> {
        match self {
            Container::Classic => [b"II\x2a\0".as_slice(), &8_u32.to_le_bytes()].concat(),
            Container::Big => [b"II\x2b\0\x08\0\0\0".as_slice(), &16_u64.to_le_bytes()].concat(),
        }
    }
}

/// Header and directories, one after the other, each followed by the values that do not fit into it.
pub(super) fn bytes(container: Container, directories: &[Vec<Entry>]) -> Vec<u8> {
    let mut all = container.header();
    for (index, entries) in directories.iter().enumerate() {
        let directory = directory(container, entries, all.len(), index + 1 == directories.len());
        all.extend(directory);
    }
    all
}

fn directory(container: Container, entries: &[Entry], start: usize, last: bool) -> Vec<u8> {
    let (count_bytes, entry_bytes, inline_bytes) = match container {
        Container::Classic => (2, 12, 4),
        Container::Big => (8, 20, 8),
    };
    let mut sorted: Vec<&Entry> = entries.iter().collect();
    sorted.sort_by_key(|entry| entry.0);
    let table_bytes = count_bytes + entry_bytes * sorted.len() + inline_bytes;
    let mut table = match container {
        Container::Classic => (sorted.len() as u16).to_le_bytes().to_vec(),
        Container::Big => (sorted.len() as u64).to_le_bytes().to_vec(),
    };
    let mut values: Vec<u8> = Vec::new();
    for Entry(tag, value) in sorted {
        let (kind, count, mut bytes) = value.encode(container);
        table.extend(tag.to_le_bytes());
        table.extend(kind.to_le_bytes());
        table.extend(container.wide(count));
        if bytes.len() <= inline_bytes {
            bytes.resize(inline_bytes, 0);
            table.extend(bytes);
        } else {
            table.extend(container.wide((start + table_bytes + values.len()) as u64));
            values.extend(bytes);
            // Every value and every directory begins at an even place.
            values.resize(values.len().next_multiple_of(2), 0);
        }
    }
    let end = start + table_bytes + values.len();
    table.extend(container.wide(if last { 0 } else { end as u64 }));
    table.extend(values);
    table
}
