//! Precedence, places inside strings, and what must hold for any text and any expression.

use super::build::{Origin, Use};
use super::equilibrium::sized;
use super::parser::{parse_expression, parse_guard};
use super::quoted::Offsets;
use super::reader::Reader;
use super::scope::{Entry, Kinds, Meaning, Role};
use crate::diagnostics::nearest;
use crate::expr::{Fun, Graph, Id, Kind, Node, Op};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use rustc_hash::FxHashMap;
use toml::de::DeTable;

/// A reader in which x, y and z are states.
fn reader() -> (Reader<'static>, Vec<Id>) {
    let mut reader = Reader::new("");
    let symbols = ["x", "y", "z"].map(|name| {
        let expr = reader.graph.symbol(name, Kind::State);
        let meaning = Meaning::Known {
            expr,
            kinds: Kinds::STATE,
        };
        reader.scope.declare(
            name,
            Entry {
                role: Role::State,
                span: 0..0,
                meaning,
            },
        );
        expr
    });
    (reader, symbols.to_vec())
}

fn build(reader: &mut Reader<'_>, text: &str) -> Option<Id> {
    let purpose = Use {
        what: "the test",
        allowed: Kinds::ALL,
        rule: "everything",
    };
    reader
        .parse_and_build(text, &Origin::CommandLine(String::new()), &purpose)
        .map(|b| b.expr)
}

/// Value of `text` at x = 2, y = 3, z = 5.
fn value(text: &str) -> f64 {
    let (mut reader, symbols) = reader();
    let expr = build(&mut reader, text).unwrap_or_else(|| panic!("{text}: {:?}", reader.problems));
    let values: FxHashMap<Id, f64> = symbols.into_iter().zip([2.0, 3.0, 5.0]).collect();
    reader.graph.eval(&[expr], &values)[0]
}

#[test]
fn precedence() {
    for (text, expected) in [
        ("1 + x*y", 7.0),
        ("(1 + x)*y", 9.0),
        ("z - y - x", 0.0),
        ("z - (y - x)", 4.0),
        ("y/x/x", 0.75),
        ("y/(x/x)", 3.0),
        ("y/x*z", 7.5),
        ("x^y^x", 512.0),
        ("(x^y)^x", 64.0),
        ("-x^2", -4.0),
        ("(-x)^2", 4.0),
        ("2^-x", 0.25),
        ("2^-x^2", 0.0625),
        ("2^-1*y", 1.5),
        ("-x*y", -6.0),
        ("y*-x", -6.0),
        ("y - -x", 5.0),
        ("--x", 2.0),
        ("+x - +y", -1.0),
        ("-2 - 3", -5.0),
        ("1 - x^2*y + z", -6.0),
        (".5 + 1. + 1e-3 + 1.5E+3 + 0.25e1", 1504.001),
        ("cos(pi*(x - 1)) + sqrt(x + x)", 1.0),
        ("log(exp(x))", 2.0),
        (" x\n\t+\r\n y ", 5.0),
        ("abs(y - z)", 2.0),
    ] {
        let found = value(text);
        assert!(
            (found - expected).abs() <= 1e-12 * expected.abs().max(1.0),
            "{text} = {found}, not {expected}"
        );
    }
}

#[test]
fn chains_are_as_deep_as_they_must() {
    let sum = vec!["x"; 50_000].join(" + ");
    assert_eq!(value(&sum), 100_000.0);
    assert_eq!(
        value(&format!("{}x{}", "(".repeat(200), ")".repeat(200))),
        2.0
    );
    // Signs and powers nest only until the next sum or product.
    assert_eq!(value(&vec!["-x^1^1"; 300].join(" + ")), -600.0);
    assert_eq!(value(&vec!["(-x^2)"; 300].join(" - ")), 1192.0);
}

#[test]
fn places_follow_escapes() {
    let text = "a = \"\"\"\r\n  \\u0078\\t+ \\\r\n   é y\\U0001F600\"\"\"";
    let document = DeTable::parse(text).expect("good TOML");
    let literal = document.get_ref().get("a").expect("it has this key");
    let value = literal.get_ref().as_str().expect("a string");
    let offsets = Offsets::of(text, &literal.span(), value);
    let at = |c: char| {
        let start = value.find(c).expect("in the value");
        &text[offsets.locate(&(start..start + c.len_utf8()))]
    };
    assert_eq!(at('x'), "\\u0078");
    assert_eq!(at('\t'), "\\t");
    assert_eq!(at('+'), "+");
    assert_eq!(at('é'), "é");
    assert_eq!(at('y'), "y");
    assert_eq!(at('\u{1f600}'), "\\U0001F600");
}

