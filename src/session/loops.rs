//! Laws in the closed loop: `[closed_loop]` and `[dissipation]` of a scene.

use super::progress::Finished;
use super::{Session, SessionError};
use crate::backend::cpu::in_pool;
use crate::closed_loop::dissipation::{self, Certificate, Dissipation};
use crate::closed_loop::{
    Available, Chart, Evaluation, Gathered, Initial, LQR, Law, Laws, LoopError, MAP, Setting,
    Weights, solved_values, values_of_blocks,
};
use crate::expr::Id;
use crate::map::{At, ValueMap};
use crate::model::{ClosedLoop, Model, Outside};
use crate::scene::Scene;
use crate::sweep::{Choices, Numerics};
use crate::trajectories::SolvedStates;
use crate::value::count_blocks;

/// V at the initial states of `[dissipation]` is solved for with this tolerance, unless the scene's
/// is tighter.
const SOLVED_RTOL: f64 = 1e-8;

/// What laws and V are taken from, besides the scene.
#[derive(Default)]
pub struct Sources {
    /// A map of V: it gives the law `map`, and V at initial states.
    pub map: Option<ValueMap>,
    /// States that V was solved for at.
    pub solved: Option<SolvedStates>,
    /// Laws that were fitted before.
    pub fitted: Vec<Weights>,
    /// Further laws, which are always simulated.
    pub added: Vec<Weights>,
    /// Whether V is that of another problem (other equations, cost or parameters).
    pub other_problem: bool,
}

/// What is asked of closed loops beside the scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoopOptions {
    /// Only these laws.
    pub laws: Option<Vec<String>>,
    /// So many initial states at random.
    pub random: Option<usize>,
    /// V at the initial states is solved for.
    pub solve: bool,
}

/// Laws that are simulated from initial states, of which some may be done at a time.
pub struct Loops<'a> {
    session: &'a Session<'a>,
    asked: &'a ClosedLoop,
    setting: Setting<'a>,
    chosen: Vec<Law>,
    from: &'a Sources,
    /// All initial states.
    pub initial: Initial,
    solve: bool,
}

impl Loops<'_> {
    /// The names of the laws.
    pub fn laws(&self) -> Vec<String> {
        self.chosen.iter().map(|law| law.name.clone()).collect()
    }

    /// With what they are integrated.
    pub fn numerics(&self) -> Numerics {
        self.setting.numerics
    }

    /// Of how many units the initial states are, which have nothing to do with each other: each of
    /// its own, or the blocks of states that V is solved for in.
    ///
    /// # Errors
    /// Where V cannot be solved for.
    pub fn units(&self) -> Result<usize, SessionError> {
        if !self.solve {
            return Ok(self.initial.count());
        }
        let Scene {
            model, hamiltonian, ..
        } = self.session.scene;
        let (backend, choices) = (self.session.backend.as_ref(), self.session.choices);
        let blocks = count_blocks(model, hamiltonian, backend, choices, &self.initial.x);
        Ok(blocks.map_err(LoopError::States)?)
    }

    /// Simulates from the initial states of some units; `None`: from all.
    ///
    /// # Errors
    /// Device failures; that V was not solved for.
    pub fn simulate(
        &self,
        units: Option<&[usize]>,
        gathered: &mut Gathered,
    ) -> Result<(), SessionError> {
        let session = self.session;
        let backend = session.backend.as_ref();
        let Scene {
            model, hamiltonian, ..
        } = session.scene;
        let step = session.step();
        let (numbers, solved) = if self.solve {
            let (scene, x) = ((model, hamiltonian), &self.initial.x);
            let mut shown = step.states();
            let (numbers, values) = in_pool(|| {
                values_of_blocks(scene, backend, session.choices, x, units, &mut shown)
            })?;
            (numbers, Some(values))
        } else {
            let all = || (0..self.initial.count()).collect();
            (units.map_or_else(all, <[usize]>::to_vec), None)
        };
        // What is of none has no laws to compile.
        if numbers.is_empty() {
            return Ok(());
        }
        let part = self.initial.some(&numbers);
        let values = match solved {
            Some(values) => values,
            None => session.known_values(self.from, &part, self.initial.count())?,
        };
        let chart = self.from.chart();
        let laws = in_pool(|| {
            self.setting
                .simulate_all(&self.chosen, &part, chart, backend, &mut |law| {
                    step.say(&format!("closed loop of {law}"));
                })
        })?;
        gathered.take(&numbers, &values, laws);
        Ok(())
    }

    /// What came of all.
    pub fn evaluated(&self, gathered: Gathered) -> Evaluation {
        let controls = self.session.scene.model.controls.len();
        let (initial, values, laws) = gathered.all(self.asked.samples, controls);
        let backend = self.session.backend.as_ref();
        self.setting.evaluated(initial, values, laws, backend)
    }

    /// What came of those that are there.
    pub fn evaluated_in_part(&self, gathered: &Gathered) -> Evaluation {
        let (initial, values, laws) = gathered.part();
        let backend = self.session.backend.as_ref();
        self.setting.evaluated(initial, values, laws, backend)
    }

    /// Tells what came of them.
    pub fn tell(&self, evaluation: &Evaluation) {
        let progress = self.session.progress;
        for law in evaluation.laws.iter().filter(|l| l.held > 0.0) {
            progress.note(&format!(
                "law `{}`: along {} of {} closed loops ({:.2} % of all updates) the map had no answer somewhere: {}",
                law.name,
                law.fell_back(),
                law.status.len(),
                100.0 * law.held,
                match self.asked.outside {
                    Outside::Stop => "they end there",
                    Outside::Hold => "the law held its last p = q + H s",
                    Outside::Nearest => "the law took p of the nearest state known",
                    Outside::Search => "the law took p of the nearest state known, or held a control at its bound, as a search for the cheapest way back chose",
                    Outside::Local => "the law was that of the Riccati solution",
                }
            ));
        }
        progress.finished(Finished::ClosedLoop(evaluation));
    }
}

