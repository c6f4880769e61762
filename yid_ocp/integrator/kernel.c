/* Time stepping of one system: Newton with a kept factorisation, rollout with forward sensitivities, adjoint.
 *
 * The generated part before this text defines the sizes N, NZ, M, NU, NC, NF, NY and NT, counts of nonzeros (NNZ_...),
 * sizes of CasADi's work arrays (SZ_W, SZ_IW), what the system needs (ROW_SCALED, MIDDLE, CLOSED, CLOSED_LEFT,
 * CLOSED_RIGHT), the index tables and the CasADi functions residual, linear, matrix, ending, pull and scales.
 *   N coordinates, NZ internal ones, M constraints, NU inputs, NC prescribed and NF free coordinates,
 *   NT = N + NZ + M rows, NY = NF + NZ + M unknowns of a step, NX = 2 N + NZ state (q, p, z).
 * All matrices are row-major. compiled.py declares the structs of the entry points at the end once more.
 *
 * Everything is compiled for one member, and once more for a batch of `SIMD_WIDTH` members that march together, see simd.c.
 * What only one member can do (damped steps, adjoint) is left out of a batch.
 */
#define NX (2 * N + NZ)
#define NQZ (N + NZ)
#define ONE(x) ((x) > 0 ? (x) : 1)

/* A test puts its own in their place. */
#ifndef YID_ALLOCATE
#define YID_ALLOCATE calloc
#define YID_FREE free
#endif

/* The values of NewtonStatusCode in step_model.py. */
enum { OK = 0, NOT_CONVERGED = 1, SINGULAR = 2, NOT_FINITE = 3, OUT_OF_MEMORY = 4 };

typedef int (*casadi_function)(const real **, real **, long long *, real *, int);
typedef int (*theta_function)(const double **, double **, long long *, double *, int);

typedef struct {
    real A[ONE(NY)][ONE(NY)], LT[ONE(NY)][ONE(NY)], inverse[ONE(NY)];
} Factors;

typedef struct {
    real balance[ONE(N)], internal[ONE(NZ)], constraint[ONE(M)], p1[ONE(N)];
    real pairs[(30 + 12 * CLOSED) * ONE(N)];
    real rest[ONE(NNZ_REST)], rest_p[ONE(NNZ_REST_P)], by_unknown[ONE(NNZ_CONSTRAINT)];
    real matrix_nz[ONE(NNZ_MATRIX)], middle_nz[ONE(NNZ_MATRIX)], right_nz[ONE(NNZ_MATRIX)], pull_nz[ONE(NNZ_PULL)];
    real curve_nz[ONE(NNZ_CURVE)], after_curve_nz[ONE(NNZ_AFTER_CURVE)];
    real Phi[ONE(M)][ONE(N)]; /* rows of the multipliers' pull in the balance */
    real R1[ONE(NT)][ONE(NT)], R0[ONE(NT)][ONE(NQZ)], Ru[ONE(NT)][ONE(NU)];
    real P1[ONE(N)][ONE(NT)], P0[ONE(N)][ONE(NQZ)], Pu[ONE(N)][ONE(NU)];
    Factors factors;
    Factors fresh[SIMD_WIDTH > 1]; /* what only some members of a batch take over */
    real row_scale[ONE(N)], h;
    real r[ONE(NY)], delta[ONE(NY)], y[ONE(NY)];
    real *w, *room;
    long long *iw;
    void *block;
    mask factored;
    int age; /* of the factors [steps] */
    whole iterations;
} Work;

typedef struct {
    const real *q0, *p0, *z0, *u, *theta, *time_step;
    real *q1, *z1, *lam;
} Point;

/* Call one of the CasADi functions at the point. */
static inline void call(casadi_function function, const Work *k, const Point *a, real **results) {
    const real *args[9] = {a->q0, a->q1, a->p0, a->z0, a->z1, a->lam, a->u, a->theta, a->time_step};
    function(args, results, k->iw, k->w, 0);
}

/* What pulls at node k, kept for the whole step because it does not depend on the unknowns. */
static void constraint_matrix(Work *k, const Point *a) {
    if (M == 0) return;
    real *results[1] = {k->matrix_nz};
    call(matrix, k, a, results);
    for (int e = 0; e < NNZ_MATRIX; e++) k->Phi[matrix_row[e]][matrix_col[e]] = k->matrix_nz[e];
}

/* Take the pull of multipliers, or of a change of them, off the balance. */
static void pull_by(Work *k, const real *lam) {
    for (int e = 0; e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e], c = matrix_row[e];
        k->balance[i] -= k->row_scale[i] * k->Phi[c][i] * lam[c];
    }
}

/* Take the multipliers' pull off p1, once all unknowns are known. */
static void finish(Work *k, const Point *a) {
    if (!MIDDLE || M == 0) return;
    real *results[1] = {k->right_nz};
    call(ending, k, a, results);
    for (int e = 0; e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e];
        k->right_nz[e] = k->middle_nz[e] - k->right_nz[e];
        k->p1[i] -= k->row_scale[i] * k->right_nz[e] * a->lam[matrix_row[e]];
    }
}

/* Full rows of the balance (N), internal (NZ) and constraint (M) equations at the point; p1 on the way, but for what
 * `finish` adds. Whether all is finite. */
static mask evaluate(Work *k, const Point *a) {
    real *results[5] = {k->balance, k->internal, k->constraint, k->p1, k->middle_nz};
    call(residual, k, a, results);
    for (int e = 0; MIDDLE && e < NNZ_MATRIX; e++)
        k->Phi[matrix_row[e]][matrix_col[e]] = k->matrix_nz[e] + k->middle_nz[e];
    pull_by(k, a->lam);
    real sum = {0};
    for (int i = 0; i < NF; i++) sum += (k->r[i] = k->balance[free_index[i]]);
    for (int i = 0; i < NZ; i++) sum += (k->r[NF + i] = k->internal[i]);
    for (int i = 0; i < M; i++) sum += (k->r[NF + NZ + i] = k->constraint[i]);
    return is_finite(sum);
}

/* Add nonzeros by (unknowns, what was before, inputs) to the three matrices; to the first alone without the second. */
static void split_columns(int count, const real *nz, const int *row, const int *col, real *new, real *old, real *input) {
    for (int e = 0; e < count; e++) {
        const int column = col[e];
        if (column < NT) new[row[e] * ONE(NT) + column] += nz[e];
        else if (old && column < NT + NQZ) old[row[e] * ONE(NQZ) + column - NT] += nz[e];
        else if (old) input[row[e] * ONE(NU) + column - NT - NQZ] += nz[e];
    }
}

/* Entries of a joint with its ancestors from `first` on: w_i . g + V_i . x of columns of (3, N), (6, N) and (., N). */
static inline void pair_entries(const real *W, const real *g, const real *V, const real *x, int first, int last,
                                real *restrict entry) {
    for (int i = first; i < last; i++) {
        real sum = W[i] * g[0] + W[N + i] * g[N] + W[2 * N + i] * g[2 * N];
        for (int c = 0; c < 6; c++) sum += V[c * N + i] * x[c];
        entry[i] = sum;
    }
}