#[test]
fn suggestions() {
    let names = ["theta", "omega", "u", "value_max", "sin", "asin"];
    for (name, expected) in [
        ("thta", Some("theta")),
        ("THETA", Some("theta")),
        ("thetaa", Some("theta")),
        ("htea", None),
        ("v", None),
        ("U", Some("u")),
        ("valuemax", Some("value_max")),
        ("sine", Some("sin")),
        ("banana", None),
        ("", None),
    ] {
        assert_eq!(nearest(name, names), expected, "{name}");
    }
}

/// Expressions, to be built with the graph's own constructors.
#[derive(Clone, Debug)]
enum Shape {
    Constant(f64),
    Symbol(usize),
    Negate(Box<Shape>),
    Unary(Fun, Box<Shape>),
    Binary(Op, Box<Shape>, Box<Shape>),
    Powi(Box<Shape>, i32),
}

fn shape() -> impl Strategy<Value = Shape> {
    let numbers = vec![
        -3.0, -1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 2.0, 7.0, 1e-7, -2.5e-9, 1e17,
    ];
    let leaf = prop_oneof![
        proptest::sample::select(numbers).prop_map(Shape::Constant),
        (0..3usize).prop_map(Shape::Symbol),
        (0..3usize).prop_map(Shape::Symbol),
    ];
    leaf.prop_recursive(6, 48, 2, |inner| {
        let ops = vec![Op::Add, Op::Sub, Op::Mul, Op::Div, Op::Pow];
        let functions: Vec<Fun> = Fun::CALLABLE.iter().map(|(_, f)| *f).collect();
        prop_oneof![
            1 => inner.clone().prop_map(|a| Shape::Negate(Box::new(a))),
            1 => (proptest::sample::select(functions), inner.clone()).prop_map(|(f, a)| Shape::Unary(f, Box::new(a))),
            1 => (inner.clone(), -4..6).prop_map(|(a, n)| Shape::Powi(Box::new(a), n)),
            4 => (proptest::sample::select(ops), inner.clone(), inner)
                .prop_map(|(op, a, b)| Shape::Binary(op, Box::new(a), Box::new(b))),
        ]
    })
}

fn make(graph: &mut Graph, symbols: &[Id], shape: &Shape) -> Id {
    match shape {
        Shape::Constant(c) => graph.constant(*c),
        Shape::Symbol(i) => symbols[*i],
        Shape::Negate(a) => {
            let a = make(graph, symbols, a);
            graph.neg(a)
        }
        Shape::Unary(f, a) => {
            let a = make(graph, symbols, a);
            graph.unary(*f, a)
        }
        Shape::Binary(op, a, b) => {
            let (a, b) = (make(graph, symbols, a), make(graph, symbols, b));
            graph.binary(*op, a, b)
        }
        Shape::Powi(a, n) => {
            let a = make(graph, symbols, a);
            graph.powi(a, *n)
        }
    }
}

/// The value of a shape by plain arithmetic, without the graph, and how far rounding may move it;
/// NaN where any part of it is large or not finite.
fn direct(shape: &Shape, at: &[f64]) -> (f64, f64) {
    // Leaves count as rounded too, some hundred times over, since the graph regroups operations.
    const LEAF: f64 = 300.0 * f64::EPSILON;
    let spread = |f: &dyn Fn(f64) -> f64, (v, e): (f64, f64)| {
        let moved = (f(v + e) - f(v)).abs() + (f(v - e) - f(v)).abs();
        (f(v), moved + LEAF * f(v).abs())
    };
    let (value, error) = match shape {
        Shape::Constant(c) => (*c, LEAF * c.abs()),
        Shape::Symbol(i) => (at[*i], LEAF * at[*i].abs()),
        Shape::Negate(a) => spread(&|x| -x, direct(a, at)),
        Shape::Unary(f, a) => spread(&|x| f.apply(x), direct(a, at)),
        Shape::Powi(a, n) => spread(&|x| x.powi(*n), direct(a, at)),
        Shape::Binary(op, a, b) => {
            let (a, b) = (direct(a, at), direct(b, at));
            let f = |x: f64, y: f64| match op {
                Op::Add => x + y,
                Op::Sub => x - y,
                Op::Mul => x * y,
                Op::Div => x / y,
                _ => x.powf(y),
            };
            let (value, first) = spread(&|x| f(x, b.0), a);
            (value, first + spread(&|y| f(a.0, y), b).1)
        }
    };
    // A part beyond this size has lost the digits that a sum or a sine around it may need.
    if value.abs() <= 1e3 {
        (value, error)
    } else {
        (f64::NAN, f64::NAN)
    }
}

