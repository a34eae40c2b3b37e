//! The page: everything in one file, readable on light and dark ground, on paper and on a narrow
//! screen.

use super::svg::escaped;
use super::tables::{self, Table};
use super::{Picture, Source, equations};
use std::fmt::Write as _;
use std::path::Path;

/// Colours by purpose are those of `canvas::Ink`; pictures name them by classes.
const STYLE: &str = "\
:root{color-scheme:light dark;--paper:#fff;--text:#1c1e21;--muted:#696e76;--grid:#e2e4e7;--card:#f6f7f8;--link:#0060a0}
@media(prefers-color-scheme:dark){:root{--paper:#15171a;--text:#e4e6e9;--muted:#9aa1aa;--grid:#2c3036;--card:#1d2024;--link:#6cb4f0}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--text);font:16px/1.5 system-ui,-apple-system,'Segoe UI',Helvetica,Arial,sans-serif}
main{max-width:960px;margin:0 auto;padding:24px 16px 64px}
h1{font-size:1.6rem;line-height:1.25;margin:.2em 0 .4em}h2{font-size:1.15rem;margin:2em 0 .5em}
a{color:var(--link)}nav a{margin-right:1em;white-space:nowrap}nav{font-size:.92rem;margin:.6em 0 1.4em}
code,pre{font:.86rem/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,monospace}
pre{margin:0;white-space:pre-wrap;overflow-wrap:anywhere}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.15em 1.2em;margin:0;font-size:.92rem}
dt{color:var(--muted)}dd{margin:0;overflow-wrap:anywhere}
.card{background:var(--card);border-radius:8px;padding:14px 18px;margin:14px 0}
figure{margin:28px 0;overflow-x:auto}figure svg{display:block;max-width:100%;height:auto;min-width:560px}
figcaption{font-size:.92rem;color:var(--text);margin-top:6px;max-width:80ch}figcaption a{color:var(--muted)}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.88rem;margin:.4em 0}
th,td{padding:.28em .8em;text-align:right;border-bottom:1px solid var(--grid);white-space:nowrap}
th:first-child,td:first-child{text-align:left}th{color:var(--muted);font-weight:600;vertical-align:bottom;white-space:normal}
.note{color:var(--muted);font-size:.9rem}
svg .ft{fill:var(--text)}svg .fm{fill:var(--muted)}svg .fg{fill:var(--grid)}svg .fp{fill:var(--paper)}
svg .st{stroke:var(--text)}svg .sm{stroke:var(--muted)}svg .sg{stroke:var(--grid)}svg .sp{stroke:var(--paper)}
@media print{main{max-width:none}figure{break-inside:avoid}}
";

/// How every page begins: what is replaced begins so.
pub const HEAD: &str = "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
    <meta name=\"generator\" content=\"costate report\">\n";

/// The page's text; `drawn` are the pictures as SVG, `folder` is where their files are.
pub fn html(
    source: &Source<'_>,
    pictures: &[Picture],
    drawn: &[String],
    missing: &[(String, String)],
    folder: &Path,
) -> String {
    let mut page = Page(String::new());
    let title = escaped(&source.model.title);
    page.add(&format!(
        "{HEAD}<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
    ));
    let (tables, unreadable) = tables::all(source);
    page.contents(pictures, &tables);
    page.problem(source);
    page.figures(source);
    let folder = folder
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    for (picture, svg) in pictures.iter().zip(drawn) {
        page.figure(picture, svg, &folder);
    }
    for table in &tables {
        page.table(table);
    }
    page.missing(missing.iter().chain(&unreadable));
    let file = source
        .stored
        .path
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    page.add(&format!(
        "<p class=\"note\">Report of {} by costate {}. Pictures as files: folder {}.</p>\n</main>\n</body>\n</html>\n",
        escaped(&file),
        env!("CARGO_PKG_VERSION"),
        escaped(&folder)
    ));
    page.0
}

struct Page(String);