/* Jacobians of the rows and of p1; `everything` adds those with respect to q_k, z_k and u. */
static void linearise(Work *k, const Point *a, int everything) {
    real *results[5] = {k->pairs, k->rest, k->rest_p, k->by_unknown, k->curve_nz};
    call(linear, k, a, results);
    const real *P = k->pairs, *D = P + 6 * N, *X = D + 6 * N, *Y = X + 6 * N, *W = Y + 6 * N, *G = W + 3 * N;
    memset(k->R1, 0, sizeof k->R1);
    if (everything) {
        memset(k->R0, 0, sizeof k->R0);
        memset(k->Ru, 0, sizeof k->Ru);
        memset(k->P1, 0, sizeof k->P1);
        memset(k->P0, 0, sizeof k->P0);
        memset(k->Pu, 0, sizeof k->Pu);
    }
    for (int j = 0; j < N; j++) {
        real x[6], y[6], less_x[6], less_y[6], low[ONE(N)], up[ONE(N)], here[ONE(N)], there[ONE(N)];
        for (int c = 0; c < 6; c++) {
            less_x[c] = -(x[c] = X[c * N + j]);
            less_y[c] = -(y[c] = Y[c * N + j]);
        }
        for (int run = ancestor_start[j]; run < ancestor_start[j + 1]; run++) {
            const int first = ancestor_run[2 * run], last = ancestor_run[2 * run + 1];
            pair_entries(W, G + j, P, x, first, last, low);
            pair_entries(W, G + j, D, less_y, first, last, up);
            for (int i = first; i < last; i++) {
                k->R1[j][i] = low[i];
                k->R1[i][j] = up[i];
            }
            if (!everything) continue;
            pair_entries(W, G + j, D, less_x, first, last, here);
            pair_entries(W, G + j, P, y, first, last, there);
            for (int i = first; i < last; i++) {
                k->R0[j][i] = k->R0[i][j] = here[i];
                k->P1[j][i] = k->P1[i][j] = there[i];
                k->P0[i][j] = low[i];
                k->P0[j][i] = up[i];
            }
        }
    }
    if (CLOSED)
        for (int j = 0; j < N; j++) {
            const real *A = P + 30 * N + j, *T = A + 6 * N;
            for (int run = ancestor_start[j]; run < ancestor_start[j + 1]; run++)
                for (int i = ancestor_run[2 * run]; i < ancestor_run[2 * run + 1]; i++) {
                    /* S.A, h/2 D.A and h/2 S.T, from S = (P + D)/2 and h/2 D = (P - D)/2 */
                    real sa = {0}, da = {0}, st = {0};
                    for (int c = 0; c < 6; c++) {
                        const real s = 0.5 * (P[c * N + i] + D[c * N + i]);
                        sa += s * A[c * N];
                        da += (P[c * N + i] - s) * A[c * N];
                        st += s * T[c * N];
                    }
                    k->R1[j][i] += CLOSED_LEFT * (da + sa);
                    if (i != j) k->R1[i][j] += CLOSED_LEFT * (st + sa);
                    if (!everything) continue;
                    k->R0[j][i] += CLOSED_LEFT * (da - sa);
                    k->P1[j][i] += CLOSED_RIGHT * (da + sa);
                    k->P0[j][i] += CLOSED_RIGHT * (da - sa);
                    if (i == j) continue;
                    k->R0[i][j] += CLOSED_LEFT * (st - sa);
                    k->P1[i][j] += CLOSED_RIGHT * (st + sa);
                    k->P0[i][j] += CLOSED_RIGHT * (st - sa);
                }
        }
    if (ROW_SCALED)
        for (int j = 0; j < N; j++)
            for (int i = 0; i < N; i++) {
                k->R1[j][i] *= k->row_scale[j];
                if (!everything) continue;
                k->R0[j][i] *= k->row_scale[j];
                k->P1[j][i] *= k->row_scale[j];
                k->P0[j][i] *= k->row_scale[j];
            }
    split_columns(NNZ_REST, k->rest, rest_row, rest_col, &k->R1[0][0], everything ? &k->R0[0][0] : NULL, &k->Ru[0][0]);
    for (int e = 0; e < NNZ_CONSTRAINT; e++) k->R1[N + NZ + constraint_row[e]][constraint_col[e]] += k->by_unknown[e];
    for (int c = 0; c < M; c++)
        for (int i = 0; i < N; i++) k->R1[i][N + NZ + c] -= k->row_scale[i] * k->Phi[c][i];
    for (int e = 0; e < NNZ_CURVE; e++) {
        const int i = curve_row[e], j = curve_col[e];
        const real bent = k->row_scale[i] * k->curve_nz[e];
        k->R1[i][j] -= bent;
        if (!everything) continue;
        k->R0[i][j] -= bent;
        k->P1[i][j] -= bent;
        k->P0[i][j] -= bent;
    }
    if (!everything) return;
    split_columns(NNZ_REST_P, k->rest_p, rest_p_row, rest_p_col, &k->P1[0][0], &k->P0[0][0], &k->Pu[0][0]);
    for (int e = 0; MIDDLE && e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e];
        k->P1[i][N + NZ + matrix_row[e]] -= k->row_scale[i] * k->right_nz[e];
    }
    if (M > 0) {
        real *pulls[2] = {k->pull_nz, k->after_curve_nz};
        call(pull, k, a, pulls);
        for (int e = 0; e < NNZ_PULL; e++)
            k->R0[pull_row[e]][pull_col[e]] -= k->row_scale[pull_row[e]] * k->pull_nz[e];
        for (int e = 0; e < NNZ_AFTER_CURVE; e++)
            k->P1[after_curve_row[e]][after_curve_col[e]] += k->row_scale[after_curve_row[e]] * k->after_curve_nz[e];
    }
}

/* LU without pivoting in an order that eliminates tips before roots and multipliers last, so that the tree's sparsity
 * survives; the mass matrix over h keeps the pivots away from zero. Which members' pivots are fit to be divided by. */
static mask eliminate(const Work *k, Factors *f) {
    mask good = EVERY;
    for (int a = 0; a < NY; a++) {
        const real *row = k->R1[unknown_row[order[a]]];
        for (int b = 0; b < NY; b++) f->A[a][b] = row[unknown_row[order[b]]];
    }
    for (int p = 0; p < NY; p++) {
        const real pivot = f->A[p][p];
        good &= (magnitude(pivot) > 1e-300) & is_finite(pivot);
        if (!any(good)) break;
        const real inverse = f->inverse[p] = 1.0 / pivot;
        const real *source = f->A[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                real *target = f->A[i];
                const real factor = target[p] * inverse;
                f->LT[p][i] = factor;
                if (SIMD_WIDTH == 1 && !any(factor != 0)) continue;
                for (int cr = fill_start[p]; cr < fill_start[p + 1]; cr++) {
                    const int last = fill_run[2 * cr + 1];
                    SIMD
                    for (int c = fill_run[2 * cr]; c < last; c++) target[c] -= factor * source[c];
                }
            }
    }
    return good;
}

/* Take over some members' factors. */
static void take_factors(Factors *to, const Factors *from, mask m) {
    for (int p = 0; p < NY; p++) {
        to->inverse[p] = choose(m, from->inverse[p], to->inverse[p]);
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                to->A[p][i] = choose(m, from->A[p][i], to->A[p][i]);
                to->LT[p][i] = choose(m, from->LT[p][i], to->LT[p][i]);
            }
    }
}

/* Factors of the rows' Jacobian for some members, which the others of those at work must not notice; which are good. */
static mask factorise(Work *k, mask wanted, mask at_work) {
    const int apart = SIMD_WIDTH > 1 && any(at_work & NOT(wanted));
    Factors *f = apart ? k->fresh : &k->factors;
    const mask good = eliminate(k, f) & wanted;
    if (apart) take_factors(&k->factors, f, wanted);
    k->factored = (k->factored & NOT(wanted)) | good;
    return good;
}

