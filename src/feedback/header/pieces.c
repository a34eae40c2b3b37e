
/* V by a piece, and its gradient by the coordinates t; 0 away from the points that it was fitted to. */
static inline int NAME_piece(int k, const REAL *t, REAL *V, REAL *q)
{
    REAL y[NAME_states], w, slope;
    int i;
    for (i = 0; i < NAME_states; i++) y[i] = (t[i] - NAME_center[k][i]) / NAME_half[k][i];
    if (!NAME_supported(k, y)) return 0;
    w = NAME_sum(NAME_coefficients + NAME_first[k], (int)(NAME_first[k + 1] - NAME_first[k]), y, q);
    /* A polynomial that crosses 0 comes to a branch of the function on which no V lies. */
    switch (NAME_shape[k]) {
    case 1: /* of sqrt(V) */
        if (!(w >= 0)) return 0;
        *V = w * w;
        slope = 2 * w;
        break;
    case 2: /* of log(V) */
        *V = slope = FUN(exp)(w);
        break;
    case 3: /* of 1/V */
        if (!(w > 0)) return 0;
        *V = 1 / w;
        slope = -1 / (w * w);
        break;
    default:
        *V = w;
        slope = 1;
    }
    for (i = 0; i < NAME_states; i++) q[i] *= slope / NAME_half[k][i];
    return isfinite(*V) != 0;
}

/* Bound of the error of a piece's V. */
static inline REAL NAME_error(int k, REAL V)
{
    V = FUN(fabs)(V);
    return NAME_bound[k] * (V > NAME_floor ? V : NAME_floor);
}

/* How much a cell counts at t, and the gradient of that: it falls to 0 over a strip along its faces. */
static inline int NAME_weight(int cell, const REAL *t, REAL *w, REAL *dw)
{
    REAL factor[NAME_states], slope[NAME_states];
    int i, k;
    for (i = 0; i < NAME_states; i++) {
        const REAL half = (REAL)0.5 * (NAME_cell_upper[cell][i] - NAME_cell_lower[cell][i]);
        const REAL offset = (t[i] - (REAL)0.5 * (NAME_cell_lower[cell][i] + NAME_cell_upper[cell][i])) / half;
        const REAL r = (FUN(fabs)(offset) - (1 - NAME_overlap)) / (2 * NAME_overlap);
        factor[i] = 1;
        slope[i] = 0;
        if (r >= 1) return 0;
        if (r > 0) {
            factor[i] = 1 - r * r * r * (10 - 15 * r + 6 * r * r);
            slope[i] = (offset < 0 ? 30 : -30) * r * r * (1 - r) * (1 - r) / (2 * NAME_overlap * half);
        }
    }
    *w = 1;
    for (i = 0; i < NAME_states; i++) {
        *w *= factor[i];
        dw[i] = slope[i];
        for (k = 0; k < NAME_states; k++)
            if (k != i) dw[i] *= factor[k];
    }
    return 1;
}

/* Blends V and q of a piece of the cell `own` with what the cells around say of the same sheet. `alone`: no other sheet lies
   over the cell here. */
static inline void NAME_blend(const REAL *t, int own, int piece, int alone, REAL *V, REAL *q)
{
    const REAL error = NAME_error(piece, *V);
    REAL total = 0, sum = 0, w, off, other, dw[NAME_states], g[NAME_states], h[NAME_states];
    REAL slope[NAME_states], change[NAME_states];
    int stack[NAME_depth], used = 0, i, k;
    for (i = 0; i < NAME_states; i++) slope[i] = change[i] = 0;
    stack[used++] = 0;
    while (used > 0) {
        const int node = stack[--used], axis = NAME_axis[node];
        const int cell = (int)NAME_below[node];
        if (axis < NAME_states) {
            if (t[axis] > NAME_reach[node][0]) stack[used++] = (int)NAME_above[node];
            if (t[axis] < NAME_reach[node][1]) stack[used++] = (int)NAME_below[node];
            continue;
        }
        if (!NAME_weight(cell, t, &w, dw)) continue;
        off = 0;
        for (i = 0; i < NAME_states; i++) g[i] = 0;
        if (cell != own) {
            const int first = (int)NAME_pieces[cell], end = (int)NAME_pieces[cell + 1];
            int best = -1;
            for (k = first; k < end; k++) {
                if (!NAME_piece(k, t, &other, h)) continue;
                if (best >= 0 && !(FUN(fabs)(other - *V) < FUN(fabs)(off))) continue;
                best = k;
                off = other - *V;
                for (i = 0; i < NAME_states; i++) g[i] = h[i] - q[i];
            }
            if (best < 0) continue;
            if (!(alone && end - first == 1) && !(FUN(fabs)(off) <= NAME_same * (NAME_error(best, off + *V) + error))) continue;
        }
        total += w;
        sum += w * off;
        for (i = 0; i < NAME_states; i++) {
            slope[i] += dw[i];
            change[i] += w * g[i] + dw[i] * off;
        }
    }
    if (!(total > 0)) {
        total = 1;
        sum = 0;
    }
    sum /= total;
    *V += sum;
    for (i = 0; i < NAME_states; i++) q[i] += (change[i] - sum * slope[i]) / total;
}

/* V and p from the pieces at x, moved by whole periods; s is that x less the reference. 0 where nothing is known. */
static inline int NAME_chart(const REAL *x, REAL *V, REAL *p, REAL *s)
{
    REAL at[NAME_states], t[NAME_states], q[NAME_states], slope[NAME_states], value[NAME_sheets] = {0};
    int which[NAME_sheets], count = 0, node = 0, cell, i, j, k;
    for (i = 0; i < NAME_states; i++) {
        at[i] = NAME_turned(i, x[i]);
        if (!(at[i] >= NAME_lower[i] && at[i] <= NAME_upper[i])) return 0;
        s[i] = at[i] - NAME_reference[i];
    }
    for (i = 0; i < NAME_states; i++) {
        t[i] = slope[i] = 0;
        for (j = 0; j < NAME_states; j++) t[i] += NAME_frame[i][j] * (at[j] - NAME_origin[j]);
    }
    NAME_shear(t, slope);
    while (NAME_axis[node] < NAME_states)
        node = (int)(t[NAME_axis[node]] < NAME_split[node] ? NAME_below[node] : NAME_above[node]);
    cell = (int)NAME_below[node];
    /* The cell's pieces that say something, by rising V. */
    for (k = (int)NAME_pieces[cell]; k < (int)NAME_pieces[cell + 1]; k++) {
        REAL v;
        if (!NAME_piece(k, t, &v, q) || !(v <= NAME_value_max)) continue;
        for (j = count++; j > 0 && value[j - 1] > v; j--) {
            value[j] = value[j - 1];
            which[j] = which[j - 1];
        }
        value[j] = v;
        which[j] = k;
    }
    for (k = 0; k < count; k++) {
        NAME_piece(which[k], t, V, q);
        NAME_blend(t, cell, which[k], count == 1 && NAME_pieces[cell + 1] - NAME_pieces[cell] == 1, V, q);
        NAME_straighten(slope, q);
        for (j = 0; j < NAME_states; j++) {
            p[j] = 0;
            for (i = 0; i < NAME_states; i++) p[j] += NAME_frame[i][j] * q[i];
        }
        if (NAME_solves(s, p)) return 1;
    }
    return 0;
}
