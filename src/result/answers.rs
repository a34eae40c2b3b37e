//! The groups `/points`, `/points_sheets`, `/map`, `/equal_cost` and `/folds`.

use super::TrajectorySchema;
use super::trajectories::{Axis, common, quotient, with_axes};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Values, Variable};
use crate::value::{Answers, Entry, Evidence, Grid, PointStatus};

const NO_SHEET: i32 = -1;

/// Units and names that the groups of a scene share.
pub(super) struct Names<'a> {
    schema: &'a TrajectorySchema,
    state_unit: String,
    costate_unit: String,
    control_unit: String,
    cost: String,
    rate: String,
}

impl<'a> Names<'a> {
    pub fn new(schema: &'a TrajectorySchema) -> Self {
        let cost = schema.cost().to_owned();
        let time = schema.time();
        let costates: Vec<String> = schema
            .states
            .iter()
            .map(|s| quotient(&cost, s.unit()))
            .collect();
        Self {
            state_unit: common(schema.states.iter().map(Axis::unit), "state_units"),
            costate_unit: common(costates.iter().map(String::as_str), "costate_units"),
            control_unit: common(schema.controls.iter().map(Axis::unit), "control_units"),
            rate: quotient(&cost, time),
            cost,
            schema,
        }
    }

    pub fn axes(&self, group: Group) -> Group {
        let group = with_axes(group, "state", &self.schema.states);
        let cost = &self.cost;
        let costates = self.schema.states.iter().map(|s| quotient(cost, s.unit()));
        let group = group.variable(
            Variable::text("costate_units", "state", costates)
                .long_name("unit of the costate of each state"),
        );
        with_axes(group, "control", &self.schema.controls)
    }

    /// V, p, u, the sheet and the way round over some dimensions.
    pub fn solution(&self, mut group: Group, dims: &[&str]) -> Group {
        let over = |last: &'static str| dims.iter().copied().chain([last]).collect::<Vec<_>>();
        group = group
            .variable(
                Variable::f64("V", dims.iter().copied())
                    .unit(&self.cost)
                    .long_name("value function"),
            )
            .variable(
                Variable::f64("p", over("state"))
                    .unit(&self.costate_unit)
                    .long_name("costate, the gradient of the value function"),
            );
        if !self.schema.controls.is_empty() {
            group = group.variable(
                Variable::f64("u", over("control"))
                    .unit(&self.control_unit)
                    .long_name("control"),
            );
        }
        group
            .variable(
                Variable::i32("sheet", dims.iter().copied())
                    .long_name("sheet of the value function; -1 where there is none"),
            )
            .variable(
                Variable::i32("lifted_sheet", dims.iter().copied()).long_name(
                    "sheet where copies by whole periods count as one; -1 where there is none",
                ),
            )
            .variable(
                Variable::i32("winding", over("state"))
                    .long_name("periods by which the solution's state is away from the point"),
            )
    }

    pub fn cost(&self) -> &str {
        &self.cost
    }

    /// Unit of a cost by time.
    pub fn rate(&self) -> &str {
        &self.rate
    }

    pub fn control_unit(&self) -> &str {
        &self.control_unit
    }

    pub fn costate(&self, name: &str, dims: &[&str]) -> Variable {
        Variable::f64(name, dims.iter().copied())
            .unit(&self.costate_unit)
            .long_name("costate")
    }

    pub fn state(&self, name: &str, dims: &[&str], what: &str) -> Variable {
        Variable::f64(name, dims.iter().copied())
            .unit(&self.state_unit)
            .long_name(what)
    }
}

pub(super) fn status<'d>(dims: impl IntoIterator<Item = &'d str>) -> Variable {
    Variable::i32("status", dims)
        .long_name("whether the point was solved, or why not")
        .flags(PointStatus::ALL.map(|(s, name)| (s as i32, name)))
}

/// What supports that V is the least.
fn support(group: Group, names: &Names<'_>, dims: &[&str]) -> Group {
    let over = || dims.iter().copied();
    group
        .variable(
            Variable::i32("evidence", over())
                .long_name("what supports that V is the least")
                .flags(Evidence::ALL.map(|(e, name)| (e as i32, name))),
        )
        .variable(
            Variable::f64("covered_to", over())
                .unit(&names.cost)
                .long_name("cost below which nothing cheaper than V was left out of the search"),
        )
        .variable(
            Variable::f64("bound", over())
                .unit(&names.cost)
                .long_name("cost of a flown control that undercuts V"),
        )
        .variable(Variable::i32("starts", over()).long_name("first guesses tried"))
        .variable(Variable::i32("flights", over()).long_name("controls flown"))
}

