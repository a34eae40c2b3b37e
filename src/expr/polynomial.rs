//! Reading an expression as a polynomial in chosen symbols, with expressions as coefficients.

use super::{Graph, Id, Node, Op};
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// A polynomial: exponents of the chosen variables -> coefficient free of them. Zero coefficients
/// are dropped.
pub type Polynomial = BTreeMap<Vec<u8>, Id>;

/// Why an expression is not a polynomial in the chosen variables.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NotPolynomial {
    /// A chosen variable stands inside this function, divisor or exponent.
    Inside(String),
    /// The degree is above what can be represented.
    Degree,
}

impl Graph {
    /// `expr` as a polynomial in `variables`, up to `max_degree`.
    ///
    /// # Errors
    /// [`NotPolynomial`] where a variable appears inside a function or divisor, or an intermediate
    /// degree passes `max_degree`.
    pub fn polynomial(
        &mut self,
        expr: Id,
        variables: &[Id],
        max_degree: u8,
    ) -> Result<Polynomial, NotPolynomial> {
        let mut memo: FxHashMap<Id, Polynomial> = FxHashMap::default();
        for id in self.reachable(&[expr]) {
            let value = self.polynomial_node(id, variables, max_degree, &memo)?;
            memo.insert(id, value);
        }
        Ok(memo.remove(&expr).unwrap_or_default())
    }

    fn polynomial_node(
        &mut self,
        id: Id,
        variables: &[Id],
        max_degree: u8,
        memo: &FxHashMap<Id, Polynomial>,
    ) -> Result<Polynomial, NotPolynomial> {
        if let Some(k) = variables.iter().position(|v| *v == id) {
            let mut exponents = vec![0; variables.len()];
            exponents[k] = 1;
            let one = self.constant(1.0);
            return Ok(Polynomial::from([(exponents, one)]));
        }
        let free = |args: &[Id]| {
            args.iter()
                .all(|a| memo[a].keys().all(|e| e.iter().all(|n| *n == 0)))
        };
        let args: Vec<Id> = self.arguments(id).collect();
        if free(&args) {
            let zero_exponent = vec![0; variables.len()];
            return Ok(if self.is_zero(id) {
                Polynomial::new()
            } else {
                Polynomial::from([(zero_exponent, id)])
            });
        }
        let inside = |g: &Graph| Err(NotPolynomial::Inside(g.show(id)));
        match self.node(id) {
            Node::Neg(a) => Ok(self.scale_polynomial(&memo[&a], -1.0)),
            Node::Powi(a, n) if n > 0 => {
                let mut result = memo[&a].clone();
                for _ in 1..n {
                    result = self.multiply_polynomials(&result, &memo[&a], max_degree)?;
                }
                Ok(result)
            }
            Node::Binary(Op::Add, a, b) => Ok(self.add_polynomials(&memo[&a], &memo[&b])),
            Node::Binary(Op::Sub, a, b) => {
                let minus = self.scale_polynomial(&memo[&b], -1.0);
                Ok(self.add_polynomials(&memo[&a], &minus))
            }
            Node::Binary(Op::Mul, a, b) => {
                self.multiply_polynomials(&memo[&a], &memo[&b], max_degree)
            }
            Node::Binary(Op::Div, a, b) if free(&[b]) => {
                let terms: Vec<_> = memo[&a].iter().map(|(e, c)| (e.clone(), *c)).collect();
                Ok(terms
                    .into_iter()
                    .map(|(e, c)| (e, self.div(c, b)))
                    .collect())
            }
            _ => inside(self),
        }
    }

    fn scale_polynomial(&mut self, p: &Polynomial, factor: f64) -> Polynomial {
        let factor = self.constant(factor);
        p.iter()
            .map(|(e, c)| (e.clone(), self.mul(factor, *c)))
            .collect()
    }

    fn accumulate(&mut self, p: &mut Polynomial, exponents: Vec<u8>, c: Id) {
        let sum = match p.get(&exponents) {
            Some(&old) => self.add(old, c),
            None => c,
        };
        if self.is_zero(sum) {
            p.remove(&exponents);
        } else {
            p.insert(exponents, sum);
        }
    }

    fn add_polynomials(&mut self, a: &Polynomial, b: &Polynomial) -> Polynomial {
        let mut sum = a.clone();
        for (e, c) in b {
            self.accumulate(&mut sum, e.clone(), *c);
        }
        sum
    }

    fn multiply_polynomials(
        &mut self,
        a: &Polynomial,
        b: &Polynomial,
        max_degree: u8,
    ) -> Result<Polynomial, NotPolynomial> {
        let mut product = Polynomial::new();
        for (ea, ca) in a {
            for (eb, cb) in b {
                let e: Vec<u8> = ea.iter().zip(eb).map(|(x, y)| x + y).collect();
                if e.iter().map(|n| u32::from(*n)).sum::<u32>() > u32::from(max_degree) {
                    return Err(NotPolynomial::Degree);
                }
                let c = self.mul(*ca, *cb);
                self.accumulate(&mut product, e, c);
            }
        }
        Ok(product)
    }
}
