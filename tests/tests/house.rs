//! Holds the habits of the house: files that do not import each other in circles, short files and functions, a header for each file,
//! a sentence for each constant, and documents that name files which exist.
//!
//! It reads the source files as text and starts no process. What it cannot see, such as whether a name is a good one, is left to people;
//! CONTRIBUTING.md says what they look for.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "house/messages.rs"]
mod messages;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Largest number of lines in a file.
const FILE_LINES: usize = 500;

/// Files that stay longer, with their lines and the reason. An entry may only shrink, and goes when its file is short enough.
const LONGER_FILES: &[(&str, usize, &str)] = &[];

/// Largest number of functions that may stay longer than the limit in clippy.toml. Each one carries its reason in its `expect` attribute.
const LONGER_FUNCTIONS: usize = 0;

/// The one file that may hold unsafe code.
const UNSAFE_FILE: &str = "shared/src/os.rs";

/// Crates that only developers run, on files of their own.
const OWN_WAYS: [&str; 4] = ["simulator", "experiments", "swarm", "tests"];
/// What opens a file.
const OPENS: [&str; 9] = [
    "fs::read(",
    "fs::read_to_string(",
    "fs::write(",
    "fs::copy(",
    "File::open(",
    "File::create(",
    "File::options()",
    "OpenOptions::new()",
    "from_path(",
];
/// Files that are opened in another way than through `regular_file` and `whole_file`: the source file, a part of its line, and why.
const OPENED_OTHERWISE: &[(&str, &str, &str)] = &[
    ("feature-worker/src/source/devices.rs", "etc/group", "the system's own file"),
    ("feature-worker/src/source/devices.rs", "\"comm\"", "in /proc"),
    ("feature-worker/src/source/devices.rs", "\"name\"", "in /sys"),
    ("shared/src/machine.rs", "read_to_string(path)", "in /proc and /sys"),
    ("web/src/peer.rs", "read_to_string(table)", "in /proc"),
    ("operator-page/src/addresses.rs", "read_to_string(table)", "in /proc"),
    ("operator-page/src/shelf.rs", "File::create(&partial)", "the new file gets the old one's time before its name"),
    ("shared/src/whole_file.rs", "File::open(directory_of(path))", "a directory"),
    ("shared/src/shared_memory.rs", "std::fs::write(&new, &token)", "in the runtime directory, which nobody else may enter"),
    ("shared/src/shared_memory.rs", "File::open(random)", "the kernel's random numbers"),
    ("rt-controller/src/claim.rs", "std::fs::write(&new, text)", "in the runtime directory, which nobody else may enter"),
    ("feature-worker/src/episodes/export.rs", "fs::write(&path, &image.data)", "in a directory that is new"),
    ("feature-worker/src/episodes/video.rs", "fs::write(&self.path, [0; PROBE])", "OpenCV writes the file"),
    ("feature-worker/src/source/devices.rs", ".custom_flags(NONBLOCK)", "a camera, which is a device"),
    ("operator-page/src/shelf.rs", ".create(true).append(true)", "in the page's own directory"),
    ("rt-controller/src/claim.rs", "OpenOptions::new()", "in the runtime directory, which nobody else may enter"),
    ("shared/src/episode/number.rs", "OpenOptions::new()", "it is locked while it is read and written"),
    ("shared/src/os.rs", "OpenOptions::new()", "in /dev"),
    ("shared/src/regular_file.rs", "OpenOptions::new()", "the one way to read"),
    ("shared/src/shared_memory.rs", "OpenOptions::new()", "in the runtime directory, which nobody else may enter"),
    (
        "feature-worker/src/commands/inspect.rs",
        "File::options()",
        "the list that `whole_file` has made, which grows by a name before each picture",
    ),
    ("trainer/src/report/json_out.rs", "File::options()", "an empty file of the name, after `check`"),
    ("feature-worker/src/commands/bench/python.rs", "directory.join(", "in a directory that is new"),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the crate lies in the workspace").to_path_buf()
}

