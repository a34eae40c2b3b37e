//! Polynomials of several variables up to a total degree, as lists of coefficients.

/// Most variables and the highest degree.
pub const MOST_VARIABLES: usize = 6;
pub const MOST_DEGREE: usize = 8;

/// The monomials of `variables` variables up to a total degree, in an order in which each is an
/// earlier one times a variable. Those up to a lower degree are a beginning of the list.
#[derive(Clone, Debug)]
pub struct Terms {
    pub variables: usize,
    /// Earlier monomial and variable that each but the first is the product of.
    pub factors: Vec<(u16, u8)>,
    /// `[term][variable]`.
    pub powers: Vec<u8>,
    /// Number of monomials up to each degree.
    pub upto: Vec<usize>,
}

impl Terms {
    pub fn new(variables: usize, degree: usize) -> Self {
        let mut this = Self {
            variables,
            factors: vec![(0, 0)],
            powers: vec![0; variables],
            upto: vec![1],
        };
        let mut before = 0;
        for _ in 0..degree {
            let end = this.factors.len();
            for term in before..end {
                let powers: Vec<u8> = this.powers_of(term).to_vec();
                // Variables in order, so that each product is met once.
                let last = powers.iter().rposition(|k| *k > 0).unwrap_or(0);
                for i in last..variables {
                    this.factors.push((term as u16, i as u8));
                    let mut product = powers.clone();
                    product[i] += 1;
                    this.powers.extend(product);
                }
            }
            before = end;
            this.upto.push(this.factors.len());
        }
        this
    }

    /// Up to the least degree with so many monomials.
    pub fn through(variables: usize, count: usize) -> Self {
        let mut degree = 0;
        let mut this = Self::new(variables, degree);
        while this.factors.len() < count {
            degree += 1;
            this = Self::new(variables, degree);
        }
        this
    }

    pub fn powers_of(&self, term: usize) -> &[u8] {
        &self.powers[term * self.variables..][..self.variables]
    }

    pub fn degree_of(&self, term: usize) -> usize {
        self.powers_of(term).iter().map(|k| usize::from(*k)).sum()
    }

    /// The first `values.len()` monomials at `y`, and their derivatives `[variable][term]`.
    pub fn at(&self, y: &[f64], values: &mut [f64], slopes: &mut [f64]) {
        let (n, count) = (self.variables, values.len());
        values[0] = 1.0;
        for i in 0..n {
            slopes[i * count] = 0.0;
        }
        for term in 1..count {
            let (parent, axis) = self.factors[term];
            let (parent, axis) = (usize::from(parent), usize::from(axis));
            values[term] = values[parent] * y[axis];
            for i in 0..n {
                slopes[i * count + term] = slopes[i * count + parent] * y[axis];
            }
            slopes[axis * count + term] += values[parent];
        }
    }

    /// A polynomial and its gradient.
    pub fn sum(&self, coefficients: &[f64], y: &[f64], gradient: &mut [f64]) -> f64 {
        const MOST: usize = 512;
        let (n, count) = (self.variables, coefficients.len());
        assert!(count <= MOST && n <= MOST_VARIABLES);
        let mut values = [0.0; MOST];
        values[..count].fill(0.0);
        values[0] = 1.0;
        for term in 1..count {
            let (parent, axis) = self.factors[term];
            values[term] = values[usize::from(parent)] * y[usize::from(axis)];
        }
        let sum = coefficients.iter().zip(&values).map(|(c, v)| c * v).sum();
        // In reverse: the adjoint of each monomial goes to its factors.
        let mut adjoint = [0.0; MOST];
        adjoint[..count].copy_from_slice(coefficients);
        gradient[..n].fill(0.0);
        for term in (1..count).rev() {
            let (parent, axis) = self.factors[term];
            let (parent, axis) = (usize::from(parent), usize::from(axis));
            gradient[axis] += adjoint[term] * values[parent];
            adjoint[parent] += adjoint[term] * y[axis];
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn monomials_and_their_slopes() {
        let terms = Terms::new(3, 4);
        assert_eq!(terms.upto, [1, 4, 10, 20, 35]);
        let y = [0.3, -0.7, 1.1];
        let (mut values, mut slopes) = (vec![0.0; 35], vec![0.0; 105]);
        terms.at(&y, &mut values, &mut slopes);
        for term in 0..35 {
            let powers = terms.powers_of(term);
            let power = |i: usize, k: i32| if k < 0 { 0.0 } else { f64::powi(y[i], k) };
            let product = |less: usize| -> f64 {
                (0..3)
                    .map(|i| {
                        let k = i32::from(powers[i]);
                        if i == less {
                            f64::from(k) * power(i, k - 1)
                        } else {
                            power(i, k)
                        }
                    })
                    .product()
            };
            assert!((values[term] - product(9)).abs() < 1e-15);
            for i in 0..3 {
                assert!((slopes[i * 35 + term] - product(i)).abs() < 1e-14);
            }
        }
        let coefficients: Vec<f64> = (0..35).map(|k| (f64::from(k) * 0.37).sin()).collect();
        let mut gradient = [0.0; 3];
        let sum = terms.sum(&coefficients, &y, &mut gradient);
        let dot = |row: &[f64]| {
            row.iter()
                .zip(&coefficients)
                .map(|(a, b)| a * b)
                .sum::<f64>()
        };
        assert!((sum - dot(&values)).abs() < 1e-13);
        for i in 0..3 {
            assert!((gradient[i] - dot(&slopes[i * 35..][..35])).abs() < 1e-13);
        }
    }
}
