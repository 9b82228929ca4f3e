//! Symbols and memory sizes of a firmware image.

/// The parts of an ELF image (32 bits, little-endian) that the tests examine.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Image {
    /// Names of the symbols, mangled.
    pub symbols: Vec<String>,
    /// Their values, in the same order: addresses, in which bit 0 marks Thumb code.
    pub values: Vec<usize>,
    /// Bytes of flash.
    pub flash: usize,
    /// Bytes of static RAM.
    pub ram: usize,
}

/// Section type `SHT_SYMTAB`.
const SYMBOL_TABLE: usize = 2;
/// Section type `SHT_NOBITS`.
const NO_BITS: usize = 8;
/// Section flag `SHF_WRITE`.
const WRITABLE: usize = 1;
/// Section flag `SHF_ALLOC`.
const ALLOCATED: usize = 2;
/// Size of a symbol table entry.
const SYMBOL_BYTES: usize = 16;

impl Image {
    /// Parses an image; `None` if it is not one.
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
                    image.values.push(word(symbol, 4)?);
                    image.symbols.push(String::from_utf8_lossy(name).into_owned());
                }
            }
        }
        Some(image)
    }

    /// The value of the symbol with this name.
    pub fn value(&self, name: &str) -> Option<usize> {
        let at = self.symbols.iter().position(|symbol| symbol == name)?;
        self.values.get(at).copied()
    }

    /// Symbols of panics and of a heap, which a robot's image must not contain.
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