/// A shape as text with every operation in parentheses.
fn spelled(shape: &Shape) -> String {
    match shape {
        Shape::Constant(c) => format!("({c:?})"),
        Shape::Symbol(i) => ["x", "y", "z"][*i].to_owned(),
        Shape::Negate(a) => format!("(-{})", spelled(a)),
        Shape::Unary(f, a) => format!("{}({})", f.name(), spelled(a)),
        Shape::Powi(a, n) => format!("({}^({n}))", spelled(a)),
        Shape::Binary(op, a, b) => {
            let sign = match op {
                Op::Add => "+",
                Op::Sub => "-",
                Op::Mul => "*",
                Op::Div => "/",
                _ => "^",
            };
            format!("({}{sign}{})", spelled(a), spelled(b))
        }
    }
}

/// Whether two ways to compute one value agree. `size`: largest of the terms on the way. Rounding
/// differs where terms are regrouped, by some epsilons of the terms' size for each of the up to
/// hundred operations.
fn agree(a: f64, b: f64, size: f64) -> bool {
    const ROUNDING: f64 = 1e5 * f64::EPSILON;
    // Beyond this size nothing is left of the digits of a sum, or of the argument of a sine.
    const SIZE: f64 = 1e6;
    size.is_nan() || size > SIZE || (a - b).abs() <= ROUNDING * (1.0 + size)
}

/// Value of an expression and the largest size of the terms in any part of it.
fn value_and_size(graph: &Graph, root: Id, values: &FxHashMap<Id, f64>) -> (f64, f64) {
    let sizes = graph
        .reachable(&[root])
        .into_iter()
        .map(|id| sized(graph, id, values).1);
    let largest = sizes.fold(0.0, |a: f64, b| {
        if b.is_finite() {
            a.max(b)
        } else {
            f64::INFINITY
        }
    });
    (sized(graph, root, values).0, largest)
}

fn has_only_finite_constants(graph: &Graph, root: Id) -> bool {
    graph
        .reachable(&[root])
        .into_iter()
        .all(|id| match graph.node(id) {
            Node::Const(bits) => f64::from_bits(bits).is_finite(),
            _ => true,
        })
}

