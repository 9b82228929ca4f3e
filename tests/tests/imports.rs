//! Imports run one way in every crate: a module imports only those before it, and files do not
//! import each other in a cycle.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use graph::Graph;

#[path = "imports/graph.rs"]
mod graph;

/// The folders of `sim-host`, with the folders that each may import.
const HOST: [(&str, &[&str]); 19] = [
    ("timing", &[]),
    ("files", &[]),
    ("rounding", &[]),
    ("grid", &["files"]),
    ("camera", &["grid"]),
    ("recording", &["files", "rounding", "grid", "camera"]),
    ("perception", &["grid", "camera", "timing"]),
    ("mapping", &["grid", "camera", "perception", "timing"]),
    ("server", &["grid", "camera", "perception", "mapping", "timing"]),
    ("deployment", &["grid", "camera", "perception", "mapping", "server"]),
    ("store", &["mapping", "server"]),
    ("placement", &["grid"]),
    ("calibration", &["camera", "perception"]),
    ("channel", &[]),
    ("conformance", &[]),
    ("report", &["files", "recording", "grid", "camera", "perception", "mapping", "server"]),
    ("world", &["files", "rounding", "grid", "camera"]),
    ("devices", &[]),
    (
        "run",
        &[
            "calibration",
            "camera",
            "channel",
            "conformance",
            "deployment",
            "devices",
            "files",
            "grid",
            "mapping",
            "perception",
            "placement",
            "recording",
            "report",
            "server",
            "store",
            "timing",
            "world",
        ],
    ),
];

#[test]
fn the_protocol_imports_in_the_order_of_its_docs() {
    in_order_of_docs("protocol");
}

#[test]
fn the_agent_imports_in_the_order_of_its_docs() {
    in_order_of_docs("agent");
}

#[test]
fn folders_of_the_host_import_only_permitted_ones() {
    let graph = Graph::read(&src("sim-host"));
    let known: BTreeSet<&str> = HOST.iter().map(|(folder, _)| *folder).collect();
    assert_eq!(graph.roots(), known, "a folder is missing in HOST");
    let may = |user: &str, used: &str| {
        HOST.iter().any(|(folder, allowed)| *folder == user && allowed.contains(&used))
    };
    assert_eq!(wrong_imports(&graph, may), [""; 0]);
}

#[test]
fn no_files_import_each_other_in_a_cycle() {
    for name in ["protocol", "agent", "sim-host"] {
        let found = circles(&Graph::read(&src(name)));
        assert!(found.is_empty(), "import cycles in {name}: {found:#?}");
    }
}

fn src(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name).join("src")
}

/// Checks that every root module of a crate is in the numbered list of the crate's docs, and
/// imports only those before it.
fn in_order_of_docs(name: &str) {
    let graph = Graph::read(&src(name));
    let order = order_in_docs(&src(name), &graph.roots());
    assert_eq!(order.iter().map(String::as_str).collect::<BTreeSet<_>>(), graph.roots());
    let place = |name: &str| order.iter().position(|it| it == name);
    assert_eq!(wrong_imports(&graph, |user, used| place(used) < place(user)), [""; 0]);
}

/// The names of modules in the numbered list of a crate's docs, in order.
fn order_in_docs(src: &Path, modules: &BTreeSet<&str>) -> Vec<String> {
    let text = fs::read_to_string(src.join("lib.rs")).unwrap();
    let docs = text.lines().map_while(|line| line.strip_prefix("//!"));
    let is_of_list = |line: &&str| {
        let starts =
            line.trim_start().split_once(". ").is_some_and(|(it, _)| it.parse::<u8>().is_ok());
        starts || line.starts_with("    ")
    };
    let list: String = docs.filter(is_of_list).collect();
    let mut order: Vec<String> = Vec::new();
    for name in list.split('`').skip(1).step_by(2).filter(|name| modules.contains(name)) {
        if !order.iter().any(|it| it == name) {
            order.push(name.to_owned());
        }
    }
    order
}

/// Imports between root modules that are not permitted.
fn wrong_imports(graph: &Graph, may: impl Fn(&str, &str) -> bool) -> Vec<String> {
    let wrong = graph.uses().into_iter().filter_map(|(user, used)| {
        let (from, to) = (user.first()?, used.first()?);
        let is_wrong = from != to && !may(from, to);
        is_wrong.then(|| format!("{} imports {to}", graph.file(user).display()))
    });
    wrong.collect::<BTreeSet<_>>().into_iter().collect()
}

/// The import cycles of a crate, as file names.
fn circles(graph: &Graph) -> BTreeSet<Vec<String>> {
    let names = |circle: Vec<&graph::Module>| {
        let mut files: Vec<_> =
            circle.into_iter().map(|it| graph.file(it).display().to_string()).collect();
        files.sort();
        files
    };
    graph.circles().into_iter().map(names).collect()
}

/// Every form of import is found and attributed to the file with the definition.
#[test]
fn every_form_of_import_is_found() {
    let src = Path::new(env!("CARGO_TARGET_TMPDIR")).join("imports");
    let files = [
        ("lib.rs", "mod a; mod b; mod c; #[cfg(test)] mod oracle;"),
        (
            "a/mod.rs",
            "mod inner; mod other; pub use inner::Thing; pub(crate) use other as renamed;",
        ),
        (
            "a/inner.rs",
            "use std::fmt; pub struct Thing; pub(super) fn it() { crate::c::called(); }",
        ),
        ("a/other.rs", "pub fn go(thing: super::Thing) {}"),
        (
            "b.rs",
            "use crate::{a::{self, Thing as It}, c}; fn f() { it!(a::renamed::go(It), c::X); }",
        ),
        ("c.rs", "pub fn called() {} #[cfg(test)] mod tests { use crate::b::f; }"),
    ];
    for (file, text) in files {
        let path = src.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    let graph = Graph::read(&src);
    let show = |(user, used): (_, _)| {
        format!("{} {}", graph.file(user).display(), graph.file(used).display())
    };
    let uses: Vec<_> = graph.uses().into_iter().map(show).collect();
    let expected = [
        "a/inner.rs c.rs",
        "a/other.rs a/inner.rs",
        "b.rs a/mod.rs",
        "b.rs a/inner.rs",
        "b.rs a/other.rs",
        "b.rs c.rs",
    ];
    assert_eq!(uses, expected);
    assert_eq!(circles(&graph), BTreeSet::new());
    assert_eq!(wrong_imports(&graph, |user, _| user == "b"), ["a/inner.rs imports c"]);
    // An indirect cycle: a/inner.rs imports c.rs, which imports a/other.rs, which imports
    // a/inner.rs.
    fs::write(src.join("c.rs"), "pub fn called() { crate::a::renamed::go(); }").unwrap();
    let circle = ["a/inner.rs", "a/other.rs", "c.rs"].map(String::from).to_vec();
    assert_eq!(circles(&Graph::read(&src)), BTreeSet::from([circle]));
}