impl Page {
    fn add(&mut self, text: &str) {
        self.0.push_str(text);
    }

    fn contents(&mut self, pictures: &[Picture], tables: &[Table]) {
        if pictures.len() + tables.len() < 2 {
            return;
        }
        self.add("<nav>\n");
        for p in pictures {
            let _ = writeln!(
                self.0,
                "<a href=\"#{}\">{}</a>",
                escaped(&p.name),
                escaped(&short(&p.title))
            );
        }
        for t in tables {
            let _ = writeln!(
                self.0,
                "<a href=\"#{}\">{}</a>",
                anchor(&t.title),
                escaped(&t.title)
            );
        }
        self.add("</nav>\n");
    }

    fn problem(&mut self, source: &Source<'_>) {
        self.add("<div class=\"card\">\n<dl>\n");
        for group in equations::of(source.model) {
            let lines = escaped(&group.lines.join("\n"));
            let _ = writeln!(
                self.0,
                "<dt>{}</dt><dd><pre>{lines}</pre></dd>",
                escaped(&group.heading)
            );
        }
        self.add("</dl>\n</div>\n");
    }

    fn figures(&mut self, source: &Source<'_>) {
        self.add("<div class=\"card\">\n<dl>\n");
        for (name, value) in tables::key_figures(source) {
            let _ = writeln!(
                self.0,
                "<dt>{}</dt><dd>{}</dd>",
                escaped(&name),
                escaped(&value)
            );
        }
        self.add("</dl>\n</div>\n");
    }

    fn figure(&mut self, picture: &Picture, svg: &str, folder: &str) {
        let name = escaped(&picture.name);
        let link = |kind: &str| {
            format!(
                "<a href=\"{}/{name}.{kind}\">{}</a>",
                encoded(folder),
                kind.to_uppercase()
            )
        };
        let _ = write!(
            self.0,
            "<figure id=\"{name}\">\n{svg}<figcaption>{} ({}, {})</figcaption>\n</figure>\n",
            escaped(&picture.caption),
            link("svg"),
            link("png")
        );
    }

    fn table(&mut self, table: &Table) {
        let _ = write!(
            self.0,
            "<h2 id=\"{}\">{}</h2>\n<div class=\"wide\"><table>\n<tr>",
            anchor(&table.title),
            escaped(&table.title)
        );
        for column in &table.columns {
            let _ = write!(self.0, "<th>{}</th>", escaped(column));
        }
        self.add("</tr>\n");
        for row in &table.rows {
            self.add("<tr>");
            for cell in row {
                let _ = write!(self.0, "<td>{}</td>", escaped(cell));
            }
            self.add("</tr>\n");
        }
        let _ = writeln!(
            self.0,
            "</table></div>\n<p class=\"note\">{}</p>",
            escaped(&table.caption)
        );
    }

    fn missing<'m>(&mut self, missing: impl Iterator<Item = &'m (String, String)>) {
        let mut missing = missing.peekable();
        if missing.peek().is_none() {
            return;
        }
        self.add("<h2 id=\"missing\">Not shown</h2>\n<ul>\n");
        for (name, reason) in missing {
            let _ = writeln!(self.0, "<li>{}: {}</li>", escaped(name), escaped(reason));
        }
        self.add("</ul>\n");
    }
}

fn anchor(title: &str) -> String {
    title.to_lowercase().replace(' ', "-")
}

/// A title without what follows its first clause.
fn short(title: &str) -> String {
    let end = title.find([':', ',']).unwrap_or(title.len());
    let end = title[..end].find(" at ").unwrap_or(end);
    title[..end].to_owned()
}

/// A file's name in a link.
fn encoded(name: &str) -> String {
    let mut out = String::new();
    for b in name.bytes() {
        if b.is_ascii_alphanumeric() || b"-_.~".contains(&b) {
            out.push(char::from(b));
        } else {
            let _ = write!(out, "%{b:02X}");
        }
    }
    out
}
