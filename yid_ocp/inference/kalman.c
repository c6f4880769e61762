/* Steps of the Kalman filter of kalman.py, in its arithmetic but for the order of sums. Matrices are row-major. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef __AVX512F__
#define WIDE 8
#else
#define WIDE 4
#endif
#define ROWS 6
#define COLUMNS (2 * WIDE)
typedef double Wide __attribute__((vector_size(8 * WIDE), aligned(8), may_alias));

/* Entry (i, j) stands at i * row + j * column. */
typedef struct {
    const double *at;
    size_t row, column;
} Matrix;

/* C += sign A B of (m, k) and (k, n), with `lower` at least its lower triangle. The panel has k * COLUMNS numbers. */
static void add_product(double sign, Matrix a, Matrix b, int m, int k, int n, int lower, double *c, size_t width,
                        double *panel) {
    for (int first = 0; first < n; first += COLUMNS) {
        const int wide = n - first < COLUMNS ? n - first : COLUMNS;
        for (int l = 0; l < k; l++)
            for (int j = 0; j < COLUMNS; j++)
                panel[l * COLUMNS + j] = j < wide ? sign * b.at[l * b.row + (first + j) * b.column] : 0.0;
        for (int i = lower ? first : 0; i < m; i += ROWS) {
            const int high = m - i < ROWS ? m - i : ROWS;
            const double *row[ROWS];
            for (int r = 0; r < ROWS; r++) row[r] = a.at + (i + (r < high ? r : 0)) * a.row;
            Wide sum[ROWS][2] = {{{0}}};
            for (int l = 0; l < k; l++) {
                const Wide *source = (const Wide *)(panel + l * COLUMNS), s0 = source[0], s1 = source[1];
                const size_t at = l * a.column;
#pragma GCC unroll 8
                for (int r = 0; r < ROWS; r++) {
                    sum[r][0] += row[r][at] * s0;
                    sum[r][1] += row[r][at] * s1;
                }
            }
            for (int r = 0; r < high; r++) {
                double *target = c + (i + r) * width + first;
                for (int j = 0; j < wide; j++) target[j] += ((const double *)sum[r])[j];
            }
        }
    }
}

static void add_row(double factor, const double *restrict source, int count, double *restrict target) {
    if (factor == 0) return;
    for (int c = 0; c < count; c++) target[c] += factor * source[c];
}

/* Sizes are steps, NS states, width of a move, NA states and parameters, and NK. Of each step the move (NS, width), which is
 * the state rows of the transition and, behind their NK columns, noise of the states; decay and new variance of the
 * parameters (NA - NS); and of its rows, from row_start on, the observation (rows, NA). Written are the inverse roots of the
 * innovations' covariances and the projected covariances (rows, NA); the covariance (NA, NA) is given and renewed. */
typedef struct {
    const int *size, *row_start;
    const double *move, *decay, *variance, *observation;
    double *whitening, *projected, *covariance;
} Filter;

/* The measurement by H (r, NA), P renewed row by row; by the covariance's diagonal alone where rounding shows. */
static void measure(const double *H, int r, int na, double *whitening, double *projected, double *P, double *panel) {
    for (int alone = 0, good = 0; !good && alone < 2; alone++) {
        good = 1;
        memset(whitening, 0, sizeof(double) * r * r);
        memset(projected, 0, sizeof(double) * r * na);
        for (int i = 0; i < r; i++) {
            const double *own = H + (size_t)i * na;
            double *cross = projected + (size_t)i * na, *root = whitening + i * r, square = 0;
            for (int c = 0; c < na; c++) add_row(own[c], P + (size_t)c * na, na, cross);
            for (int c = 0; c < na; c++) square += own[c] * cross[c];
            square = 1.0 + (alone ? fmax(square, 0.0) : square);
            root[i] = 1.0;
            for (int j = 0; j < i && !alone; j++) {
                const double *before = projected + (size_t)j * na;
                double along = 0;
                for (int c = 0; c < na; c++) along += own[c] * before[c];
                add_row(-along, before, na, cross);
                add_row(-along, whitening + j * r, r, root);
                square -= along * along;
            }
            good &= square > 0;
            const double scale = 1 / sqrt(square);
            for (int c = 0; c < na; c++) cross[c] *= scale;
            for (int c = 0; c <= i; c++) root[c] *= scale;
        }
    }
    add_product(-1.0, (Matrix){projected, 1, na}, (Matrix){projected, na, 1}, na, r, na, 0, P, na, panel);
}