/* Newton's correction x = -A^-1 r of the residual that was evaluated last. */
static void correction(Work *k, real *x) {
    const Factors *f = &k->factors;
    real *y = k->y;
    for (int a = 0; a < NY; a++) y[a] = -k->r[order[a]];
    for (int p = 0; p < NY; p++) {
        const real value = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            SIMD
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) y[i] -= f->LT[p][i] * value;
    }
    for (int p = NY - 1; p >= 0; p--) {
        real sum = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            SIMD_SUM
            for (int c = fill_run[2 * rr]; c < fill_run[2 * rr + 1]; c++) sum -= f->A[p][c] * y[c];
        y[p] = sum * f->inverse[p];
    }
    for (int a = 0; a < NY; a++) x[order[a]] = y[a];
}

/* Sensitivities are worked on in blocks of columns that fit into registers: of one member side by side, of a batch one
 * column of all members beside another. */
#if SIMD_WIDTH == 1
typedef double Wide __attribute__((vector_size(64), aligned(8), may_alias));
#define BLOCK 16
#else
typedef real Wide;
#define BLOCK 2
#endif

/* Y <- A^-1 Y for d right-hand sides; rows of Y are already in elimination order. */
static void solve_many(Work *k, real *Y, int d) {
    const Factors *f = &k->factors;
    Wide B[ONE(NY)][2];
    memset(B, 0, sizeof B);
    for (int first = 0; first < d; first += BLOCK) {
        const size_t size = sizeof(real) * (size_t)(d - first < BLOCK ? d - first : BLOCK);
        for (int p = 0; p < NY; p++) memcpy(B[p], Y + (size_t)p * d + first, size);
        for (int p = 0; p < NY; p++) {
            const Wide s0 = B[p][0], s1 = B[p][1];
            for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
                for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                    B[i][0] -= f->LT[p][i] * s0;
                    B[i][1] -= f->LT[p][i] * s1;
                }
        }
        for (int p = NY - 1; p >= 0; p--) {
            Wide s0 = B[p][0], s1 = B[p][1];
            for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
                for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                    s0 -= f->A[p][i] * B[i][0];
                    s1 -= f->A[p][i] * B[i][1];
                }
            B[p][0] = s0 * f->inverse[p];
            B[p][1] = s1 * f->inverse[p];
        }
        for (int p = 0; p < NY; p++) memcpy(Y + (size_t)p * d + first, B[p], size);
    }
}

/* Largest correction of a coordinate, or NaN. */
static real coordinate_norm(const real *delta) {
    real norm = {0}, sum = {0};
    for (int i = 0; i < NF + NZ; i++) {
        const real size = magnitude(delta[i]);
        norm = choose(size > norm, size, norm);
        sum += delta[i];
    }
    return choose(sum == sum, norm, sum);
}

static void advance(const Point *a, const real *delta, real factor, mask m) {
    const real none = {0}, by = choose(m, factor, none);
    for (int i = 0; i < NF; i++) a->q1[free_index[i]] += choose(m, by * delta[i], none);
    for (int i = 0; i < NZ; i++) a->z1[i] += choose(m, by * delta[NF + i], none);
    for (int i = 0; i < M; i++) a->lam[i] += choose(m, by * delta[NF + NZ + i], none);
}

/* Last correction of the multipliers, and of the balance, which gives the effort. */
static void settle_multipliers(Work *k, const Point *a, const real *delta, mask m) {
    const real none = {0};
    real change[ONE(M)];
    for (int c = 0; c < M; c++) a->lam[c] += change[c] = choose(m, delta[NF + NZ + c], none);
    if (NC) pull_by(k, change);
}

/* Factors serve for so many steps, whatever they still do: when to renew them then does not depend on the members of a
 * batch, all of which pay for it. */
#define OLDEST 4
#define SLOW 0.3 /* contraction that is worth a new factorisation at once */

/* Simplified Newton with the factorisation at hand; refactorises where it contracts slowly. Which of the members at work
 * converged: those that did stay where they are, with the residual and the correction of that point, until all have. */
static mask newton_chord(Work *k, const Point *a, real tolerance, int limit, mask at_work, real *error) {
    real previous = INFINITY + (real){0};
    const real whole_step = 1.0 + (real){0};
    mask left = at_work, good = NOT(EVERY), refactor = NOT(k->factored), fresh = NOT(EVERY);
    for (int it = 0; it < limit && any(left); it++) {
        k->iterations += ONES(left);
        left &= evaluate(k, a);
        if (any(left & refactor)) {
            linearise(k, a, 0);
            const mask wanted = left & refactor;
            left &= NOT(wanted) | factorise(k, wanted, at_work);
            fresh |= wanted;
            refactor &= NOT(wanted);
        }
        correction(k, k->delta);
        const real norm = coordinate_norm(k->delta), rate = norm / previous;
        *error = choose(left, norm, *error);
        left &= is_finite(norm);
        const mask done = left & ((norm <= tolerance) | ((norm < 1e3 * tolerance) & (rate > 0.5)));
        good |= done;
        left &= NOT(done);
        if (it > 0) {
            left &= NOT((rate > 0.9) & fresh);
            const mask slow = left & (rate > SLOW);
            refactor |= slow;
            fresh &= NOT(slow);
        }
        left &= NOT(norm > 1.0);
        advance(a, k->delta, whole_step, left);
        previous = norm;
    }
    settle_multipliers(k, a, k->delta, good);
    return good;
}

#if SIMD_WIDTH == 1
/* Work of the balance's residual along a correction of the coordinates. */
static double work_along(const Work *k, const double *step) {
    double sum = 0;
    for (int i = 0; i < NF; i++) sum += k->r[i] * step[i];
    return sum;
}

/* Full Newton. A correction is shortened until the next one is smaller (natural monotonicity test, Deuflhard 2011,
 * section 3.3). `by_work`: until the residual's work along it is small. Where friction changes its sign within a small
 * part of a step no correction may get smaller, but without constraints this work changes its sign once. */
static int newton_damped(Work *k, const Point *a, double tolerance, int limit, int by_work, double *error) {
    double q_keep[ONE(N)], z_keep[ONE(NZ)], lam_keep[ONE(M)], step[ONE(NY)], trial[ONE(NY)], previous = INFINITY;
    for (int it = 0; it < limit; it++) {
        k->iterations++;
        if (!evaluate(k, a)) return NOT_FINITE;
        linearise(k, a, 0);
        if (!factorise(k, EVERY, EVERY)) return SINGULAR;
        correction(k, step);
        const double norm = *error = coordinate_norm(step), work = work_along(k, step);
        const int is_near = norm < 1e3 * tolerance;
        if (!isfinite(norm)) return NOT_FINITE;
        if (norm <= tolerance || (is_near && norm > 0.5 * previous)) {
            settle_multipliers(k, a, step, EVERY);
            return OK;
        }
        if (by_work && work == 0) return NOT_CONVERGED;
        memcpy(q_keep, a->q1, sizeof(double) * N);
        memcpy(z_keep, a->z1, sizeof(double) * NZ);
        memcpy(lam_keep, a->lam, sizeof(double) * M);
        /* backwards where friction falls more steeply with the speed than inertia grows */
        const double longest = (norm > 0.5 ? 0.5 / norm : 1.0) * (by_work && work < 0 && !is_near ? -1.0 : 1.0);
        double low = 0.0, low_left = 1.0, high = 1.0, part = 1.0;
        for (;;) {
            memcpy(a->q1, q_keep, sizeof(double) * N);
            memcpy(a->z1, z_keep, sizeof(double) * NZ);
            memcpy(a->lam, lam_keep, sizeof(double) * M);
            advance(a, step, longest * part, EVERY);
            double left = NAN;
            if (evaluate(k, a) && by_work) {
                left = work_along(k, step) / work;
                if (fabs(left) <= 0.5 || (left > 0 && part == 1.0)) break;
            } else if (!by_work) {
                correction(k, trial);
                const double size = coordinate_norm(trial);
                if (isfinite(size) && size <= (1.0 - 0.25 * longest * part) * norm) break;
            }
            if (is_near) break; /* only rounding keeps it from getting smaller */
            if (high - low < 1e-4) {
                if (!by_work) return NOT_CONVERGED;
                break;
            }
            if (left > 0) low = part, low_left = left;
            else high = part;
            const double root = left < 0 ? low + (high - low) * low_left / (low_left - left) : 0.5 * (low + high);
            part = fmin(fmax(root, 0.9 * low + 0.1 * high), 0.1 * low + 0.9 * high);
        }
        previous = longest * part == 1.0 ? norm : INFINITY; /* a shortened correction need not halve the next one */
    }
    return NOT_CONVERGED;
}
#endif

