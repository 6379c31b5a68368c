//! What the programs tell people stands in docs/FAQ.md, word for word: each message that the source can say is there, and each line there is still said.
//!
//! It reads the source as text and starts no process. By default every sentence in the source counts as a message; what is none, such as the
//! text of `--help` or of a file format, is named below. Names and numbers that a message puts in stand as `…`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The crates whose programs run on the control PC, and what they stand on.
const CRATES: [&str; 7] = ["shared", "rt-controller", "decant", "feature-worker", "trainer", "operator-page", "web"];

/// Calls and attributes around a text that make it no message: results on standard output, `--help`, names of files and variables, green lines of
/// `doctor`, titles of histograms and plots, keys of JSON.
const NO_MESSAGE: [&str; 39] = [
    "println",
    "print",
    "assert",
    "assert_eq",
    "debug_assert",
    "command",
    "arg",
    "expect",
    "cfg",
    "serde",
    "include_str",
    "env",
    "read",
    "read_to_string",
    "read_dir",
    "var_os",
    "green",
    "snapshot",
    "stage",
    "step",
    "figure",
    "plot",
    "json",
    "schema",
    "join",
    "limit",
    "stdout",
    "value",
    "number",
    "header",
    "set_message",
    "COMMANDS",
    "LOOP_TIMES",
    "histogram",
    "gauge",
    "gauges",
    "counter",
    "counters",
    "times",
];

/// Files whose texts are no messages: reports and pages for reading, the formats of files, lists of commands and key names.
const NO_MESSAGES_IN: [&str; 10] = [
    "trainer/src/report",
    "shared/src/episode/format.rs",
    "shared/src/episode/write.rs",
    "feature-worker/src/episodes/lerobot/",
    "feature-worker/src/commands/calibrate/section.rs",
    "feature-worker/src/commands/bench",
    "shared/src/exit.rs",
    "shared/src/weights/ranges.rs",
    "operator-page/src/words.rs",
    "tests.rs",
];

/// Texts that are parts of a protocol or of a longer message, or that tell of nothing wrong.
const PARTS: [&str; 18] = [
    "default-src 'none'",
    "tilt along a curve and back",
    "application/openmetrics-text",
    "HTTP/1.1\\r",
    "http://…/#token",
    "the request to start",
    "the request for",
    "the program's upload",
    "the transfer of its state",
    "the hand-over to the loop",
    "goal … ml, … ml poured",
    "running in cell '…' at … Hz",
    "the newest file written … ago",
    "goal … ml, poured … ml",
    "the agent ",
    "… ml poured (estimate), …",
    "an unknown ",
    "Commands of the other programs",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn rust_files(directory: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).unwrap().map(|e| e.unwrap().path()) {
        if entry.is_dir() {
            rust_files(&entry, into);
        } else if entry.extension().is_some_and(|e| e == "rs") {
            into.push(entry);
        }
    }
}

/// A text in the source, and the names of the calls, attributes and functions around it.
struct Text {
    around: Vec<String>,
    text: String,
}

/// The identifier at the end of `before`, which a bracket follows; a macro's `!` does not count. Of a constant's value it is the constant's name.
fn name_before(before: &str) -> String {
    let mut before = before.trim_end().trim_end_matches('!').trim_end();
    if before.ends_with('=') {
        let head = before.rsplit("const ").next().unwrap_or_default();
        before = &head[..head.find(':').unwrap_or(head.len())];
    }
    let start = before.rfind(|c: char| !(c.is_alphanumeric() || c == '_')).map_or(0, |k| k + 1);
    before[start..].to_owned()
}

/// The function whose body a brace after `before` begins, as `fn NAME`; empty if it is no function's.
fn function_before(before: &str) -> String {
    let head = before.rsplit([';', '{', '}']).next().unwrap_or_default();
    let name = head.split("fn ").nth(1).map(|rest| rest.split(|c: char| !(c.is_alphanumeric() || c == '_')).next().unwrap_or_default());
    name.map_or(String::new(), |name| format!("fn {name}"))
}

/// All texts in quotation marks of a source file, without its comments and tests.
fn texts(source: &str) -> Vec<Text> {
    let source = source.split("#[cfg(test)]\nmod ").next().unwrap();
    let (mut found, mut around, mut at) = (Vec::new(), Vec::new(), 0);
    while let Some(c) = source[at..].chars().next() {
        let rest = &source[at..];
        let raw = rest.starts_with("r#\"") || rest.starts_with("r\"");
        if rest.starts_with("//") {
            at += rest.find('\n').unwrap_or(rest.len());
        } else if c == '\'' {
            // A character, or the name of a lifetime.
            let second = rest[1..].find('\'').filter(|k| *k > 0 && (*k <= 4 || rest[1..].starts_with('\\')) && *k < 12);
            let escaped = rest.starts_with("'\\''");
            at += if escaped {
                4
            } else {
                second.filter(|k| rest[1..=*k].chars().count() == 1 || rest[1..].starts_with('\\')).map_or(1, |k| k + 2)
            };
        } else if c == '"' || raw {
            let (open, close) = if rest.starts_with("r#\"") { (3, "\"#") } else { (1 + usize::from(raw), "\"") };
            let mut end = at + open;
            while !source[end..].starts_with(close) {
                end += if !raw && source[end..].starts_with('\\') { 2 } else { source[end..].chars().next().unwrap().len_utf8() };
            }
            found.push(Text { around: around.clone(), text: source[at + open..end].to_owned() });
            at = end + close.len();
        } else {
            match c {
                '(' | '[' => around.push(name_before(&source[..at])),
                '{' => around.push(function_before(&source[..at])),
                ')' | ']' | '}' => drop(around.pop()),
                _ => {}
            }
            at += c.len_utf8();
        }
    }
    found
}