impl Sources {
    fn chart(&self) -> Option<&dyn Chart> {
        self.map.as_ref().map(|m| m as &dyn Chart)
    }
}

impl Session<'_> {
    /// Simulates the laws of the scene's `[closed_loop]`.
    ///
    /// # Errors
    /// What is wrong with the scene's laws; device failures.
    pub fn closed_loop(
        &self,
        from: &Sources,
        options: &LoopOptions,
    ) -> Result<Evaluation, SessionError> {
        let loops = self.loops(from, options)?;
        let mut gathered = Gathered::new(loops.initial.clone());
        loops.simulate(None, &mut gathered)?;
        let evaluation = loops.evaluated(gathered);
        loops.tell(&evaluation);
        Ok(evaluation)
    }

    /// The laws of the scene's `[closed_loop]`, and where they are simulated from.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn loops<'a>(
        &'a self,
        from: &'a Sources,
        options: &LoopOptions,
    ) -> Result<Loops<'a>, SessionError> {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let backend = self.backend.as_ref();
        let asked = model
            .closed_loop
            .as_ref()
            .ok_or(SessionError::NoClosedLoop)?;
        let laws = Laws::new(model, hamiltonian, asked.track);
        let setting = Setting::new(&laws, asked, backend, self.choices)?;
        if let Some(error) = laws.unsolved() {
            self.progress.note(&format!(
                "no local solution ({error}): whether a closed loop has converged is measured in widths of the region"
            ));
        }
        let chart = from.chart();
        let chosen = self.choose(from, &laws, asked, options, chart.is_some())?;
        if let (Some(map), Some(_)) = (&from.map, model.final_time())
            && map.time().is_none()
            && chosen.iter().any(|law| law.name == MAP)
        {
            self.progress.note(
                "law `map`: the file knows V at the initial time alone, and the law takes it for V at all times ([map] with error = ..., without \
                 time = false, makes V(x, t))",
            );
        }
        Ok(Loops {
            initial: Initial::new(model, asked, options.random, self.choices.seed)?,
            session: self,
            asked,
            setting,
            chosen,
            from,
            solve: options.solve,
        })
    }

    /// Checks the inequality of the scene's `[dissipation]` along the flights of its laws.
    ///
    /// # Errors
    /// What is wrong with the scene's laws; where V is not known; device failures.
    pub fn dissipation(
        &self,
        from: &Sources,
        options: &LoopOptions,
    ) -> Result<Dissipation, SessionError> {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let backend = self.backend.as_ref();
        let asked = model
            .dissipation
            .as_ref()
            .ok_or(SessionError::NoClosedLoop)?;
        let track = model.closed_loop.as_ref().and_then(|s| s.track);
        let laws = Laws::new(model, hamiltonian, track);
        let same = from.map.is_some() && !from.other_problem;
        let solve = |states: &[f64]| {
            // More exact than what is interpolated, of which the ratio should say nothing.
            let rtol = model.integrator.rtol.min(SOLVED_RTOL);
            let choices = Choices {
                rtol: Some(self.choices.rtol.unwrap_or(rtol)),
                ..self.choices
            };
            let none = &mut |_: &str, _: usize, _: usize| {};
            let values = solved_values(model, hamiltonian, backend, choices, states, none)?;
            // V that was not found in time would be one that is not known.
            choices.deadline.check()?;
            Ok(values)
        };
        let certificate = Certificate::of(&laws, from.chart(), same.then_some(&solve))?;
        if let (Certificate::Chart(..), false) = (&certificate, same) {
            self.progress.note(
                "V in the file is of another problem (other parameters, equations or cost): whether it certifies a gain of this one is what the simulation says",
            );
        }

        let step = self.step();
        let flight = dissipation::flight(model, asked, laws.riccati())?;
        let chosen = self.choose(from, &laws, &flight, options, true)?;
        step.say("dissipation inequality: V at the initial states");
        let checked = dissipation::check(
            &laws,
            (asked, &flight),
            &chosen,
            &certificate,
            backend,
            self.choices,
            &mut |law| step.say(&format!("dissipation inequality of {law}")),
        )?;
        drop(step);
        self.progress.finished(Finished::Dissipation(&checked));
        Ok(checked)
    }

    /// The laws that a section asks for; `map`: whether the law of V is one of those there are.
    fn choose(
        &self,
        from: &Sources,
        laws: &Laws<'_>,
        asked: &ClosedLoop,
        options: &LoopOptions,
        map: bool,
    ) -> Result<Vec<Law>, SessionError> {
        let twice = from.added.iter().find(|w| {
            [LQR, MAP].contains(&w.name.as_str())
                || from.fitted.iter().any(|f| f.name == w.name)
                || asked.given.iter().any(|g| g.name == w.name)
        });
        if let Some(twice) = twice {
            let name = twice.name.clone();
            return Err(SessionError::SameLaw { name });
        }
        let available = Available {
            map,
            fitted: from.fitted.clone(),
            added: from.added.clone(),
        };
        let chosen = available.choose(laws, asked, options.laws.as_deref())?;
        for name in &chosen.missing {
            self.progress.note(&format!(
                "law `{name}` is left out: there is none in the result file (yet)"
            ));
        }
        if chosen.laws.is_empty() {
            return Err(SessionError::NoLaws);
        }
        Ok(chosen.laws)
    }

    /// V of the solved states and, elsewhere, of the map, as far as that is good; NaN where it is
    /// not known.
    /// These are some of so many.
    fn known_values(
        &self,
        from: &Sources,
        initial: &Initial,
        of: usize,
    ) -> Result<Vec<f64>, SessionError> {
        /// Largest estimated error of V, of V.
        const GOOD: f64 = 0.01;
        /// States at which it is estimated, which takes a hundred times longer than V.
        const ESTIMATED: usize = 5000;
        /// States that are asked for at once: between them the deadline is looked at.
        const ASKED: usize = 1000;
        let unknown = vec![f64::NAN; initial.count()];
        if from.other_problem {
            self.progress.note(
                "V in the file is of another problem (other parameters, equations or cost): J is not compared with it (--solve finds V)",
            );
            return Ok(unknown);
        }
        let mut values = match &from.solved {
            Some(points) => {
                let region = &self.scene.model.region;
                let widths: Vec<f64> = region.iter().map(|[lo, hi]| hi - lo).collect();
                initial.looked_up(&points.x, &points.v, &widths)
            }
            None => unknown,
        };
        let Some(map) = &from.map else {
            return Ok(values);
        };

        let estimated = of <= ESTIMATED;
        let good = |at: At| match at.lowest {
            Err(_) => f64::NAN,
            Ok(here) if here.v_error > GOOD * here.v.abs() => f64::INFINITY,
            Ok(here) => here.v,
        };
        let mut said = Vec::with_capacity(initial.count());
        for states in initial.x.chunks(ASKED * self.scene.model.states.len()) {
            self.choices.deadline.check()?;
            match estimated {
                true => said.extend(map.at_many(states, true).into_iter().map(good)),
                false => said.extend(map.many(states).v),
            }
        }
        let charted: Vec<Option<f64>> = (said.iter().zip(&values))
            .map(|(said, known)| match known.is_nan() {
                false => Some(*known),
                // None: known, but not well enough.
                true => Some(*said).filter(|v| v.is_nan() || v.is_finite()),
            })
            .collect();
        let doubtful = charted.iter().filter(|v| v.is_none()).count();
        if doubtful > 0 {
            self.progress.note(&format!(
                "at {doubtful} initial states V's estimated error is above 1 %: J is not compared with it there (--solve finds V)"
            ));
        }
        for (value, charted) in values.iter_mut().zip(charted) {
            *value = charted.unwrap_or(f64::NAN);
        }
        Ok(values)
    }
}

/// Whether two scenes have the same equations, cost and parameters, so that V of one is V of the
/// other.
#[must_use]
pub fn same_problem(a: &Model, b: &Model) -> bool {
    let shown = |m: &Model| {
        let cost = std::iter::once(m.running.expr);
        let exprs: Vec<Id> = m.dynamics.iter().map(|f| f.expr).chain(cost).collect();
        let parameters = m.parameters.iter();
        let controls = m.controls.iter();
        let numbers: Vec<String> = (parameters.map(|p| format!("{} = {:?}", p.name, p.value)))
            .chain(controls.map(|c| format!("{:?} {:?}", c.min, c.max)))
            .collect();
        (m.graph.show_all(&exprs, ""), numbers)
    };
    shown(a) == shown(b) && a.reference() == b.reference()
}