/* One step of the members at work from the guess in q1 (prescribed entries already exact), z1, lam; which came through,
 * and, of a single member, how it ended. */
static mask one_step(Work *k, const Point *a, real tolerance, int limit, mask at_work, real *error, int *status) {
    *error = (real){0};
    *status = OK;
    constraint_matrix(k, a);
    if (NY == 0) {
        const mask good = evaluate(k, a);
        finish(k, a);
        *status = any(good) ? OK : NOT_FINITE;
        return good & at_work;
    }
#if SIMD_WIDTH == 1
    double q_guess[ONE(N)], z_guess[ONE(NZ)], lam_guess[ONE(M)];
    memcpy(q_guess, a->q1, sizeof(double) * N);
    memcpy(z_guess, a->z1, sizeof(double) * NZ);
    memcpy(lam_guess, a->lam, sizeof(double) * M);
#endif
    if (++k->age >= OLDEST) {
        k->factored = NOT(EVERY);
        k->age = 0;
    }
    mask good = newton_chord(k, a, tolerance, 20, at_work, error);
#if SIMD_WIDTH == 1
    for (int attempt = 0; !good && attempt < 3; attempt++) {
        for (int i = 0; i < N; i++) a->q1[i] = q_guess[i];
        if (attempt)
            for (int i = 0; i < NF; i++) a->q1[free_index[i]] = a->q0[free_index[i]];
        for (int i = 0; i < NZ; i++) a->z1[i] = attempt ? a->z0[i] : z_guess[i];
        for (int i = 0; i < M; i++) a->lam[i] = attempt ? 0.0 : lam_guess[i];
        const int end = newton_damped(k, a, tolerance, limit, attempt == 2, error);
        good = end == OK;
        if (good || !attempt) *status = end;
    }
#endif
    k->factored &= good;
    if (any(good)) finish(k, a);
    return good;
}

static void prepare(Work *k, const real *theta, const real *time_step) {
    real none[ONE(NX)] = {0};
    Point a = {none, none, none, none, theta, time_step, none, none, none};
    real *results[2] = {k->row_scale, &k->h};
    call(scales, k, &a, results);
}

/* C[rows] += A X for the listed nonzero columns of each row; A has `width` columns, X has d, and room for BLOCK entries
 * after its last one, which are read but not used. */
static void multiply_rows(const real *A, int width, const int *start, const int *column, int rows, const real *X, int d,
                          real *C) {
    for (int first = 0; first < d; first += BLOCK) {
        const int wide = d - first < BLOCK ? d - first : BLOCK;
        for (int r = 0; r < rows; r++) {
            Wide sum[2] = {{0}, {0}};
            for (int e = start[r]; e < start[r + 1]; e++) {
                const real factor = A[(size_t)r * width + column[e]];
                const Wide *source = (const Wide *)(X + (size_t)column[e] * d + first);
                sum[0] += factor * source[0];
                sum[1] += factor * source[1];
            }
            real *target = C + (size_t)r * d + first;
            for (int c = 0; c < wide; c++) target[c] += ((const real *)sum)[c];
        }
    }
}

/* What to differentiate by: `count` columns, the first `theta_count` of which are parameters. A pattern is CasADi's
 * compressed columns (rows, columns, column offsets, row indices); compiled.py checks that they fit this kernel. */
typedef struct {
    int count, theta_count;
    theta_function by_theta;
    const long long *rows_pattern, *p1_pattern, *effort_pattern;
    double *rows_nz, *p1_nz, *effort_nz, *w;
    long long *iw;
} Directions;

/* Feedback u_k = ubar_k - K_k (x_k[index] - xbar_k); gain is (steps, NU, count), reference (steps, count). */
typedef struct {
    int count;
    const int *index;
    const double *gain, *reference;
} Feedback;

/* What the entry points are asked about; feedback and directions may be NULL. The nominal torque (steps, NU), the path
 * (steps + 1, NC) and Newton's tolerance and limit matter to a rollout. */
typedef struct {
    int steps, limit;
    double time_step, tolerance;
    const double *theta, *torque, *path;
    const Feedback *feedback;
    const Directions *directions;
} Motion;

/* state (steps + 1, NX), multipliers (steps, M), effort (steps, NC) and applied torque (steps, NU). A rollout is given
 * the first state and writes the rest, the others read; effort matters to a rollout only. */
typedef struct {
    double *state, *multipliers, *effort, *applied;
} Trajectory;

/* Forward sensitivities of a rollout, each with d columns: state (steps + 1, NX, d), its first block given, multipliers
 * (steps, M, d), effort (steps, NC, d); given torque (steps, NU, d) and path (steps + 1, NC, d) may be NULL. */
typedef struct {
    double *state, *multipliers, *effort;
    const double *torque, *path;
} Sensitivities;

/* Partial derivatives of a cost by what a rollout gives; the last two may be NULL. */
typedef struct {
    const double *state, *multipliers, *effort;
} Partials;

/* By the chosen parameters (theta_count), the initial state (NX), the torque (steps, NU) and the path (steps + 1, NC). */
typedef struct {
    double *theta, *start, *torque, *path;
} Gradient;

/* Rows (steps, NT) and p1 (steps, N) with their Jacobians; these may be NULL together. */
typedef struct {
    double *rows, *p1, *rows_new, *rows_old, *rows_input, *p1_new, *p1_old, *p1_input, *rows_theta, *p1_theta;
} Linearization;

/* Steps as maps of the state before them, under the motion's feedback, of `inputs` columns of torque (steps, NU, inputs), and
 * of loads on rows (NT, loads) and p1 (N, loads): to the state after (steps, NX, d), and to the effort and the constraint
 * forces (steps, NC + M, d), with d = NX + inputs + loads. */
typedef struct {
    int inputs, loads;
    const double *torque, *on_rows, *on_p1;
    double *after, *effort;
} StepMaps;

/* The step reached and how it ended, Newton's last correction, their total, and the memory that was asked for [bytes]; all
 * zero when it is handed over. */
typedef struct {
    int step, status;
    double error;
    long long iterations, memory;
} Outcome;

/* C += nz in one member's entries. */
static void add_sparse(const double *nz, const long long *pattern, real *C, int d, int entry) {
    const long long columns = pattern[1], *offset = pattern + 2, *row = pattern + 3 + columns;
    for (long long c = 0; c < columns; c++)
        for (long long e = offset[c]; e < offset[c + 1]; e++) SIMD_ENTRY(C[(size_t)row[e] * d + c], entry) += nz[e];
}

