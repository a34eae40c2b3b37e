
/* A polynomial and its gradient: each monomial is an earlier one times a variable, and slopes go back the same way; the value
   comes with them, its small terms summed first. */
static inline REAL NAME_sum(const REAL *c, int count, const REAL *y, REAL *slope)
{
    REAL monomial[NAME_terms], adjoint[NAME_terms];
    int k;
    monomial[0] = 1;
    adjoint[0] = c[0];
    for (k = 1; k < count; k++) {
        monomial[k] = monomial[NAME_parent[k]] * y[NAME_times[k]];
        adjoint[k] = c[k];
    }
    for (k = 0; k < NAME_states; k++) slope[k] = 0;
    for (k = count - 1; k > 0; k--) {
        slope[NAME_times[k]] += adjoint[k] * monomial[NAME_parent[k]];
        adjoint[NAME_parent[k]] += adjoint[k] * y[NAME_times[k]];
    }
    return adjoint[0];
}