/// Columns of what supports some points.
#[derive(Default)]
struct SupportColumns {
    evidence: Vec<i32>,
    covered_to: Vec<f64>,
    bound: Vec<f64>,
    starts: Vec<i32>,
    flights: Vec<i32>,
}

impl SupportColumns {
    fn push(&mut self, answers: &Answers, target: usize) {
        let support = &answers.support[target];
        self.evidence.push(answers.evidence(target) as i32);
        self.covered_to.push(support.covered_to);
        self.bound.push(support.bound.unwrap_or(f64::NAN));
        self.starts.push(support.starts as i32);
        self.flights.push(support.flights as i32);
    }

    fn columns(&self) -> [(&'static str, Values<'_>); 5] {
        [
            ("evidence", (&self.evidence).into()),
            ("covered_to", (&self.covered_to).into()),
            ("bound", (&self.bound).into()),
            ("starts", (&self.starts).into()),
            ("flights", (&self.flights).into()),
        ]
    }
}

/// Columns of the solutions of some points.
#[derive(Default)]
struct Columns {
    value: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
    sheet: Vec<i32>,
    lifted: Vec<i32>,
    winding: Vec<i32>,
    status: Vec<i32>,
}

impl Columns {
    fn push(&mut self, names: &Names<'_>, entry: Option<&Entry>, status: PointStatus) {
        self.status.push(status as i32);
        let (n, m) = (names.schema.states.len(), names.schema.controls.len());
        match entry {
            Some(e) => {
                self.value.push(e.value);
                self.p.extend_from_slice(&e.p);
                self.u.extend_from_slice(&e.u);
                self.sheet.push(e.sheet);
                self.lifted.push(e.lifted);
                self.winding.extend_from_slice(&e.winding);
            }
            None => {
                self.value.push(f64::NAN);
                self.p.extend(vec![f64::NAN; n]);
                self.u.extend(vec![f64::NAN; m]);
                self.sheet.push(NO_SHEET);
                self.lifted.push(NO_SHEET);
                self.winding.extend(vec![0; n]);
            }
        }
    }
}