/* One member's entries of something, one after another. */
static const double *member(const real *x, int count, int entry, double *room) {
    if (SIMD_WIDTH == 1) return (const double *)x;
    for (int i = 0; i < count; i++) room[i] = SIMD_ENTRY(x[i], entry);
    return room;
}

/* Derivatives by one member's parameters, which need not be those of another. */
static void theta_columns(const Motion *motion, const Point *a, int entry) {
    const Directions *dir = motion->directions;
    double q0[ONE(N)], q1[ONE(N)], p0[ONE(N)], z0[ONE(NZ)], z1[ONE(NZ)], lam[ONE(M)], u[ONE(NU)];
    const double *args[9] = {
        member(a->q0, N, entry, q0),   member(a->q1, N, entry, q1), member(a->p0, N, entry, p0), member(a->z0, NZ, entry, z0),
        member(a->z1, NZ, entry, z1), member(a->lam, M, entry, lam), member(a->u, NU, entry, u), motion->theta,
        &motion->time_step,
    };
    double *res[3] = {dir->rows_nz, dir->p1_nz, dir->effort_nz};
    dir->by_theta(args, res, dir->iw, dir->w, 0);
}

/* Columns of one step, each (rows, d): of the state before (NX) and after, the input (NU) or NULL, the prescribed
 * coordinates after (NC) or NULL, multipliers and effort; then room for rows (NT), joined (NT), Y (NY), input (NU) and
 * start (NQZ). */
typedef struct {
    const real *before, *input, *path;
    real *after, *multipliers, *effort;
    real *rows, *joined, *Y, *input_room, *start;
} Columns;

/* Forward sensitivities of one converged step in d directions, for so many members. */
static void sensitivity_step(Work *k, const Point *a, int d, int members, const Motion *motion, const Columns *columns) {
    const real *X0 = columns->before, *input = columns->input, *path = columns->path;
    real *X1 = columns->after, *effort = columns->effort, *rows = columns->rows, *joined = columns->joined;
    real *Y = columns->Y, *start = columns->start;
    /* (q, z) of X0 side by side */
    memcpy(start, X0, sizeof(real) * N * d);
    memcpy(start + (size_t)N * d, X0 + (size_t)2 * N * d, sizeof(real) * NZ * d);
    memset(rows, 0, sizeof(real) * NT * d);
    multiply_rows(&k->R0[0][0], ONE(NQZ), rows_old_start, rows_old_col, NT, start, d, rows);
    for (int i = 0; i < N * d; i++) rows[i] += X0[(size_t)N * d + i];
    real *p1 = X1 + (size_t)N * d;
    memset(p1, 0, sizeof(real) * N * d);
    for (int entry = 0; entry < members; entry++) {
        const Directions *dir = motion[entry].directions;
        if (!dir || !dir->theta_count) continue;
        theta_columns(motion + entry, a, entry);
        add_sparse(dir->rows_nz, dir->rows_pattern, rows, d, entry);
        add_sparse(dir->p1_nz, dir->p1_pattern, p1, d, entry);
    }
    if (input)
        /* internal coordinates may follow an input too, as play behind a servo does */
        for (int r = 0; r < N + NZ; r++)
            for (int j = 0; j < NU; j++) {
                const real f = k->Ru[r][j];
                const int f_acts = any(f != 0), g_acts = r < N && any(k->Pu[r][j] != 0);
                for (int c = 0; f_acts && c < d; c++) rows[(size_t)r * d + c] += f * input[(size_t)j * d + c];
                for (int c = 0; g_acts && c < d; c++) p1[(size_t)r * d + c] += k->Pu[r][j] * input[(size_t)j * d + c];
            }
    memset(joined, 0, sizeof(real) * NT * d);
    if (path)
        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            memcpy(joined + (size_t)at * d, path + (size_t)j * d, sizeof(real) * d);
            for (int r = 0; r < NT; r++) {
                const real f = k->R1[r][at];
                const int acts = any(f != 0);
                for (int c = 0; acts && c < d; c++) rows[(size_t)r * d + c] += f * path[(size_t)j * d + c];
            }
        }
    for (int b = 0; b < NY; b++) {
        const real *source = rows + (size_t)unknown_row[order[b]] * d;
        for (int c = 0; c < d; c++) Y[(size_t)b * d + c] = -source[c];
    }
    solve_many(k, Y, d);
    for (int b = 0; b < NY; b++)
        memcpy(joined + (size_t)unknown_row[order[b]] * d, Y + (size_t)b * d, sizeof(real) * d);
    memcpy(X1, joined, sizeof(real) * N * d);
    memcpy(X1 + (size_t)2 * N * d, joined + (size_t)N * d, sizeof(real) * NZ * d);
    memcpy(columns->multipliers, joined + (size_t)(N + NZ) * d, sizeof(real) * M * d);
    multiply_rows(&k->P0[0][0], ONE(NQZ), p1_old_start, p1_old_col, N, start, d, p1);
    multiply_rows(&k->P1[0][0], ONE(NT), p1_new_start, p1_new_col, N, joined, d, p1);
    memset(effort, 0, sizeof(real) * NC * d);
    for (int entry = 0; entry < members; entry++) {
        const Directions *dir = motion[entry].directions;
        if (dir && dir->theta_count) add_sparse(dir->effort_nz, dir->effort_pattern, effort, d, entry);
    }
    for (int j = 0; j < NC; j++) {
        const int at = prescribed_index[j];
        real *target = effort + (size_t)j * d;
        for (int c = 0; c < d; c++) {
            real sum = X0[(size_t)(N + at) * d + c];
            for (int i = 0; i < NQZ; i++) sum += k->R0[at][i] * start[(size_t)i * d + c];
            for (int i = 0; i < NT; i++) sum += k->R1[at][i] * joined[(size_t)i * d + c];
            if (input)
                for (int i = 0; i < NU; i++) sum += k->Ru[at][i] * input[(size_t)i * d + c];
            target[c] -= sum / k->h;
        }
    }
}

/* u = nominal - gain (state[index] - reference) */
static void apply_feedback(int count, const int *index, const real *gain, const real *reference, const real *state,
                           const real *nominal, real *u) {
    for (int i = 0; i < NU; i++) {
        real value = nominal[i];
        for (int j = 0; j < count; j++) value -= gain[i * count + j] * (state[index[j]] - reference[j]);
        u[i] = value;
    }
}

/* Columns of the torque of one step: those of the nominal one, already in the room or none, less what the feedback makes
 * of the state's. */
static void feed_columns(int count, const int *index, const real *gain, int d, const real *state, real *room) {
    for (int i = 0; i < NU; i++)
        for (int j = 0; j < count; j++) {
            const real by = gain[i * count + j];
            const real *source = state + (size_t)index[j] * d;
            const int acts = any(by != 0);
            for (int c = 0; acts && c < d; c++) room[(size_t)i * d + c] -= by * source[c];
        }
}

/* Where a step from the last of the states x, the one before and that before it is looked for first: q and z
 * extrapolated, prescribed entries known. */
static void guess(real *const x[3], int step, const real *prescribed, real *q1, real *z1) {
    const real *now = x[0], *before = x[1], *first = x[2];
    for (int i = 0; i < N; i++) {
        q1[i] = now[i];
        if (step > 1) q1[i] = 3 * (now[i] - before[i]) + first[i];
        else if (step == 1) q1[i] = 2 * now[i] - before[i];
    }
    for (int i = 2 * N; i < NX; i++) {
        z1[i - 2 * N] = now[i];
        if (step > 0) z1[i - 2 * N] = 2 * now[i] - before[i];
    }
    for (int j = 0; j < NC; j++) q1[prescribed_index[j]] = prescribed[j];
}

