
/* The series about the equilibrium, as a polynomial of z = matrix s; 0 out of its reach. */
static inline int NAME_near(const REAL *s, REAL *V, REAL *p)
{
    REAL z[NAME_states], q[NAME_states], square = 0;
    int i, j;
    for (i = 0; i < NAME_states; i++) {
        z[i] = 0;
        for (j = 0; j < NAME_states; j++) z[i] += NAME_local_matrix[i][j] * s[j];
        square += z[i] * z[i];
    }
    *V = NAME_sum(NAME_local, NAME_local_terms, z, q);
    for (j = 0; j < NAME_states; j++) {
        p[j] = 0;
        for (i = 0; i < NAME_states; i++) p[j] += NAME_local_matrix[i][j] * q[i];
    }
    return (REAL)0.5 * square <= NAME_local_reach;
}
