//! The pieces of a self-contained HTML page: tables, facts, figures, and the page around them.
//!
//! Pure functions, for any thread. They allocate and do not fail.

/// Text as it must stand in HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A table, whose first row is the heading. On a narrower screen it can be scrolled.
pub fn table(rows: &[Vec<String>]) -> String {
    let mut html = String::from("<div class=scroll><table>");
    let words =
        |column: usize| rows.iter().skip(1).any(|r| r.get(column).is_some_and(|c| c.starts_with(char::is_alphabetic) && c != "NaN"));
    for (k, row) in rows.iter().enumerate() {
        let tag = if k == 0 { "th" } else { "td" };
        let class = |column: usize| if words(column) { " class=words" } else { "" };
        let cells: String = row.iter().enumerate().map(|(i, c)| format!("<{tag}{}>{}</{tag}>", class(i), escape(c))).collect();
        html += &format!("<tr>{cells}</tr>");
    }
    html + "</table></div>"
}

/// Names, and what they stand for in words, as a table.
pub fn facts(rows: &[(String, String)]) -> String {
    let row = |(name, what): &(String, String)| format!("<tr><th>{}</th><td>{}</td></tr>", escape(name), escape(what));
    format!("<table class=facts>{}</table>", rows.iter().map(row).collect::<String>())
}

/// The page around `body`.
pub fn page(title: &str, body: &str) -> String {
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><title>{title}</title><style>\
body{{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222}}\
h1{{font-size:1.6rem}}h2{{font-size:1.25rem;margin-top:2.2rem;border-bottom:1px solid #ccc}}\
.scroll{{overflow-x:auto}}table{{border-collapse:collapse;margin:1rem 0;font-size:.92rem;break-inside:avoid}}\
th,td{{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}}th{{background:#f2f4f7;vertical-align:bottom;white-space:normal}}\
td.words{{white-space:normal}}td:first-child{{white-space:nowrap}}\
th:first-child,td:first-child,.words,.facts td{{text-align:left}}.facts th{{vertical-align:top;white-space:nowrap}}.facts td{{white-space:normal;overflow-wrap:anywhere}}\
.plots{{display:grid;grid-template-columns:repeat(2,1fr);gap:1rem}}figure{{margin:0;break-inside:avoid}}\
figure svg{{width:100%;height:auto}}figcaption{{font-size:.9rem;color:#444}}.legend{{font-size:.85rem}}.legend span{{margin-right:.9em;white-space:nowrap}}code{{font-size:.85em}}\
@media screen and (max-width:45rem){{.plots{{grid-template-columns:1fr}}}}\
@media print{{html{{font-size:9pt}}body{{max-width:none;margin:0;padding:0;font-size:1rem}}h2,p,.scroll{{break-after:avoid}}.scroll{{overflow:visible}}\
table{{font-size:7.5pt}}th,td{{padding:.15rem .35rem}}figure{{margin-bottom:.5rem}}}}\
</style></head><body><h1>{title}</h1>{body}</body></html>\n",
        title = escape(title)
    )
}

/// A figure with a caption.
pub fn figure(svg: &str, caption: &str) -> String {
    format!("<figure>{svg}<figcaption>{}</figcaption></figure>", escape(caption))
}