#define ALIGNMENT 64
#define EACH for (int entry = 0; entry < SIMD_WIDTH; entry++)

/* Room for one step's work and so many numbers more (`room`), in one block; NULL where there is not so much memory. */
static Work *work_new(size_t numbers, Outcome *outcome) {
    const size_t reals = numbers + ONE(SZ_W);
    const size_t size = sizeof(Work) + sizeof(real) * reals + sizeof(long long) * ONE(SZ_IW) + 2 * ALIGNMENT;
    outcome->memory = (long long)size;
    char *block = YID_ALLOCATE(1, size);
    if (!block) return NULL;
    Work *k = (Work *)(block + ALIGNMENT - (size_t)block % ALIGNMENT);
    k->block = block;
    k->room = (real *)((char *)k + (sizeof(Work) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT);
    k->w = k->room + numbers;
    k->iw = (long long *)(k->w + ONE(SZ_W));
    return k;
}

/* One member's rows of `own` columns, among those of `d` columns of all; and back into its own array. */
static void gather(const double *from, size_t rows, size_t own, size_t d, int entry, real *to) {
    for (size_t i = 0; i < rows; i++)
        for (size_t c = 0; c < own; c++) SIMD_ENTRY(to[i * d + c], entry) = from[i * own + c];
}

static void scatter(const real *from, size_t rows, size_t own, size_t d, int entry, double *to) {
    if ((const void *)from == (const void *)to) return;
    for (size_t i = 0; i < rows; i++)
        for (size_t c = 0; c < own; c++) to[i * own + c] = SIMD_ENTRY(from[i * d + c], entry);
}

/* Rollouts of so many members at once, with forward sensitivities where there are directions. Members have their own
 * number of steps and their own directions, if any has some; what their feedback reads is the same. A batch leaves members
 * that do not get through by simplified Newton alone to whoever asked. */
int yid_rollout(int members, const Motion *motions, const Trajectory *outs, const Sensitivities *bys, Outcome *outcomes) {
    const Feedback *feedback = NU ? motions->feedback : NULL;
    const int feeds = feedback ? feedback->count : 0;
    const int *fed = feeds ? feedback->index : NULL;
    size_t d = 0; /* columns of the member with the most; those that others lack stay zero */
    for (int entry = 0; entry < members && motions->directions; entry++)
        if ((size_t)motions[entry].directions->count > d) d = motions[entry].directions->count;
    const size_t apart = SIMD_WIDTH == 1 ? 0 : d; /* a single member's columns are worked out where they are wanted */
    Work *k = work_new(3 * NX + NTHETA + (NU + 1) * (size_t)feeds + NU + NC + d * (2 * NT + NY + NU + NQZ) +
                           apart * (2 * NX + M + 2 * NC) + BLOCK,
                       outcomes);
    if (!k) return OUT_OF_MEMORY;
    struct {
        real *x[3], *theta, *gain, *reference, *nominal, *prescribed; /* states of this node and of the two before */
        real time_step, tolerance, error;
        mask running;
    } m;
    real *room = k->room;
    for (int i = 0; i < 3; i++, room += NX) m.x[i] = room;
    m.theta = room;
    m.gain = m.theta + NTHETA;
    m.reference = m.gain + NU * feeds;
    m.nominal = m.reference + feeds;
    m.prescribed = m.nominal + NU;
    room = m.prescribed + NC;
    Columns columns = {0};
    real *X[2] = {room, room + NX * apart}, *moved_path;
    columns.multipliers = X[1] + NX * apart;
    columns.effort = columns.multipliers + M * apart;
    moved_path = columns.effort + NC * apart;
    columns.rows = moved_path + NC * apart;
    columns.joined = columns.rows + NT * d;
    columns.Y = columns.joined + NT * d;
    columns.input_room = columns.Y + NY * d;
    columns.start = columns.input_room + NU * d;

    /* entries beyond the last member do what the first one does, and nobody looks */
    const Motion *motion[SIMD_WIDTH];
    const Trajectory *out[SIMD_WIDTH];
    const Sensitivities *by[SIMD_WIDTH];
    int most = 0;
    EACH {
        const int who = entry < members ? entry : 0;
        motion[entry] = motions + who;
        out[entry] = outs + who;
        by[entry] = bys + who;
        if (motion[entry]->steps > most) most = motion[entry]->steps;
        SIMD_ENTRY(m.running, entry) = ONES(entry < members);
        SIMD_ENTRY(m.time_step, entry) = motion[entry]->time_step;
        SIMD_ENTRY(m.tolerance, entry) = motion[entry]->tolerance;
    }
    size_t own[SIMD_WIDTH];
    int moves = 0, fed_forward = 0;
    EACH {
        gather(motion[entry]->theta, NTHETA, 1, 1, entry, m.theta);
        gather(out[entry]->state, NX, 1, 1, entry, m.x[0]);
        own[entry] = d ? (size_t)motion[entry]->directions->count : 0;
        moves |= d && by[entry]->path;
        fed_forward |= d && by[entry]->torque;
        if (apart) gather(by[entry]->state, NX, own[entry], d, entry, X[0]);
    }
    prepare(k, m.theta, &m.time_step);

    real q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], u[ONE(NU)], effort[ONE(NC)], error;
    memset(lam, 0, sizeof lam);
    m.error = (real){0};
    for (int step = 0; step < most && any(m.running); step++) {
        mask at_work = m.running;
        int row[SIMD_WIDTH], status;
        EACH {
            const int last = motion[entry]->steps - 1;
            row[entry] = step < last ? step : last;
            SIMD_ENTRY(at_work, entry) &= ONES(step <= last);
            const Feedback *loop = motion[entry]->feedback;
            const size_t at = row[entry];
            gather(motion[entry]->path + (at + 1) * NC, NC, 1, 1, entry, m.prescribed);
            if (NU) gather(motion[entry]->torque + at * NU, NU, 1, 1, entry, m.nominal);
            if (feeds) gather(loop->gain + at * NU * feeds, (size_t)NU * feeds, 1, 1, entry, m.gain);
            if (feeds) gather(loop->reference + at * feeds, feeds, 1, 1, entry, m.reference);
        }
        const real *x = m.x[0];
        real *next = m.x[2];
        apply_feedback(feeds, fed, m.gain, m.reference, x, m.nominal, u);
        guess(m.x, step, m.prescribed, q1, z1);
        Point a = {x, x + N, x + 2 * N, u, m.theta, &m.time_step, q1, z1, lam};
        const mask good = one_step(k, &a, m.tolerance, motions->limit, at_work, &error, &status);
        m.error = choose(at_work, error, m.error);
        for (int j = 0; j < NC; j++) effort[j] = -k->balance[prescribed_index[j]] / k->h;
        for (int entry = 0; entry < members; entry++) {
            if (!SIMD_ENTRY(at_work, entry)) continue;
            double *state = outs[entry].state + (size_t)(step + 1) * NX;
            scatter(u, NU, 1, 1, entry, outs[entry].applied + (size_t)step * NU);
            scatter(q1, N, 1, 1, entry, state);
            scatter(k->p1, N, 1, 1, entry, state + N);
            scatter(z1, NZ, 1, 1, entry, state + 2 * N);
            outcomes[entry].step = step;
            outcomes[entry].status = SIMD_ENTRY(good, entry) ? OK : SIMD_WIDTH == 1 ? status : NOT_CONVERGED;
            if (!SIMD_ENTRY(good, entry)) continue;
            scatter(lam, M, 1, 1, entry, outs[entry].multipliers + (size_t)step * M);
            scatter(effort, NC, 1, 1, entry, outs[entry].effort + (size_t)step * NC);
        }
        /* those that have ended, well or not, stay where they are */
        for (int i = 0; i < N; i++) next[i] = choose(good, q1[i], x[i]);
        for (int i = 0; i < N; i++) next[N + i] = choose(good, k->p1[i], x[N + i]);
        for (int i = 0; i < NZ; i++) next[2 * N + i] = choose(good, z1[i], x[2 * N + i]);
        m.running &= good | NOT(at_work);
        if (d && any(good)) {
            linearise(k, &a, 1);
            const mask solvable = NY ? factorise(k, EVERY, EVERY) : EVERY;
            k->age = 0;
            columns.before = X[step % 2];
            columns.after = X[1 - step % 2];
            columns.input = columns.path = NULL;
            if (SIMD_WIDTH == 1) {
                columns.before = (real *)bys->state + (size_t)step * NX * d;
                columns.after = (real *)bys->state + (size_t)(step + 1) * NX * d;
                columns.multipliers = (real *)bys->multipliers + (size_t)step * M * d;
                columns.effort = (real *)bys->effort + (size_t)step * NC * d;
            }
            if (NU && (feeds || fed_forward)) {
                columns.input = columns.input_room;
                memset(columns.input_room, 0, sizeof(real) * NU * d);
                EACH {
                    const double *given = by[entry]->torque ? by[entry]->torque + row[entry] * NU * own[entry] : NULL;
                    if (given) gather(given, NU, own[entry], d, entry, columns.input_room);
                }
                feed_columns(feeds, fed, m.gain, (int)d, columns.before, columns.input_room);
            }
            if (moves) {
                columns.path = SIMD_WIDTH == 1 ? (const real *)bys->path + (size_t)(step + 1) * NC * d : moved_path;
                EACH {
                    const double *given = by[entry]->path ? by[entry]->path + (row[entry] + 1) * NC * own[entry] : NULL;
                    if (given && SIMD_WIDTH > 1) gather(given, NC, own[entry], d, entry, moved_path);
                }
            }
            if (any(solvable)) sensitivity_step(k, &a, (int)d, members, motions, &columns);
            for (int entry = 0; entry < members; entry++) {
                if (!SIMD_ENTRY(good, entry)) continue;
                if (!SIMD_ENTRY(solvable, entry)) outcomes[entry].status = SINGULAR;
                else {
                    const size_t of = own[entry], at = step;
                    scatter(columns.after, NX, of, d, entry, bys[entry].state + (at + 1) * NX * of);
                    scatter(columns.multipliers, M, of, d, entry, bys[entry].multipliers + at * M * of);
                    scatter(columns.effort, NC, of, d, entry, bys[entry].effort + at * NC * of);
                }
            }
            m.running &= solvable | NOT(good);
        }
        m.x[2] = m.x[1];
        m.x[1] = m.x[0];
        m.x[0] = next;
    }
    for (int entry = 0; entry < members; entry++) {
        if (outcomes[entry].status == OK) outcomes[entry].step = motions[entry].steps;
        outcomes[entry].error = SIMD_ENTRY(m.error, entry);
        outcomes[entry].iterations = SIMD_ENTRY(k->iterations, entry);
    }
    YID_FREE(k->block);
    return OK;
}