/* The transition of step s, P renewed; room for NS NA + NA NA numbers. */
static void predict(const Filter *f, int s, double *P, double *room, double *panel) {
    const int ns = f->size[1], width = f->size[2], na = f->size[3], nk = f->size[4], np = na - ns, m = nk - ns;
    const double *M = f->move + (size_t)s * ns * width, *decay = f->decay + s * np, *variance = f->variance + s * np;
    double *X = room, *all = X + (size_t)ns * na;
    int used[na + 1], count = 0; /* states, and parameters that anything else is correlated with */
    for (int i = 0; i < na; i++) {
        int known = i < ns;
        for (int j = 0; j < na; j++) known |= i != j && P[(size_t)i * na + j] != 0;
        if (known) used[count++] = i;
    }
    /* X = M P, then P = X M'; parameters of the same slopes are added up */
    memset(all, 0, sizeof(double) * nk * count);
    for (int i = 0; i < na; i++) {
        double *own = all + (size_t)(i < ns ? i : ns + (i - ns) % m) * count;
        for (int j = 0; j < count; j++) own[j] += P[(size_t)i * na + used[j]];
    }
    memset(X, 0, sizeof(double) * ns * na);
    add_product(1.0, (Matrix){M, width, 1}, (Matrix){all, count, 1}, ns, nk, count, 0, X, na, panel);
    for (int i = 0; i < ns; i++) {
        double *row = X + (size_t)i * na;
        for (int p = na - 1, j = count - 1; p >= ns; p--)
            row[p] = used[j] == p ? row[j--] : M[(size_t)i * width + ns + (p - ns) % m] * P[(size_t)p * na + p];
        memset(P + (size_t)i * na, 0, sizeof(double) * ns);
        for (int p = ns; p < na; p++) P[(size_t)i * na + p] = P[(size_t)p * na + i] = row[p] * decay[p - ns];
        for (int p = nk; p < na; p++) row[ns + (p - ns) % m] += row[p];
    }
    for (int p = 0; p < np; p++) {
        double *row = P + (size_t)(ns + p) * na + ns;
        for (int q = 0; q < np; q++) row[q] *= decay[p] * decay[q];
        row[p] += variance[p];
    }
    add_product(1.0, (Matrix){X, na, 1}, (Matrix){M, 1, width}, ns, nk, ns, 1, P, na, panel);
    add_product(1.0, (Matrix){M + nk, width, 1}, (Matrix){M + nk, 1, width}, ns, width - nk, ns, 1, P, na, panel);
    for (int i = 0; i < ns; i++)
        for (int j = 0; j < i; j++) P[(size_t)j * na + i] = P[(size_t)i * na + j];
}

static int widest(const Filter *f) {
    int most = f->size[2] > f->size[3] ? f->size[2] : f->size[3];
    for (int s = 0; s < f->size[0]; s++)
        if (f->row_start[s + 1] - f->row_start[s] > most) most = f->row_start[s + 1] - f->row_start[s];
    return most;
}

/* Whether the steps were taken; not where there is too little memory. */
int yid_kalman_steps(const Filter *f) {
    const int na = f->size[3], most = widest(f);
    double *room = malloc(sizeof(double) * most * (3 * (size_t)most + COLUMNS)), *whitening = f->whitening;
    if (!room) return 0;
    double *panel = room + 3 * (size_t)most * most;
    for (int s = 0; s < f->size[0]; s++) {
        const int first = f->row_start[s], r = f->row_start[s + 1] - first;
        const size_t row = (size_t)first * na;
        measure(f->observation + row, r, na, whitening, f->projected + row, f->covariance, panel);
        predict(f, s, f->covariance, room, panel);
        whitening += r * r;
    }
    free(room);
    return 1;
}

