//! Tables of numbers: the run's key figures, laws.