/* What follows does one member alone. */
#if SIMD_WIDTH == 1

static void solve_transposed(Work *k, const double *b, double *x) {
    double *y = k->y;
    for (int a = 0; a < NY; a++) y[a] = b[order[a]];
    for (int p = 0; p < NY; p++) {
        const double value = y[p] *= k->factors.inverse[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            SIMD
            for (int c = fill_run[2 * rr]; c < fill_run[2 * rr + 1]; c++) y[c] -= k->factors.A[p][c] * value;
    }
    for (int p = NY - 1; p >= 0; p--) {
        double sum = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            SIMD_SUM
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) sum -= k->factors.LT[p][i] * y[i];
        y[p] = sum;
    }
    for (int a = 0; a < NY; a++) x[order[a]] = y[a];
}

/* One step of a trajectory that is given, and what pulls at its first node; with `whole` its rows and p1 as well. */
static Point recorded_step(Work *k, const Motion *motion, const Trajectory *along, int step, int whole) {
    double *x = along->state + (size_t)step * NX, *next = x + NX, *lam = along->multipliers + (size_t)step * M;
    const double *u = along->applied + (size_t)step * NU;
    const Point a = {x, x + N, x + 2 * N, u, motion->theta, &motion->time_step, next, next + 2 * N, lam};
    constraint_matrix(k, &a);
    if (whole) {
        evaluate(k, &a);
        finish(k, &a);
    }
    return a;
}

/* Gradient of a cost along a finished rollout, step by step from its end; a status. */
int yid_adjoint(const Motion *motion, const Trajectory *rollout, const Partials *by, const Gradient *gradient,
                Outcome *outcome) {
    const Directions *dir = motion->directions;
    const Feedback *feedback = motion->feedback;
    const int steps = motion->steps, feeds = feedback && feedback->count > 0, thetas = dir ? dir->theta_count : 0;
    Work *k = work_new(0, outcome);
    if (!k) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    double costate[ONE(NX)], g[ONE(NY)], nu[ONE(NY)], full[ONE(NT)], mu[ONE(NX)], mu_u[ONE(NU)];
    memset(gradient->theta, 0, sizeof(double) * thetas);
    memcpy(costate, by->state + (size_t)steps * NX, sizeof(double) * NX);
    int status = OK, step = steps - 1;
    for (; step >= 0; step--) {
        const Point a = recorded_step(k, motion, rollout, step, MIDDLE);
        linearise(k, &a, 1);
        if (NY && !factorise(k, EVERY, EVERY)) {
            status = SINGULAR;
            break;
        }
        const double *weight = costate + N, *effort = by->effort ? by->effort + (size_t)step * NC : NULL;
        for (int b = 0; b < NY; b++) {
            const int column = unknown_row[b];
            double sum = column < N ? costate[column] : column < N + NZ ? costate[N + column] : 0.0;
            if (column >= N + NZ && by->multipliers) sum += by->multipliers[(size_t)step * M + column - N - NZ];
            for (int i = 0; i < N; i++) sum += k->P1[i][column] * weight[i];
            for (int j = 0; effort && j < NC; j++) sum -= k->R1[prescribed_index[j]][column] * effort[j] / k->h;
            g[b] = -sum;
        }
        if (NY) solve_transposed(k, g, nu);
        memset(full, 0, sizeof full);
        for (int b = 0; b < NY; b++) full[unknown_row[b]] = nu[b];
        for (int j = 0; effort && j < NC; j++) full[prescribed_index[j]] = -effort[j] / k->h;
        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            double sum = costate[at];
            for (int r = 0; r < NT; r++) sum += k->R1[r][at] * full[r];
            for (int r = 0; r < N; r++) sum += k->P1[r][at] * weight[r];
            gradient->path[(size_t)(step + 1) * NC + j] = sum;
        }
        for (int i = 0; i < NQZ; i++) {
            double sum = 0;
            for (int r = 0; r < NT; r++) sum += k->R0[r][i] * full[r];
            for (int r = 0; r < N; r++) sum += k->P0[r][i] * weight[r];
            mu[i < N ? i : N + i] = sum;
        }
        for (int i = 0; i < N; i++) mu[N + i] = full[i];
        for (int j = 0; j < NU; j++) {
            mu_u[j] = 0;
            for (int r = 0; r < NT; r++) mu_u[j] += k->Ru[r][j] * full[r];
            for (int r = 0; r < N; r++) mu_u[j] += k->Pu[r][j] * weight[r];
            gradient->torque[(size_t)step * NU + j] = mu_u[j];
        }
        for (int j = 0; feeds && j < NU; j++)
            for (int c = 0; c < feedback->count; c++)
                mu[feedback->index[c]] -= feedback->gain[((size_t)step * NU + j) * feedback->count + c] * mu_u[j];
        if (thetas) {
            for (int j = 0; effort && j < NC; j++) full[prescribed_index[j]] = 0;
            theta_columns(motion, &a, 0);
            const long long *patterns[3] = {dir->rows_pattern, dir->p1_pattern, dir->effort_pattern};
            const double *values[3] = {dir->rows_nz, dir->p1_nz, dir->effort_nz}, *weights[3] = {full, weight, effort};
            for (int part = 0; part < 3; part++) {
                const long long *offset = patterns[part] + 2, *row = patterns[part] + 3 + thetas;
                if (!weights[part]) continue;
                for (int c = 0; c < thetas; c++)
                    for (long long e = offset[c]; e < offset[c + 1]; e++)
                        gradient->theta[c] += weights[part][row[e]] * values[part][e];
            }
        }
        for (int i = 0; i < NX; i++) costate[i] = mu[i] + by->state[(size_t)step * NX + i];
    }
    memcpy(gradient->start, costate, sizeof(double) * NX);
    for (int j = 0; j < NC; j++) gradient->path[j] = costate[prescribed_index[j]];
    outcome->step = step;
    YID_FREE(k->block);
    return status;
}

