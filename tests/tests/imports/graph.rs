//! The import graph of a crate's files, as the compiler resolves it: modules are found starting
//! from `lib.rs`, and names are followed through re-exports to the defining file. Test code is
//! excluded.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use syn::{
    Attribute, Item, ItemMod, ItemUse, Macro, UseTree, Visibility,
    visit::{self, Visit},
};

/// A module with its own file, as its path of names; empty for the crate's root.
pub(super) type Module = Vec<String>;

/// The modules of one crate.
pub(super) struct Graph {
    modules: BTreeMap<Module, Source>,
}

/// The contents of one file.
struct Source {
    /// Path of the file relative to the crate's `src`.
    file: PathBuf,
    /// Names imported by `use`, with the paths that they stand for.
    names: BTreeMap<String, Module>,
    /// Used paths: those of private `use`s and those in the code.
    used: BTreeSet<Module>,
}

impl Graph {
    /// Reads the modules of the crate with sources in `src`.
    pub(super) fn read(src: &Path) -> Self {
        let mut graph = Self { modules: BTreeMap::new() };
        graph.add(src, PathBuf::from("lib.rs"), Module::new());
        graph
    }

    /// Adds a file and those of its modules.
    fn add(&mut self, src: &Path, file: PathBuf, module: Module) {
        let path = src.join(&file);
        let text = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let mut reader = Reader::default();
        reader.visit_file(
            &syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display())),
        );
        let folder = match file.file_stem().and_then(|stem| stem.to_str()) {
            Some("lib" | "mod") => file.parent().unwrap_or(Path::new("")).to_owned(),
            _ => file.with_extension(""),
        };
        for child in reader.children {
            let [beside, within] =
                [folder.join(&child).with_extension("rs"), folder.join(&child).join("mod.rs")];
            let file = if src.join(&beside).exists() { beside } else { within };
            self.add(src, file, [&module[..], &[child]].concat());
        }
        let Reader { names, used, .. } = reader;
        self.modules.insert(module, Source { file, names, used });
    }

    /// The names of the root modules.
    pub(super) fn roots(&self) -> BTreeSet<&str> {
        self.modules.keys().filter_map(|module| module.first()).map(String::as_str).collect()
    }

    /// All pairs of modules in which the file of the first uses something defined in the file of
    /// the second.
    pub(super) fn uses(&self) -> BTreeSet<(&Module, &Module)> {
        let uses = self.modules.iter().flat_map(|(module, source)| {
            let found = source.used.iter().filter_map(|path| self.definer(module, path, 0));
            found.map(move |definer| (module, definer))
        });
        uses.filter(|(user, definer)| user != definer).collect()
    }

    /// The file of a module.
    pub(super) fn file(&self, module: &Module) -> &Path {
        &self.modules[module].file
    }

    /// The module whose file defines the target of a path in `module`. `None` for other crates, and
    /// names without a definition.
    fn definer(&self, module: &Module, path: &[String], depth: usize) -> Option<&Module> {
        assert!(depth < 50, "{path:?} of {module:?} can't be resolved");
        let mut at = module.clone();
        for (index, name) in path.iter().enumerate() {
            let child = [&at[..], std::slice::from_ref(name)].concat();
            match name.as_str() {
                "crate" => at.clear(),
                "self" => {}
                "super" => _ = at.pop(),
                _ if self.modules.contains_key(&child) => at = child,
                _ => {
                    let Some(target) = self.modules.get(&at)?.names.get(name) else {
                        // The name is defined here, in the language, or in another crate.
                        return if index == 0 { None } else { self.key(&at) };
                    };
                    if target.first() == Some(name) {
                        // The name belongs to another crate.
                        return None;
                    }
                    let path = [target, &path[index + 1..]].concat();
                    return self.definer(&at, &path, depth + 1);
                }
            }
        }
        self.key(&at)
    }

    fn key(&self, module: &Module) -> Option<&Module> {
        self.modules.get_key_value(module).map(|(module, _)| module)
    }

    /// Groups of files that use each other, directly or indirectly; each group is sorted by name.
    pub(super) fn circles(&self) -> Vec<Vec<&Module>> {
        let mut reached: BTreeMap<&Module, BTreeSet<&Module>> = BTreeMap::new();
        let uses = self.uses();
        for module in self.modules.keys() {
            let mut all = BTreeSet::new();
            let mut next = vec![module];
            while let Some(user) = next.pop() {
                let defines =
                    uses.iter().filter(|(it, _)| *it == user).map(|(_, definer)| *definer);
                next.extend(defines.filter(|definer| all.insert(*definer)));
            }
            reached.insert(module, all);
        }
        let mut circles: Vec<Vec<&Module>> = Vec::new();
        for (&module, all) in &reached {
            let circle: Vec<_> =
                all.iter().copied().filter(|it| reached[it].contains(module)).collect();
            if circle.first() == Some(&module) && circle.len() > 1 {
                circles.push(circle);
            }
        }
        circles
    }
}

