//! What an image of the firmware holds: its symbols, and the memory it takes.

/// The parts of an ELF image (32 bits, little-endian) that the tests look at.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Image {
    /// The names of its symbols, as the compiler mangled them.
    pub symbols: Vec<String>,
    /// Bytes of flash.
    pub flash: usize,
    /// Bytes of RAM that are taken before the stack.
    pub ram: usize,
}

const SYMBOL_TABLE: usize = 2;
const NO_BITS: usize = 8;
const WRITABLE: usize = 1;
const ALLOCATED: usize = 2;
const SYMBOL_BYTES: usize = 16;

impl Image {
    /// Reads an image; `None` if it is not one.
    pub fn parse(elf: &[u8]) -> Option<Self> {
        if !elf.starts_with(b"\x7FELF\x01\x01") {
            return None;
        }
        let (table, entry, count) = (word(elf, 32)?, half(elf, 46)?, half(elf, 48)?);
        let sections = (0..count)
            .map(|index| Section::parse(elf, table.checked_add(index.checked_mul(entry)?)?))
            .collect::<Option<Vec<_>>>()?;
        let mut image = Self::default();
        for section in &sections {
            if section.flags & ALLOCATED != 0 {
                image.flash += if section.kind == NO_BITS { 0 } else { section.size };
                image.ram += if section.flags & WRITABLE == 0 { 0 } else { section.size };
            }
            if section.kind == SYMBOL_TABLE {
                let names = sections.get(section.link)?.bytes(elf)?;
                for symbol in section.bytes(elf)?.chunks_exact(SYMBOL_BYTES) {
                    let name = names.get(word(symbol, 0)?..)?.split(|&byte| byte == 0).next()?;
                    image.symbols.push(String::from_utf8_lossy(name).into_owned());
                }
            }
        }
        Some(image)
    }

    /// The symbols of panics and of a heap: a robot's image holds none.
    pub fn panics_and_heap(&self) -> Vec<&str> {
        let unwanted = ["panic", "_fail", "__rust_alloc"];
        let symbols = self.symbols.iter().map(String::as_str);
        symbols.filter(|name| unwanted.iter().any(|part| name.contains(part))).collect()
    }
}

struct Section {
    kind: usize,
    flags: usize,
    offset: usize,
    size: usize,
    link: usize,
}

impl Section {
    fn parse(elf: &[u8], at: usize) -> Option<Self> {
        let header = elf.get(at..)?;
        Some(Self {
            kind: word(header, 4)?,
            flags: word(header, 8)?,
            offset: word(header, 16)?,
            size: word(header, 20)?,
            link: word(header, 24)?,
        })
    }

    fn bytes<'a>(&self, elf: &'a [u8]) -> Option<&'a [u8]> {
        elf.get(self.offset..self.offset.checked_add(self.size)?)
    }
}

fn word(bytes: &[u8], at: usize) -> Option<usize> {
    let word = bytes.get(at..at.checked_add(4)?)?;
    usize::try_from(u32::from_le_bytes(word.try_into().ok()?)).ok()
}

fn half(bytes: &[u8], at: usize) -> Option<usize> {
    let half = bytes.get(at..at.checked_add(2)?)?;
    Some(u16::from_le_bytes(half.try_into().ok()?).into())
}