/* Columns of measurements along the steps. Forward, `rows` (rows, columns) are measured and become the normalized
 * innovations, `state` (NA, columns) is the mean, to which `push` (steps, NK - NS, columns), if any, is added beside the
 * parameters of a step and `shift` (steps, NA - NS) to the first column's parameters after it. Backward, `rows` are
 * innovations and become the smoothed noise, `state` is the costate. `seen` (steps, NA, columns), if any, takes both. */
typedef struct {
    const int *columns;
    double *rows, *state, *seen;
    const double *push, *shift;
} Columns;

/* Whether it was done; not where there is too little memory. */
int yid_kalman_columns(const Filter *f, const Columns *c, int backward) {
    const int count = f->size[0], ns = f->size[1], width = f->size[2], na = f->size[3], nk = f->size[4];
    const int n = *c->columns, m = nk - ns, most = widest(f);
    double *sums = malloc(sizeof(double) * most * (3 * (size_t)n + COLUMNS)), *x = c->state;
    if (!sums) return 0;
    double *white = sums + (size_t)most * n, *moved = white + (size_t)most * n, *panel = moved + (size_t)most * n;
    const double *end = f->whitening;
    for (int s = 0; backward && s < count; s++) end += (f->row_start[s + 1] - f->row_start[s]) * (f->row_start[s + 1] - f->row_start[s]);
    for (int k = 0; k < count; k++) {
        const int s = backward ? count - 1 - k : k, first = f->row_start[s], r = f->row_start[s + 1] - first;
        const double *M = f->move + (size_t)s * ns * width, *decay = f->decay + (size_t)s * (na - ns);
        const double *H = f->observation + (size_t)first * na, *P = f->projected + (size_t)first * na;
        const double *W = backward ? (end -= r * r) : end;
        double *rows = c->rows + (size_t)first * n;
        if (!backward) end += r * r;
        if (c->seen) memcpy(c->seen + (size_t)s * na * n, x, sizeof(double) * na * n);
        memset(white, 0, sizeof(double) * r * n);
        if (!backward) {
            add_product(-1.0, (Matrix){H, na, 1}, (Matrix){x, n, 1}, r, na, n, 0, rows, n, panel);
            add_product(1.0, (Matrix){W, r, 1}, (Matrix){rows, n, 1}, r, r, n, 0, white, n, panel);
            add_product(1.0, (Matrix){P, 1, na}, (Matrix){white, n, 1}, na, r, n, 0, x, n, panel);
            memcpy(sums, x, sizeof(double) * ns * n);
            if (c->push) memcpy(sums + (size_t)ns * n, c->push + (size_t)s * m * n, sizeof(double) * m * n);
            else memset(sums + (size_t)ns * n, 0, sizeof(double) * m * n);
            for (int p = ns; p < na; p++) add_row(1.0, x + (size_t)p * n, n, sums + (size_t)(ns + (p - ns) % m) * n);
            memset(x, 0, sizeof(double) * ns * n);
            add_product(1.0, (Matrix){M, width, 1}, (Matrix){sums, n, 1}, ns, nk, n, 0, x, n, panel);
        } else {
            memset(moved, 0, sizeof(double) * nk * n);
            add_product(1.0, (Matrix){M, 1, width}, (Matrix){x, n, 1}, nk, ns, n, 0, moved, n, panel);
            memcpy(x, moved, sizeof(double) * ns * n);
        }
        for (int p = ns; p < na; p++) {
            double *own = x + (size_t)p * n;
            for (int j = 0; j < n; j++) own[j] = decay[p - ns] * own[j] + (backward ? moved[(size_t)(ns + (p - ns) % m) * n + j] : 0);
            if (!backward) own[0] += c->shift[(size_t)s * (na - ns) + p - ns];
        }
        if (backward) {
            add_product(-1.0, (Matrix){P, na, 1}, (Matrix){x, n, 1}, r, na, n, 0, rows, n, panel);
            add_product(1.0, (Matrix){W, 1, r}, (Matrix){rows, n, 1}, r, r, n, 0, white, n, panel);
            add_product(1.0, (Matrix){H, 1, na}, (Matrix){white, n, 1}, na, r, n, 0, x, n, panel);
        }
        memcpy(rows, white, sizeof(double) * r * n);
    }
    free(sums);
    return 1;
}