/// Collects the imports and uses of a file.
#[derive(Default)]
struct Reader {
    children: Vec<String>,
    names: BTreeMap<String, Module>,
    used: BTreeSet<Module>,
}

impl Reader {
    /// Adds the names of a `use`. A re-export defines a name, but does not use it.
    fn take(&mut self, tree: &UseTree, path: &[String], is_reexport: bool) {
        let with = |name: &syn::Ident| [path, &[name.to_string()]].concat();
        let (name, target) = match tree {
            UseTree::Path(it) => return self.take(&it.tree, &with(&it.ident), is_reexport),
            UseTree::Group(it) => {
                it.items.iter().for_each(|tree| self.take(tree, path, is_reexport));
                return;
            }
            UseTree::Name(it) if it.ident == "self" => (path.last().cloned(), path.to_vec()),
            UseTree::Name(it) => (Some(it.ident.to_string()), with(&it.ident)),
            UseTree::Rename(it) if it.ident == "self" => {
                (Some(it.rename.to_string()), path.to_vec())
            }
            UseTree::Rename(it) => (Some(it.rename.to_string()), with(&it.ident)),
            UseTree::Glob(_) => (None, path.to_vec()),
        };
        self.names.extend(name.map(|name| (name, target.clone())));
        if !is_reexport {
            self.used.insert(target);
        }
    }
}

/// Whether an item is only compiled for tests.
fn is_for_tests(attributes: &[Attribute]) -> bool {
    let is_test = |it: &Attribute| {
        it.path().is_ident("cfg")
            && it.parse_args::<syn::Path>().is_ok_and(|it| it.is_ident("test"))
    };
    attributes.iter().any(is_test)
}

impl Visit<'_> for Reader {
    fn visit_item(&mut self, item: &Item) {
        let attributes = match item {
            Item::Mod(it) => &it.attrs,
            Item::Use(it) => &it.attrs,
            Item::Fn(it) => &it.attrs,
            Item::Impl(it) => &it.attrs,
            Item::Const(it) => &it.attrs,
            _ => return visit::visit_item(self, item),
        };
        if !is_for_tests(attributes) {
            visit::visit_item(self, item);
        }
    }

    fn visit_item_mod(&mut self, item: &ItemMod) {
        if item.content.is_none() {
            self.children.push(item.ident.to_string());
        }
        visit::visit_item_mod(self, item);
    }

    fn visit_item_use(&mut self, item: &ItemUse) {
        // The visibility outside of the crate is irrelevant here.
        let is_reexport = !matches!(item.vis, Visibility::Inherited);
        self.take(&item.tree, &[], is_reexport);
    }

    fn visit_path(&mut self, path: &syn::Path) {
        self.used.insert(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        visit::visit_path(self, path);
    }

    /// Paths in visibilities are not uses.
    fn visit_visibility(&mut self, _: &Visibility) {}

    /// Collects the paths among a macro's tokens.
    fn visit_macro(&mut self, item: &Macro) {
        self.visit_path(&item.path);
        let text = item.tokens.to_string();
        let mut path = Module::new();
        let mut is_open = false;
        for word in text.split_whitespace() {
            match word {
                "::" => is_open = true,
                _ if is_open && !path.is_empty() => {
                    path.push(word.to_owned());
                    is_open = false;
                }
                _ => {
                    self.used.insert(std::mem::replace(&mut path, vec![word.to_owned()]));
                    is_open = false;
                }
            }
        }
        self.used.insert(path);
    }
}