/* Rows, p1 and their Jacobians at the steps of a trajectory that need not satisfy the equations (a transcription's
 * iterate); a status. */
int yid_linearize(const Motion *motion, const Trajectory *along, const Linearization *out, Outcome *outcome) {
    const Directions *dir = motion->directions;
    Work *k = work_new(0, outcome);
    if (!k) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    for (int step = 0; step < motion->steps; step++) {
        const Point a = recorded_step(k, motion, along, step, 1);
        double *r = out->rows + (size_t)step * NT;
        memcpy(r, k->balance, sizeof(double) * N);
        memcpy(r + N, k->internal, sizeof(double) * NZ);
        memcpy(r + N + NZ, k->constraint, sizeof(double) * M);
        memcpy(out->p1 + (size_t)step * N, k->p1, sizeof(double) * N);
        if (!out->rows_new) continue;
        linearise(k, &a, 1);
        memcpy(out->rows_new + (size_t)step * NT * NT, k->R1, sizeof(double) * NT * NT);
        memcpy(out->rows_old + (size_t)step * NT * NQZ, k->R0, sizeof(double) * NT * NQZ);
        memcpy(out->p1_new + (size_t)step * N * NT, k->P1, sizeof(double) * N * NT);
        memcpy(out->p1_old + (size_t)step * N * NQZ, k->P0, sizeof(double) * N * NQZ);
        memcpy(out->rows_input + (size_t)step * NT * NU, k->Ru, sizeof(double) * NT * NU);
        memcpy(out->p1_input + (size_t)step * N * NU, k->Pu, sizeof(double) * N * NU);
        if (dir && dir->theta_count) {
            const int d = dir->count;
            theta_columns(motion, &a, 0);
            add_sparse(dir->rows_nz, dir->rows_pattern, out->rows_theta + (size_t)step * NT * d, d, 0);
            add_sparse(dir->p1_nz, dir->p1_pattern, out->p1_theta + (size_t)step * N * d, d, 0);
        }
    }
    YID_FREE(k->block);
    return OK;
}

/* A row of step maps from its slopes by old (q, z), torque and loads. */
static void map_row(const Feedback *feedback, const StepMaps *maps, int step, const double *old, const double *torque,
                    const double *load, double *row) {
    memset(row, 0, sizeof(double) * (NX + maps->inputs));
    memcpy(row, old, sizeof(double) * N);
    memcpy(row + 2 * N, old + N, sizeof(double) * NZ);
    memcpy(row + NX + maps->inputs, load, sizeof(double) * maps->loads);
    for (int u = 0; u < NU; u++) {
        if (torque[u] == 0) continue;
        const size_t at = (size_t)step * NU + u;
        for (int c = 0; c < maps->inputs; c++) row[NX + c] += torque[u] * maps->torque[at * maps->inputs + c];
        for (int c = 0; feedback && c < feedback->count; c++)
            row[feedback->index[c]] -= torque[u] * feedback->gain[at * feedback->count + c];
    }
}

/* Steps of a trajectory as linear maps, by the implicit function theorem, prescribed coordinates unchanged; a status. */
int yid_step_maps(const Motion *motion, const Trajectory *along, const StepMaps *out, Outcome *outcome) {
    const int loads = out->loads, d = NX + out->inputs + loads;
    const Feedback *feedback = motion->feedback;
    Work *k = work_new((size_t)(NT + NY) * d + BLOCK, outcome);
    if (!k) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    double *Y = k->room, *joined = Y + (size_t)NY * d;
    int status = OK;
    for (int step = 0; step < motion->steps; step++) {
        const Point a = recorded_step(k, motion, along, step, MIDDLE);
        linearise(k, &a, 1);
        if (NY && !factorise(k, EVERY, EVERY)) {
            status = SINGULAR;
            break;
        }
        for (int b = 0; b < NY; b++) {
            const int r = unknown_row[order[b]];
            double *row = Y + (size_t)b * d;
            map_row(feedback, out, step, k->R0[r], k->Ru[r], out->on_rows + (size_t)r * loads, row);
            if (r < N) row[N + r] += 1.0;
        }
        solve_many(k, Y, d);
        memset(joined, 0, sizeof(double) * NT * d);
        for (int b = 0; b < NY; b++)
            for (int c = 0; c < d; c++) joined[(size_t)unknown_row[order[b]] * d + c] = -Y[(size_t)b * d + c];
        double *after = out->after + (size_t)step * NX * d, *effort = out->effort + (size_t)step * (NC + M) * d;
        memcpy(after, joined, sizeof(double) * N * d);
        memcpy(after + (size_t)2 * N * d, joined + (size_t)N * d, sizeof(double) * NZ * d);
        after += (size_t)N * d;
        for (int r = 0; r < N; r++)
            map_row(feedback, out, step, k->P0[r], k->Pu[r], out->on_p1 + (size_t)r * loads, after + (size_t)r * d);
        multiply_rows(&k->P1[0][0], ONE(NT), p1_new_start, p1_new_col, N, joined, d, after);
        for (int j = 0; j < NC; j++, effort += d) {
            const int at = prescribed_index[j];
            map_row(feedback, out, step, k->R0[at], k->Ru[at], out->on_rows + (size_t)at * loads, effort);
            effort[N + at] += 1.0;
            for (int i = 0; i < NT; i++)
                for (int c = 0; c < d; c++) effort[c] += k->R1[at][i] * joined[(size_t)i * d + c];
            for (int c = 0; c < d; c++) effort[c] /= -k->h;
        }
        for (int i = 0; i < M * d; i++) effort[i] = joined[(size_t)(N + NZ) * d + i] / motion->time_step;
    }
    outcome->status = status;
    YID_FREE(k->block);
    return status;
}
#endif