impl ResultFile {
    /// Writes `/points` and `/points_sheets` for the states given from the `first`-th on, `count`
    /// of them, in the order in which they were given.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn points(
        &mut self,
        schema: &TrajectorySchema,
        answers: &Answers,
        first: usize,
        count: usize,
    ) -> Result<(), OutputError> {
        if count == 0 {
            return Ok(());
        }
        let names = Names::new(schema);
        let given = &answers.targets.of_given[first..first + count];
        let n = schema.states.len();
        let mut group = Group::new("points")
            .attribute("title", "value function at chosen states")
            .expected_rows(Some(count))
            .dimension(Dimension::unlimited("point"));
        group = names.axes(group);
        group = group.variable(names.state("x0", &["point", "state"], "chosen state"));
        group = names
            .solution(group, &["point"])
            .variable(status(["point"]))
            .variable(
                Variable::i32("iterations", ["point"])
                    .long_name("integrations of the whole trajectory"),
            )
            .variable(
                Variable::f64("residual", ["point"])
                    .long_name("last Newton correction relative to the trajectory's size"),
            )
            .variable(
                Variable::f64("H", ["point"])
                    .unit(&names.rate)
                    .long_name("Hamiltonian"),
            )
            .variable(Variable::i32("sheets", ["point"]).long_name("number of solutions found"))
            .variable(names.state(
                "furthest",
                &["point", "state"],
                "the point itself, or the furthest state reached on the way to it",
            ));
        group = support(group, &names, &["point"]).variable(
            Variable::f64("flown", ["point"])
                .unit(&names.cost)
                .long_name(
                    "cost of a simulated control along the answer, of states that were listed",
                ),
        );
        let mut columns = Columns::default();
        let mut supports = SupportColumns::default();
        let (mut x0, mut furthest) = (Vec::new(), Vec::new());
        let (mut iterations, mut sheets) = (Vec::new(), Vec::new());
        let (mut residual, mut h, mut flown) = (Vec::new(), Vec::new(), Vec::new());
        for &target in given {
            let entry = answers.answer(target);
            columns.push(&names, entry, answers.status(target));
            supports.push(answers, target);
            let state = answers.targets.state(target);
            x0.extend_from_slice(state);
            match &answers.misses[target] {
                None => furthest.extend_from_slice(state),
                Some(miss) => match &miss.furthest {
                    Some(x) => furthest.extend_from_slice(x),
                    None => furthest.extend(vec![f64::NAN; n]),
                },
            }
            iterations.push(entry.map_or(0, |e| e.iterations as i32));
            residual.push(entry.map_or(f64::NAN, |e| e.residual));
            h.push(entry.map_or(f64::NAN, |e| e.hamiltonian));
            flown.push(answers.support[target].flown.unwrap_or(f64::NAN));
            sheets.push(answers.of(target).len() as i32);
        }
        let mut writer = self.group(&group)?;
        let mut values = vec![
            ("x0", (&x0).into()),
            ("V", (&columns.value).into()),
            ("p", (&columns.p).into()),
            ("sheet", (&columns.sheet).into()),
            ("lifted_sheet", (&columns.lifted).into()),
            ("winding", (&columns.winding).into()),
            ("status", (&columns.status).into()),
            ("iterations", (&iterations).into()),
            ("residual", (&residual).into()),
            ("H", (&h).into()),
            ("sheets", (&sheets).into()),
            ("furthest", (&furthest).into()),
            ("flown", (&flown).into()),
        ];
        values.extend(supports.columns());
        if !schema.controls.is_empty() {
            values.push(("u", (&columns.u).into()));
        }
        writer.append(count, &values)?;
        self.points_sheets(&names, answers, given)
    }

    fn points_sheets(
        &mut self,
        names: &Names<'_>,
        answers: &Answers,
        given: &[usize],
    ) -> Result<(), OutputError> {
        let mut columns = Columns::default();
        let (mut point, mut h, mut residual) = (Vec::new(), Vec::new(), Vec::new());
        for (k, &target) in given.iter().enumerate() {
            for entry in answers.of(target) {
                point.push(k as i32);
                columns.push(names, Some(entry), PointStatus::Converged);
                h.push(entry.hamiltonian);
                residual.push(entry.residual);
            }
        }
        if point.is_empty() {
            return Ok(());
        }
        let mut group = Group::new("points_sheets")
            .attribute(
                "title",
                "all solutions found at the chosen states, optimal or not",
            )
            .expected_rows(Some(point.len()))
            .dimension(Dimension::unlimited("entry"));
        group = names.axes(group);
        group = group
            .variable(Variable::i32("point", ["entry"]).long_name("index of the point in /points"));
        group = names
            .solution(group, &["entry"])
            .variable(
                Variable::f64("H", ["entry"])
                    .unit(&names.rate)
                    .long_name("Hamiltonian"),
            )
            .variable(
                Variable::f64("residual", ["entry"])
                    .long_name("last Newton correction relative to the trajectory's size"),
            );
        let mut writer = self.group(&group)?;
        let mut values = vec![
            ("point", (&point).into()),
            ("V", (&columns.value).into()),
            ("p", (&columns.p).into()),
            ("sheet", (&columns.sheet).into()),
            ("lifted_sheet", (&columns.lifted).into()),
            ("winding", (&columns.winding).into()),
            ("H", (&h).into()),
            ("residual", (&residual).into()),
        ];
        if !names.schema.controls.is_empty() {
            values.push(("u", (&columns.u).into()));
        }
        writer.append(point.len(), &values)
    }

    /// Writes `/map` for a grid whose points are those given from the `first`-th on. V above
    /// `value_max` is left out.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn map(
        &mut self,
        schema: &TrajectorySchema,
        answers: &Answers,
        grid: &Grid,
        first: usize,
        value_max: Option<f64>,
    ) -> Result<(), OutputError> {
        let names = Names::new(schema);
        let dims: Vec<&str> = schema.states.iter().map(|s| s.name.as_str()).collect();
        let mut group = Group::new("map").attribute(
            "title",
            "value function on a regular grid: the lowest sheet",
        );
        for (axis, values) in schema.states.iter().zip(&grid.axes) {
            group = group.dimension(
                Dimension::values(&axis.name, values.clone(), axis.unit())
                    .long_name(axis.description()),
            );
        }
        group = names.axes(group);
        group = names
            .solution(group, &dims)
            .variable(status(dims.iter().copied()));
        group = support(group, &names, &dims);
        let mut columns = Columns::default();
        let mut supports = SupportColumns::default();
        for k in 0..grid.len() {
            let target = answers.targets.of_given[first + k];
            let lowest = answers.answer(target);
            let entry = lowest.filter(|e| value_max.is_none_or(|most| e.value <= most));
            let status = match (lowest, entry) {
                (Some(_), None) => PointStatus::AboveMax,
                _ => answers.status(target),
            };
            columns.push(&names, entry, status);
            supports.push(answers, target);
        }
        let mut writer = self.group(&group)?;
        for (name, values) in supports.columns() {
            writer.write(name, values)?;
        }
        writer.write("V", &columns.value)?;
        writer.write("p", &columns.p)?;
        if !schema.controls.is_empty() {
            writer.write("u", &columns.u)?;
        }
        writer.write("sheet", &columns.sheet)?;
        writer.write("lifted_sheet", &columns.lifted)?;
        writer.write("winding", &columns.winding)?;
        writer.write("status", &columns.status)
    }

    /// Writes `/equal_cost` and `/folds`, where there are any.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn sheet_edges(
        &mut self,
        schema: &TrajectorySchema,
        answers: &Answers,
    ) -> Result<(), OutputError> {
        let names = Names::new(schema);
        self.equal_cost(&names, answers)?;
        if answers.folds.is_empty() {
            return Ok(());
        }
        let mut group = Group::new("folds")
            .attribute("title", "points where a sheet turns back")
            .expected_rows(Some(answers.folds.len()))
            .dimension(Dimension::unlimited("vertex"));
        group = names.axes(group);
        group = group
            .variable(names.state("x", &["vertex", "state"], "state"))
            .variable(names.costate("p", &["vertex", "state"]))
            .variable(
                Variable::f64("V", ["vertex"])
                    .unit(&names.cost)
                    .long_name("cost of the extremal"),
            );
        let flat = |f: &dyn Fn(&crate::value::Fold) -> Vec<f64>| {
            answers.folds.iter().flat_map(f).collect::<Vec<f64>>()
        };
        let (x, p, v) = (
            flat(&|f| f.s.clone()),
            flat(&|f| f.p.clone()),
            flat(&|f| vec![f.value]),
        );
        let mut writer = self.group(&group)?;
        writer.append(
            answers.folds.len(),
            &[("x", (&x).into()), ("p", (&p).into()), ("V", (&v).into())],
        )
    }

    fn equal_cost(&mut self, names: &Names<'_>, answers: &Answers) -> Result<(), OutputError> {
        if answers.equal_cost.is_empty() {
            return Ok(());
        }
        let mut order: Vec<_> = answers.equal_cost.iter().collect();
        order.sort_by_key(|e| (e.point.line, e.point.place));
        let mut group = Group::new("equal_cost")
            .attribute(
                "title",
                "points where two sheets cost the same and the optimal control jumps",
            )
            .expected_rows(Some(order.len()))
            .dimension(Dimension::unlimited("vertex"))
            .dimension(Dimension::index("side", 2));
        group = names.axes(group);
        group = group
            .variable(names.state("x", &["vertex", "state"], "state"))
            .variable(
                Variable::f64("V", ["vertex"])
                    .unit(&names.cost)
                    .long_name("value function"),
            )
            .variable(
                Variable::f64("difference", ["vertex"])
                    .long_name("difference of V between the sheets, relative to V"),
            )
            .variable(Variable::i32("sheet", ["vertex", "side"]).long_name("the two sheets"))
            .variable(
                Variable::f64("p", ["vertex", "side", "state"])
                    .unit(&names.costate_unit)
                    .long_name("costate on each sheet"),
            )
            .variable(
                Variable::i32("line", ["vertex"])
                    .long_name("polyline; -1 where the points form none"),
            )
            .variable(Variable::i32("place", ["vertex"]).long_name("place on the polyline"));
        let controls = !names.schema.controls.is_empty();
        if controls {
            group = group
                .variable(
                    Variable::f64("u", ["vertex", "side", "control"])
                        .unit(&names.control_unit)
                        .long_name("control on each sheet"),
                )
                .variable(
                    Variable::f64("jump", ["vertex", "control"])
                        .unit(&names.control_unit)
                        .long_name("control on the second sheet less that on the first"),
                );
        }
        let flat = |f: &dyn Fn(&crate::value::EqualCost) -> Vec<f64>| {
            order.iter().flat_map(|e| f(e)).collect::<Vec<f64>>()
        };
        let x = flat(&|e| e.point.x.clone());
        let value = flat(&|e| vec![e.point.value]);
        let difference = flat(&|e| vec![e.point.difference]);
        let p = flat(&|e| e.point.p.concat());
        let u = flat(&|e| e.u.concat());
        let jump = flat(&|e| e.u[1].iter().zip(&e.u[0]).map(|(b, a)| b - a).collect());
        let sheet: Vec<i32> = order.iter().flat_map(|e| e.point.sheets).collect();
        let line: Vec<i32> = order.iter().map(|e| e.point.line).collect();
        let place: Vec<i32> = order.iter().map(|e| e.point.place).collect();
        let mut writer = self.group(&group)?;
        let mut values = vec![
            ("x", (&x).into()),
            ("V", (&value).into()),
            ("difference", (&difference).into()),
            ("sheet", (&sheet).into()),
            ("p", (&p).into()),
            ("line", (&line).into()),
            ("place", (&place).into()),
        ];
        if controls {
            values.extend([("u", (&u).into()), ("jump", (&jump).into())]);
        }
        writer.append(order.len(), &values)
    }
}