/// The same cases in every run; `PROPTEST_RNG_SEED` and `PROPTEST_CASES` choose others.
fn config() -> ProptestConfig {
    let mut config = ProptestConfig {
        failure_persistence: None,
        ..ProptestConfig::default()
    };
    if std::env::var_os("PROPTEST_CASES").is_none() {
        config.cases = 2000;
    }
    if std::env::var_os("PROPTEST_RNG_SEED").is_none() {
        config.rng_seed = RngSeed::Fixed(1999);
    }
    config
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn printed_expressions_parse_to_equal_values(
        shape in shape(),
        points in proptest::collection::vec([-2.0..2.0f64, -2.0..2.0f64, -2.0..2.0f64], 4),
    ) {
        let (mut reader, symbols) = reader();
        let first = make(&mut reader.graph, &symbols, &shape);
        if !has_only_finite_constants(&reader.graph, first) {
            return Ok(());
        }
        let text = reader.graph.show(first);
        let second = build(&mut reader, &text);
        prop_assert!(second.is_some(), "{text}: {:?}", reader.problems);
        for point in points {
            let values: FxHashMap<Id, f64> = symbols.iter().copied().zip(point).collect();
            let (a, size) = value_and_size(&reader.graph, first, &values);
            let b = sized(&reader.graph, second.unwrap_or(first), &values).0;
            prop_assert!(agree(a, b, size), "{text} is {a}, parsed again {b}");
        }
    }

    #[test]
    fn parsed_expressions_have_the_value_of_plain_arithmetic(
        shape in shape(),
        points in proptest::collection::vec([-2.0..2.0f64, -2.0..2.0f64, -2.0..2.0f64], 4),
    ) {
        let (mut reader, symbols) = reader();
        let text = spelled(&shape);
        // Parts that are not finite are refused when they are constant.
        let Some(expr) = build(&mut reader, &text) else {
            prop_assert!(reader.problems[0].message.contains("not finite"), "{:?}", reader.problems);
            return Ok(());
        };
        for point in points {
            let values: FxHashMap<Id, f64> = symbols.iter().copied().zip(point).collect();
            let a = reader.graph.eval(&[expr], &values)[0];
            let (b, error) = direct(&shape, &point);
            prop_assert!(error.is_nan() || (a - b).abs() <= error, "{text} is {b} within {error}, not {a}");
        }
    }

    #[test]
    fn no_text_makes_the_parser_panic(text in "\\PC{0,80}") {
        let _ = parse_expression(&text);
        let _ = parse_guard(&text);
    }

    #[test]
    fn no_mutation_makes_the_parser_panic(
        shape in shape(),
        edits in proptest::collection::vec((any::<proptest::sample::Index>(), "[-+*/^(),.<>=!0-9exyz \u{e4}\u{2212}]{0,3}", 0..3usize), 1..5),
    ) {
        let mut text: Vec<char> = spelled(&shape).chars().collect();
        for (index, new, removed) in edits {
            let at = index.index(text.len() + 1);
            let end = (at + removed).min(text.len());
            text.splice(at..end, new.chars());
        }
        let text: String = text.into_iter().collect();
        for error in [parse_expression(&text).err(), parse_guard(&text).err()].into_iter().flatten() {
            prop_assert!(error.span.start <= error.span.end && error.span.end <= text.len(), "{text}: {error:?}");
            prop_assert!(text.is_char_boundary(error.span.start) && text.is_char_boundary(error.span.end));
            prop_assert!(!error.message.is_empty() && !error.label.is_empty());
        }
        let (mut reader, _) = reader();
        build(&mut reader, &text);
    }

    #[test]
    fn every_character_of_a_string_is_found_in_the_file(
        parts in proptest::collection::vec(("[a-z \"\\\\\u{e9}\u{1f600}]", 0..3u8), 0..30),
    ) {
        // Each character as it is, or as one of two escapes; then its place must be that of its
        // notation.
        let (mut text, mut value, mut places) = ("key = \"".to_owned(), String::new(), Vec::new());
        for (character, notation) in parts {
            let c = character.chars().next().unwrap_or('x');
            let written = match notation {
                0 if c != '"' && c != '\\' => c.to_string(),
                1 if u32::from(c) < 0x10000 => format!("\\u{:04x}", u32::from(c)),
                _ => format!("\\U{:08X}", u32::from(c)),
            };
            places.push((value.len()..value.len() + c.len_utf8(), text.len()..text.len() + written.len()));
            text += &written;
            value.push(c);
        }
        text += "\"";
        let document = DeTable::parse(&text).expect("good TOML");
        let literal = document.get_ref().get("key").expect("it has this key");
        prop_assert_eq!(literal.get_ref().as_str(), Some(value.as_str()));
        let offsets = Offsets::of(&text, &literal.span(), &value);
        for (inside, place) in places {
            prop_assert_eq!(offsets.locate(&inside), place);
        }
        prop_assert_eq!(offsets.locate(&(value.len()..value.len())), text.len() - 1..text.len() - 1);
    }

    #[test]
    fn no_scene_makes_the_reader_panic(
        edits in proptest::collection::vec((any::<proptest::sample::Index>(), "[-+*/^()\\[\\]{}\"'#=,.<>a-z0-9 \n\\\\\u{e4}]{0,4}", 0..6usize), 1..6),
    ) {
        let mut text: Vec<char> = include_str!("../../scenarios/moore_greitzer.toml").chars().collect();
        for (index, new, removed) in edits {
            let at = index.index(text.len() + 1);
            let end = (at + removed).min(text.len());
            text.splice(at..end, new.chars());
        }
        let text: String = text.into_iter().collect();
        if let Err(errors) = super::parse(&text, "scene.toml", &[]) {
            prop_assert!(!errors.problems.is_empty());
            prop_assert!(!errors.render(false).is_empty());
        }
    }
}