/// The text as a person sees it: in one line, and what is put in as `…`.
fn shown(text: &str) -> String {
    let mut joined = String::new();
    let mut lines = text.split("\\\n");
    joined.push_str(lines.next().unwrap());
    lines.for_each(|line| joined.push_str(line.trim_start()));
    let plain = joined.replace("\\n", " ").replace('\n', " ").replace("\\\"", "\"").replace("{{", "\u{1}").replace("}}", "\u{2}");
    let (mut out, mut inside) = (String::new(), false);
    for c in plain.chars() {
        match c {
            '{' => {
                inside = true;
                out.push('…');
            }
            '}' if inside => inside = false,
            c if !inside => out.push(c),
            _ => {}
        }
    }
    out.replace('\u{1}', "{").replace('\u{2}', "}").trim_matches([' ', ':', ';', ',']).to_owned()
}

/// Whether a text is a message to a person.
fn is_message(file: &str, Text { around, .. }: &Text, shown: &str) -> bool {
    // The reasons of endings and doubts may be one word; everything else is at least three.
    let reason = file.starts_with("shared/src") && around.iter().any(|a| a == "fn words");
    let words = shown.split(|c: char| !c.is_ascii_alphabetic()).filter(|w| w.len() > 1).count();
    let long = if reason { words > 0 } else { words > 2 && shown.matches(' ').count() > 1 };
    long && !around.iter().any(|a| NO_MESSAGE.contains(&a.as_str())) && !PARTS.iter().any(|part| shown.contains(part))
}

/// The messages in the source, each with a file that says it.
fn said() -> BTreeMap<String, String> {
    let mut said = BTreeMap::new();
    for name in CRATES {
        let mut files = Vec::new();
        rust_files(&root().join(name).join("src"), &mut files);
        for path in files {
            let file = path.strip_prefix(root()).unwrap().display().to_string();
            if NO_MESSAGES_IN.iter().any(|f| file.starts_with(f) || file.ends_with(&format!("/{f}"))) {
                continue;
            }
            for text in texts(&std::fs::read_to_string(&path).unwrap()) {
                let shown = shown(&text.text);
                if is_message(&file, &text, &shown) {
                    said.insert(shown, file.clone());
                }
            }
        }
    }
    said
}

/// Protects whoever meets a message and looks it up: it stands in docs/FAQ.md with what to do. A message that is no longer said does not stand there.
#[test]
fn every_message_stands_in_the_faq() {
    let page = std::fs::read_to_string(root().join("docs/FAQ.md")).unwrap();
    let listed: BTreeSet<&str> = page.lines().filter_map(|line| line.strip_prefix("- ")).collect();
    let said = said();
    let missing: Vec<String> = said.iter().filter(|(m, _)| !listed.contains(m.as_str())).map(|(m, f)| format!("- {m}    ({f})")).collect();
    let gone: Vec<&&str> = listed.iter().filter(|line| !said.contains_key(**line)).collect();
    assert!(said.len() > 400, "the source is read: {} messages", said.len());
    assert!(missing.is_empty(), "docs/FAQ.md lacks these; put each under what explains it:\n{}", missing.join("\n"));
    assert!(gone.is_empty(), "docs/FAQ.md has these, and no program says them:\n{gone:#?}");
}

/// Protects the test above from missing a message: texts in every place where a program speaks are found, as a person sees them.
#[test]
fn messages_are_found_where_they_stand() {
    let source = r##"
        #[error("{file}: no such thing here")] struct A; // "not in a comment at all"
        fn words(self) -> &'static str { match self { Self::A => "blurred", Self::B('"') => 'x' } }
        fn f<'a>() { say(&format!("lost {n} of \
            {m:.1} ml here")); println!("a result that is printed"); failure(1, r#"give a "better" file"#) }
    "##;
    let found: Vec<String> =
        texts(source).iter().map(|t| (t, shown(&t.text))).filter(|(t, s)| is_message("shared/src/x.rs", t, s)).map(|(_, s)| s).collect();
    assert_eq!(found, ["…: no such thing here", "blurred", "lost … of … ml here", "give a \"better\" file"]);
}