/// The crates of the workspace, as directories.
fn crates() -> Vec<String> {
    let manifest = read(&root().join("Cargo.toml"));
    let members = manifest.split("members = [").nth(1).and_then(|rest| rest.split(']').next()).expect("Cargo.toml lists its members");
    members.split('"').skip(1).step_by(2).map(str::to_string).collect()
}

/// All files below `directory` with the ending `extension`, sorted.
fn files(directory: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![directory.to_path_buf()];
    while let Some(directory) = open.pop() {
        for entry in fs::read_dir(&directory).into_iter().flatten().flatten() {
            let path = entry.path();
            let name = entry.file_name().to_string_lossy().into_owned();
            if path.is_dir() && !name.starts_with('.') && !["target", "out"].contains(&name.as_str()) {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == extension) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn name_of(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// All Rust files of the crates, by name and text.
fn sources() -> Vec<(String, String)> {
    crates().iter().flat_map(|c| files(&root().join(c), "rs")).map(|p| (name_of(&p), read(&p))).collect()
}

/// The text without comments and without the tests at its end.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or(text);
    let lines = text.lines().map(|line| line.split("//").next().unwrap_or(""));
    lines.collect::<Vec<_>>().join("\n")
}

/// Fails if there are `faults`, with a line for each.
fn none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

/// The paths that a `use` tree such as `a::{b, c::{self, D}}` names.
fn expand(tree: &str) -> Vec<String> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        return vec![tree.split(" as ").next().unwrap_or(tree).trim().to_string()];
    };
    let (prefix, inner) = (&tree[..open], tree[open + 1..].trim_end().trim_end_matches('}'));
    let (mut depth, mut start, mut parts) = (0, 0, Vec::new());
    for (at, c) in inner.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&inner[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&inner[start..]);
    parts.iter().filter(|p| !p.trim().is_empty()).flat_map(|p| expand(&format!("{prefix}{}", p.trim()))).collect()
}

/// The paths that a file's code names: its `use` trees without the re-exports, and paths in the code itself.
fn paths(code: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut rest = String::new();
    for statement in code.split_inclusive(';') {
        let begin = statement.rfind("use ").filter(|at| statement[..*at].chars().next_back().is_none_or(char::is_whitespace));
        match begin {
            Some(at) if !statement[..at].trim_end().ends_with("pub") && !statement[..at].trim_end().ends_with(')') => {
                found.extend(expand(statement[at + 4..].trim_end_matches(';')));
                rest.push_str(&statement[..at]);
            }
            Some(_) => {}
            None => rest.push_str(statement),
        }
    }
    let is_path = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    found.extend(rest.split(|c| !is_path(c)).filter(|p| p.contains("::")).map(str::to_string));
    found
}

/// Which files of one crate each of its files imports from, by module path (`vision::line`; empty for the root).
fn imports(name: &str) -> BTreeMap<String, BTreeSet<String>> {
    let source = root().join(name).join("src");
    let module = |path: &Path| {
        let relative = path.strip_prefix(&source).unwrap_or(path).with_extension("");
        let mut parts: Vec<String> = relative.iter().map(|p| p.to_string_lossy().into_owned()).collect();
        if parts.last().is_some_and(|p| p == "mod" || (p == "lib" && parts.len() == 1)) {
            parts.pop();
        }
        parts
    };
    let modules: BTreeMap<String, (Vec<String>, PathBuf)> =
        files(&source, "rs").into_iter().map(|p| (module(&p).join("::"), (module(&p), p))).collect();
    let own = name.replace('-', "_");
    let mut graph = BTreeMap::new();
    for (from, (parts, path)) in &modules {
        let mut to = BTreeSet::new();
        for path in paths(&code(&read(path))) {
            let mut steps: Vec<&str> = path.split("::").filter(|s| !s.is_empty()).collect();
            let mut at: Vec<String> = parts.clone();
            match steps.first() {
                Some(&"crate") => at.clear(),
                Some(first) if *first == own => at.clear(),
                Some(&"self") => {}
                Some(&"super") => {
                    while steps.first() == Some(&"super") {
                        at.pop();
                        steps.remove(0);
                    }
                    steps.insert(0, "super");
                }
                // A child that this file declares.
                Some(first) if modules.contains_key(&[parts.join("::"), first.to_string()].join("::")) && !parts.is_empty() => {
                    steps.insert(0, "self");
                }
                _ => continue,
            }
            for step in steps.drain(..).skip(1) {
                at.push(step.to_string());
            }
            while !modules.contains_key(&at.join("::")) && !at.is_empty() {
                at.pop();
            }
            let target = at.join("::");
            if target != *from && modules.contains_key(&target) {
                to.insert(target);
            }
        }
        graph.insert(from.clone(), to);
    }
    graph
}

/// Protects a reader from circles: of any two files, one can be read without the other.
#[test]
fn no_files_import_each_other_in_a_circle() {
    let mut faults = Vec::new();
    for name in crates() {
        let graph = imports(&name);
        // What each file reaches; a file in a circle reaches itself.
        let reach = |from: &String| {
            let mut seen: BTreeSet<&String> = BTreeSet::new();
            let mut open: Vec<&String> = graph[from].iter().collect();
            while let Some(next) = open.pop() {
                if seen.insert(next) {
                    open.extend(&graph[next]);
                }
            }
            seen
        };
        let reached: BTreeMap<&String, BTreeSet<&String>> = graph.keys().map(|k| (k, reach(k))).collect();
        let mut told: BTreeSet<&String> = BTreeSet::new();
        for from in graph.keys() {
            let circle: Vec<&String> = reached[from].iter().filter(|to| reached[*to].contains(from)).copied().collect();
            if !circle.is_empty() && told.insert(circle[0]) {
                let edges: Vec<String> = circle
                    .iter()
                    .flat_map(|a| graph[*a].iter().filter(|b| circle.contains(b)).map(move |b| format!("{a} -> {b}")))
                    .collect();
                faults.push(format!("{name}: a circle of {} files: {}", circle.len(), edges.join(", ")));
            }
        }
    }
    none(&faults);
}

/// Protects the test above: it finds a circle through a group, a parent, and a path in the code.
#[test]
fn paths_are_read_as_the_compiler_reads_them() {
    assert_eq!(expand("crate::{a::{self, B}, c::D as E}"), ["crate::a::self", "crate::a::B", "crate::c::D"]);
    let code = "use std::fmt;\nuse super::line::{Line,\n fit};\npub use child::Thing;\nfn f() { crate::os::now_ns() }";
    assert_eq!(paths(code), ["std::fmt", "super::line::Line", "super::line::fit", "crate::os::now_ns"]);
}

/// Protects a reader from files that are too long to keep in mind.
#[test]
fn files_are_short() {
    let mut faults = Vec::new();
    for (name, text) in sources() {
        let lines = text.lines().count();
        match LONGER_FILES.iter().find(|(listed, ..)| *listed == name) {
            None if lines > FILE_LINES => faults.push(format!("{name}: {lines} lines, at most {FILE_LINES}: split it")),
            Some((_, most, _)) if lines > *most => {
                faults.push(format!("{name}: {lines} lines, its entry allows {most}: it may only shrink"))
            }
            Some((_, most, _)) if lines <= FILE_LINES || lines + 20 < *most => {
                faults.push(format!("{name}: {lines} lines, its entry says {most}: lower the entry, or take it out"));
            }
            _ => {}
        }
    }
    for (name, ..) in LONGER_FILES {
        if !root().join(name).exists() {
            faults.push(format!("{name}: is listed as longer, but is not there"));
        }
    }
    none(&faults);
}

/// Protects the limit on functions, which clippy checks: the exceptions do not become more, wherever in a list of lints they stand. Files of tests are
/// free of it as a whole.
#[test]
fn long_functions_do_not_become_more() {
    let programs = sources().into_iter().filter(|(name, _)| name.contains("/src/") && !name.starts_with("tests/"));
    let exceptions: usize = programs.map(|(_, text)| code(&text).matches("clippy::too_many_lines").count()).sum();
    assert_eq!(exceptions, LONGER_FUNCTIONS, "exceptions to clippy::too_many_lines; with fewer of them, lower LONGER_FUNCTIONS");
}

/// Protects whoever names a cell once for all: each command that takes a configuration takes it from the environment too. Those of [`OWN_WAYS`] do not
/// all, because they make a cell of their own, and one is started by the page alone.
#[test]
fn each_configuration_may_come_from_the_environment() {
    let mut faults = Vec::new();
    let own = |name: &str| OWN_WAYS.iter().any(|c| name.starts_with(c)) || name == "operator-page/src/cli.rs";
    for (name, text) in sources().iter().filter(|(name, _)| name.contains("/src/") && !own(name)) {
        let lines: Vec<&str> = text.lines().map(str::trim).collect();
        let named = |line: &str| line.trim_start_matches("pub ").starts_with("config: ") && line.contains("PathBuf");
        // The attribute may take several lines, and comments may stand between it and the field.
        let bare = |at: &usize| {
            let before = &lines[..*at];
            let attribute = before.iter().rposition(|line| line.starts_with("#[arg(")).map_or(&[][..], |from| &before[from..]);
            named(lines[*at]) && !attribute.is_empty() && !attribute.iter().any(|line| line.contains("VARIABLE"))
        };
        faults.extend((0..lines.len()).filter(bare).map(|_| format!("{name}: --config without shared::config::VARIABLE")));
    }
    none(&faults);
}

/// Protects whoever runs several pages of one cell: no two programs have the same port unless they are told so.
#[test]
fn each_page_has_its_own_port() {
    let ports: Vec<String> = sources()
        .iter()
        .filter(|(name, _)| name.contains("/src/"))
        .flat_map(|(_, text)| text.split("default_value_t = 86").skip(1).map(|t| t.chars().take(2).collect()).collect::<Vec<_>>())
        .collect();
    let own: BTreeSet<&String> = ports.iter().collect();
    assert!(ports.len() >= 4 && own.len() == ports.len(), "default ports, 86 and: {ports:?}");
}

/// Protects a newcomer: each file begins by saying what it is for.
#[test]
fn each_file_says_what_it_is_for() {
    none(
        &sources()
            .iter()
            .filter(|(_, text)| !text.starts_with("//!"))
            .map(|(name, _)| format!("{name}: has no header"))
            .collect::<Vec<_>>(),
    );
}

/// Protects every number: each constant outside of functions has its own sentence, which tells where its value comes from.
#[test]
fn each_constant_has_its_own_sentence() {
    let mut faults = Vec::new();
    for (name, text) in sources().iter().filter(|(name, _)| name.contains("/src/")) {
        let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or(text);
        let mut before = "";
        for (at, line) in text.lines().enumerate() {
            let declared = line.trim_start_matches("pub(crate) ").trim_start_matches("pub(super) ").trim_start_matches("pub ");
            let constant =
                ["const ", "static "].iter().any(|k| declared.strip_prefix(k).is_some_and(|r| r.starts_with(char::is_uppercase)));
            if constant && !before.starts_with("///") {
                faults.push(format!("{name}:{}: {}", at + 1, line.chars().take(60).collect::<String>()));
            }
            if !line.starts_with("#[") {
                before = line;
            }
        }
    }
    none(&faults);
}

/// Protects tests from never being run: `scripts/test` builds neither a program's `main.rs` nor an example of the documentation as a test.
#[test]
fn tests_stand_where_they_are_run() {
    let mut faults = Vec::new();
    for (name, text) in sources() {
        let is_program = name.ends_with("/src/main.rs") || name.contains("/examples/");
        if is_program && text.contains("#[test]") {
            faults.push(format!("{name}: tests belong in the library or in tests/"));
        }
        let mut inside = false;
        for line in text.lines().map(str::trim_start).filter(|line| line.starts_with("//")) {
            let fence = line.trim_start_matches(['/', '!', ' ']);
            if fence.starts_with("```") {
                inside = !inside;
                let plain = !inside || fence == "```text";
                faults.extend((!plain).then(|| format!("{name}: `{fence}` would be a test, and none such is run: write ```text")));
            }
        }
    }
    none(&faults);
}

/// Protects memory: unsafe code stands in one small file.
#[test]
fn unsafe_code_stands_in_one_file() {
    let unsafe_in = |text: &str| ["unsafe {", "unsafe fn", "unsafe impl", "unsafe extern"].iter().any(|u| code(text).contains(u));
    let faults: Vec<String> = sources()
        .iter()
        .filter(|(name, text)| name != UNSAFE_FILE && !name.ends_with("house.rs") && unsafe_in(text))
        .map(|(name, _)| format!("{name}: unsafe code belongs in {UNSAFE_FILE}"))
        .collect();
    none(&faults);
}

/// Protects memory, devices and what a person names by mistake: files are read by `regular_file` and written by `whole_file`, so that a pipe holds nobody, a
/// huge file fills nothing, and a full disk leaves the old file. Files of other kinds are in the list.
#[test]
fn files_are_opened_in_one_way() {
    let mut faults = Vec::new();
    for (name, text) in
        sources().iter().filter(|(name, _)| name.contains("/src/") && !OWN_WAYS.contains(&name.split('/').next().unwrap_or("")))
    {
        for line in code(text).lines() {
            // What is made anew meets nothing that is there.
            let opens = OPENS.iter().any(|o| line.contains(o)) && !line.contains(".create_new(true)");
            let of_system = ["\"/proc/", "\"/sys/", "\"/dev/"].iter().any(|d| line.contains(d));
            if opens && !of_system && !OPENED_OTHERWISE.iter().any(|(file, part, _)| file == name && line.contains(part)) {
                faults.push(format!("{name}: `{}`: use regular_file or whole_file", line.trim()));
            }
        }
    }
    for (file, part, _) in OPENED_OTHERWISE {
        if !sources().iter().any(|(name, text)| name == file && code(text).contains(part)) {
            faults.push(format!("{file}: `{part}` is listed as opened otherwise, but is not there"));
        }
    }
    none(&faults);
}

/// Protects the documents: what they link to and the files that they name exist, and nothing is left to be filled in.
#[test]
fn documents_are_whole_and_name_files_that_exist() {
    let mut faults = Vec::new();
    for file in files(&root(), "md") {
        let (name, text) = (name_of(&file), read(&file));
        let directory = file.parent().expect("a file lies in a directory");
        for (at, line) in text.lines().enumerate() {
            let mut fault = |what: String| faults.push(format!("{name}:{}: {what}", at + 1));
            for placeholder in ["TODO", "FIXME", "XXX", "TBD", "| CAM"] {
                if line.contains(placeholder) {
                    fault(format!("has the placeholder {placeholder}"));
                }
            }
            for target in line.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
                let path = target.split('#').next().unwrap_or("");
                if !target.contains("://") && !path.is_empty() && !directory.join(path).exists() {
                    fault(format!("links to {target}, which is not there"));
                }
            }
            for quoted in line.split('`').skip(1).step_by(2) {
                let source = quoted.ends_with(".rs") && !quoted.contains(['{', '*', ' ']);
                let script = quoted.starts_with("scripts/") && !quoted.contains([' ', '{', '*']);
                if (source || script) && name != "CHANGELOG.md" && !is_there(quoted) {
                    fault(format!("names {quoted}, which is not there"));
                }
            }
        }
    }
    none(&faults);
}

/// Whether a file's name, given from the root or from within a crate, is one of the tree's.
fn is_there(quoted: &str) -> bool {
    root().join(quoted).exists() || sources().iter().any(|(name, _)| name.ends_with(&format!("/{quoted}")))
}
