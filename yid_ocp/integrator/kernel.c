/* Time stepping of one system: Newton with a kept factorisation, rollout with forward sensitivities, adjoint.
 *
 * The generated part before this text defines the sizes N, NZ, M, NU, NC, NF, NY and NT, counts of nonzeros (NNZ_...),
 * sizes of CasADi's work arrays (SZ_W, SZ_IW), what the system needs (ROW_SCALED, MIDDLE, CLOSED, CLOSED_LEFT,
 * CLOSED_RIGHT),
 * the index tables and the CasADi functions residual, linear, matrix, ending, pull, scales and resting; see codegen.py.
 *   N coordinates, NZ internal ones, M constraints, NU inputs, NC prescribed and NF free coordinates,
 *   NT = N + NZ + M rows, NY = NF + NZ + M unknowns of a step, NX = 2 N + NZ state (q, p, z).
 * All matrices are row-major. compiled.py declares the structs of the entry points at the end once more.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NX (2 * N + NZ)
#define NQZ (N + NZ)
#define ONE(x) ((x) > 0 ? (x) : 1)

/* A test puts its own in their place. */
#ifndef YID_ALLOCATE
#define YID_ALLOCATE calloc
#define YID_FREE free
#endif

/* The values of StepCode in step_model.py. */
enum { OK = 0, NOT_CONVERGED = 1, SINGULAR = 2, NOT_FINITE = 3, OUT_OF_MEMORY = 4 };

typedef int (*theta_function)(const double **, double **, long long *, double *, int);

typedef struct {
    double balance[ONE(N)], internal[ONE(NZ)], constraint[ONE(M)], p1[ONE(N)];
    double pairs[(30 + 12 * CLOSED) * ONE(N)];
    double rest[ONE(NNZ_REST)], rest_p[ONE(NNZ_REST_P)], by_unknown[ONE(NNZ_CONSTRAINT)];
    double matrix_nz[ONE(NNZ_MATRIX)], middle_nz[ONE(NNZ_MATRIX)], right_nz[ONE(NNZ_MATRIX)], pull_nz[ONE(NNZ_PULL)];
    double curve_nz[ONE(NNZ_CURVE)], after_curve_nz[ONE(NNZ_AFTER_CURVE)];
    double Phi[ONE(M)][ONE(N)]; /* rows of the multipliers' pull in the balance */
    double R1[ONE(NT)][ONE(NT)], R0[ONE(NT)][ONE(NQZ)], Ru[ONE(NT)][ONE(NU)];
    double P1[ONE(N)][ONE(NT)], P0[ONE(N)][ONE(NQZ)], Pu[ONE(N)][ONE(NU)];
    double A[ONE(NY)][ONE(NY)], LT[ONE(NY)][ONE(NY)], inverse[ONE(NY)];
    double row_scale[ONE(N)], h;
    double r[ONE(NY)], delta[ONE(NY)], y[ONE(NY)];
    double *w;
    long long *iw;
    int factored;
    long iterations, factorisations;
} Work;

static void work_free(Work *k) {
    YID_FREE(k->w);
    YID_FREE(k->iw);
    YID_FREE(k);
}

static Work *work_new(void) {
    Work *k = YID_ALLOCATE(1, sizeof(Work));
    if (!k) return NULL;
    k->w = YID_ALLOCATE(ONE(SZ_W), sizeof(double));
    k->iw = YID_ALLOCATE(ONE(SZ_IW), sizeof(long long));
    if (k->w && k->iw) return k;
    work_free(k);
    return NULL;
}

typedef struct {
    const double *q0, *p0, *z0, *u, *theta, *time_step;
    double *q1, *z1, *lam;
} Point;

static void arguments(const Point *a, const double *args[9]) {
    args[0] = a->q0; args[1] = a->q1; args[2] = a->p0; args[3] = a->z0; args[4] = a->z1;
    args[5] = a->lam; args[6] = a->u; args[7] = a->theta; args[8] = a->time_step;
}

/* What pulls at node k, kept for the whole step because it does not depend on the unknowns. */
static void constraint_matrix(Work *k, const Point *a) {
    if (M == 0) return;
    const double *args[9];
    double *res[1] = {k->matrix_nz};
    arguments(a, args);
    matrix(args, res, k->iw, k->w, 0);
    for (int e = 0; e < NNZ_MATRIX; e++) k->Phi[matrix_row[e]][matrix_col[e]] = k->matrix_nz[e];
}

/* Take the pull of multipliers, or of a change of them, off the balance. */
static void pull_by(Work *k, const double *lam) {
    for (int e = 0; e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e], c = matrix_row[e];
        k->balance[i] -= k->row_scale[i] * k->Phi[c][i] * lam[c];
    }
}

/* Take the multipliers' pull off p1, once all unknowns are known. */
static void finish(Work *k, const Point *a) {
    if (!MIDDLE || M == 0) return;
    const double *args[9];
    double *res[1] = {k->right_nz};
    arguments(a, args);
    ending(args, res, k->iw, k->w, 0);
    for (int e = 0; e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e];
        k->right_nz[e] = k->middle_nz[e] - k->right_nz[e];
        k->p1[i] -= k->row_scale[i] * k->right_nz[e] * a->lam[matrix_row[e]];
    }
}

/* Full rows of the balance (N), internal (NZ) and constraint (M) equations at the point; p1 on the way, but for what
 * `finish` adds. */
static int evaluate(Work *k, const Point *a) {
    const double *args[9];
    double *res[5] = {k->balance, k->internal, k->constraint, k->p1, k->middle_nz};
    arguments(a, args);
    residual(args, res, k->iw, k->w, 0);
    for (int e = 0; MIDDLE && e < NNZ_MATRIX; e++)
        k->Phi[matrix_row[e]][matrix_col[e]] = k->matrix_nz[e] + k->middle_nz[e];
    pull_by(k, a->lam);
    double sum = 0;
    for (int i = 0; i < NF; i++) sum += (k->r[i] = k->balance[free_index[i]]);
    for (int i = 0; i < NZ; i++) sum += (k->r[NF + i] = k->internal[i]);
    for (int i = 0; i < M; i++) sum += (k->r[NF + NZ + i] = k->constraint[i]);
    return isfinite(sum) ? OK : NOT_FINITE;
}

/* Jacobians of the rows and of p1; `everything` adds those with respect to q_k, z_k and u. */
static void linearise(Work *k, const Point *a, int everything) {
    const double *args[9];
    double *res[5] = {k->pairs, k->rest, k->rest_p, k->by_unknown, k->curve_nz};
    arguments(a, args);
    linear(args, res, k->iw, k->w, 0);
    const double *P = k->pairs, *D = P + 6 * N, *X = D + 6 * N, *Y = X + 6 * N, *W = Y + 6 * N, *G = W + 3 * N;
    memset(k->R1, 0, sizeof k->R1);
    if (everything) {
        memset(k->R0, 0, sizeof k->R0);
        memset(k->Ru, 0, sizeof k->Ru);
        memset(k->P1, 0, sizeof k->P1);
        memset(k->P0, 0, sizeof k->P0);
        memset(k->Pu, 0, sizeof k->Pu);
    }
    for (int j = 0; j < N; j++) {
        double x[6], y[6], g[3], low[ONE(N)], up[ONE(N)], here[ONE(N)], there[ONE(N)];
        for (int c = 0; c < 6; c++) { x[c] = X[c * N + j]; y[c] = Y[c * N + j]; }
        for (int c = 0; c < 3; c++) g[c] = G[c * N + j];
        for (int run = ancestor_start[j]; run < ancestor_start[j + 1]; run++) {
            const int first = ancestor_run[2 * run], last = ancestor_run[2 * run + 1];
            for (int i = first; i < last; i++) {
                double weight = W[i] * g[0] + W[N + i] * g[1] + W[2 * N + i] * g[2];
                double px = weight, dy = weight;
                for (int c = 0; c < 6; c++) {
                    px += P[c * N + i] * x[c];
                    dy -= D[c * N + i] * y[c];
                }
                low[i] = px;
                up[i] = dy;
            }
            if (everything)
                for (int i = first; i < last; i++) {
                    double weight = W[i] * g[0] + W[N + i] * g[1] + W[2 * N + i] * g[2];
                    double dx = weight, py = weight;
                    for (int c = 0; c < 6; c++) {
                        dx -= D[c * N + i] * x[c];
                        py += P[c * N + i] * y[c];
                    }
                    here[i] = dx;
                    there[i] = py;
                }
            for (int i = first; i < last; i++) {
                k->R1[j][i] = low[i];
                k->R1[i][j] = up[i];
            }
            if (everything)
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
            const double *A = P + 30 * N + j, *T = A + 6 * N;
            for (int run = ancestor_start[j]; run < ancestor_start[j + 1]; run++)
                for (int i = ancestor_run[2 * run]; i < ancestor_run[2 * run + 1]; i++) {
                    /* S.A, h/2 D.A and h/2 S.T, from S = (P + D)/2 and h/2 D = (P - D)/2 */
                    double sa = 0, da = 0, st = 0;
                    for (int c = 0; c < 6; c++) {
                        const double s = 0.5 * (P[c * N + i] + D[c * N + i]);
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
    for (int e = 0; e < NNZ_REST; e++) {
        const int column = rest_col[e];
        if (column < NT) k->R1[rest_row[e]][column] += k->rest[e];
        else if (everything && column < NT + NQZ) k->R0[rest_row[e]][column - NT] += k->rest[e];
        else if (everything) k->Ru[rest_row[e]][column - NT - NQZ] += k->rest[e];
    }
    for (int e = 0; e < NNZ_CONSTRAINT; e++) k->R1[N + NZ + constraint_row[e]][constraint_col[e]] += k->by_unknown[e];
    for (int c = 0; c < M; c++)
        for (int i = 0; i < N; i++) k->R1[i][N + NZ + c] -= k->row_scale[i] * k->Phi[c][i];
    for (int e = 0; e < NNZ_CURVE; e++) {
        const int i = curve_row[e], j = curve_col[e];
        const double bent = k->row_scale[i] * k->curve_nz[e];
        k->R1[i][j] -= bent;
        if (!everything) continue;
        k->R0[i][j] -= bent;
        k->P1[i][j] -= bent;
        k->P0[i][j] -= bent;
    }
    if (!everything) return;
    for (int e = 0; e < NNZ_REST_P; e++) {
        const int column = rest_p_col[e];
        if (column < NT) k->P1[rest_p_row[e]][column] += k->rest_p[e];
        else if (column < NT + NQZ) k->P0[rest_p_row[e]][column - NT] += k->rest_p[e];
        else k->Pu[rest_p_row[e]][column - NT - NQZ] += k->rest_p[e];
    }
    for (int e = 0; MIDDLE && e < NNZ_MATRIX; e++) {
        const int i = matrix_col[e];
        k->P1[i][N + NZ + matrix_row[e]] -= k->row_scale[i] * k->right_nz[e];
    }
    if (M > 0) {
        double *pulls[2] = {k->pull_nz, k->after_curve_nz};
        pull(args, pulls, k->iw, k->w, 0);
        for (int e = 0; e < NNZ_PULL; e++)
            k->R0[pull_row[e]][pull_col[e]] -= k->row_scale[pull_row[e]] * k->pull_nz[e];
        for (int e = 0; e < NNZ_AFTER_CURVE; e++)
            k->P1[after_curve_row[e]][after_curve_col[e]] += k->row_scale[after_curve_row[e]] * k->after_curve_nz[e];
    }
}

/* LU without pivoting in an order that eliminates tips before roots and multipliers last, so that the tree's sparsity
 * survives; the mass matrix over h keeps the pivots away from zero. */
static int factorise(Work *k) {
    k->factored = 0;
    for (int a = 0; a < NY; a++) {
        const double *row = k->R1[unknown_row[order[a]]];
        for (int b = 0; b < NY; b++) k->A[a][b] = row[unknown_row[order[b]]];
    }
    for (int p = 0; p < NY; p++) {
        const double pivot = k->A[p][p];
        if (!(fabs(pivot) > 1e-300) || !isfinite(pivot)) return SINGULAR;
        const double inverse = k->inverse[p] = 1.0 / pivot;
        const double *source = k->A[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                double *target = k->A[i];
                const double factor = target[p] * inverse;
                k->LT[p][i] = factor;
                if (factor == 0.0) continue;
                for (int cr = fill_start[p]; cr < fill_start[p + 1]; cr++) {
                    const int last = fill_run[2 * cr + 1];
#pragma omp simd
                    for (int c = fill_run[2 * cr]; c < last; c++) target[c] -= factor * source[c];
                }
            }
    }
    k->factored = 1;
    k->factorisations++;
    return OK;
}

static void solve(Work *k, const double *b, double *x) {
    double *y = k->y;
    for (int a = 0; a < NY; a++) y[a] = b[order[a]];
    for (int p = 0; p < NY; p++) {
        const double value = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
#pragma omp simd
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) y[i] -= k->LT[p][i] * value;
    }
    for (int p = NY - 1; p >= 0; p--) {
        double sum = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
#pragma omp simd reduction(- : sum)
            for (int c = fill_run[2 * rr]; c < fill_run[2 * rr + 1]; c++) sum -= k->A[p][c] * y[c];
        y[p] = sum * k->inverse[p];
    }
    for (int a = 0; a < NY; a++) x[order[a]] = y[a];
}

static void solve_transposed(Work *k, const double *b, double *x) {
    double *y = k->y;
    for (int a = 0; a < NY; a++) y[a] = b[order[a]];
    for (int p = 0; p < NY; p++) {
        const double value = y[p] *= k->inverse[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
#pragma omp simd
            for (int c = fill_run[2 * rr]; c < fill_run[2 * rr + 1]; c++) y[c] -= k->A[p][c] * value;
    }
    for (int p = NY - 1; p >= 0; p--) {
        double sum = y[p];
        for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
#pragma omp simd reduction(- : sum)
            for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) sum -= k->LT[p][i] * y[i];
        y[p] = sum;
    }
    for (int a = 0; a < NY; a++) x[order[a]] = y[a];
}

/* Sensitivities are worked on in blocks of columns that fit into registers. */
typedef double Lanes __attribute__((vector_size(64), aligned(8), may_alias));
#define BLOCK 16

/* Y <- A^-1 Y for d right-hand sides; rows of Y are already in elimination order. */
static void solve_many(Work *k, double *Y, int d) {
    Lanes B[ONE(NY)][2];
    memset(B, 0, sizeof B);
    for (int first = 0; first < d; first += BLOCK) {
        const size_t size = sizeof(double) * (size_t)(d - first < BLOCK ? d - first : BLOCK);
        for (int p = 0; p < NY; p++) memcpy(B[p], Y + (size_t)p * d + first, size);
        for (int p = 0; p < NY; p++) {
            const Lanes s0 = B[p][0], s1 = B[p][1];
            for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
                for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                    B[i][0] -= k->LT[p][i] * s0;
                    B[i][1] -= k->LT[p][i] * s1;
                }
        }
        for (int p = NY - 1; p >= 0; p--) {
            Lanes s0 = B[p][0], s1 = B[p][1];
            for (int rr = fill_start[p]; rr < fill_start[p + 1]; rr++)
                for (int i = fill_run[2 * rr]; i < fill_run[2 * rr + 1]; i++) {
                    s0 -= k->A[p][i] * B[i][0];
                    s1 -= k->A[p][i] * B[i][1];
                }
            B[p][0] = s0 * k->inverse[p];
            B[p][1] = s1 * k->inverse[p];
        }
        for (int p = 0; p < NY; p++) memcpy(Y + (size_t)p * d + first, B[p], size);
    }
}

static double coordinate_norm(const double *delta) {
    double norm = 0;
    for (int i = 0; i < NF + NZ; i++) {
        if (isnan(delta[i])) return NAN;
        norm = fmax(norm, fabs(delta[i]));
    }
    return norm;
}

static void advance(const Point *a, const double *delta, double factor) {
    for (int i = 0; i < NF; i++) a->q1[free_index[i]] += factor * delta[i];
    for (int i = 0; i < NZ; i++) a->z1[i] += factor * delta[NF + i];
    for (int i = 0; i < M; i++) a->lam[i] += factor * delta[NF + NZ + i];
}

/* Last correction of the multipliers, and of the balance, which gives the effort. */
static void settle_multipliers(Work *k, const Point *a, const double *delta) {
    const double *change = delta + NF + NZ;
    for (int c = 0; c < M; c++) a->lam[c] += change[c];
    if (NC) pull_by(k, change);
}

/* Simplified Newton with the factorisation at hand; refactorises where it contracts slowly. */
static int newton_chord(Work *k, const Point *a, double tolerance, int limit, double *error) {
    double previous = INFINITY;
    int refactor = !k->factored, fresh = 0;
    for (int it = 0; it < limit; it++) {
        k->iterations++;
        if (evaluate(k, a)) return NOT_FINITE;
        if (refactor) {
            linearise(k, a, 0);
            if (factorise(k)) return SINGULAR;
            fresh = 1;
            refactor = 0;
        }
        for (int i = 0; i < NY; i++) k->r[i] = -k->r[i];
        solve(k, k->r, k->delta);
        const double norm = *error = coordinate_norm(k->delta);
        if (!isfinite(norm)) return NOT_FINITE;
        const double rate = norm / previous;
        if (norm <= tolerance || (norm < 1e3 * tolerance && rate > 0.5)) {
            settle_multipliers(k, a, k->delta);
            return OK;
        }
        if (it > 0 && rate > 0.9 && fresh) return NOT_CONVERGED;
        if (it > 0 && rate > 0.1) refactor = 1, fresh = 0;
        if (norm > 1.0) return NOT_CONVERGED;
        advance(a, k->delta, 1.0);
        previous = norm;
    }
    return NOT_CONVERGED;
}

/* Full Newton, damped by the natural monotonicity test (Deuflhard 2011, section 3.3). */
static int newton_damped(Work *k, const Point *a, double tolerance, int limit, double *error) {
    double q_keep[ONE(N)], z_keep[ONE(NZ)], lam_keep[ONE(M)], step[ONE(NY)], trial[ONE(NY)], previous = INFINITY;
    for (int it = 0; it < limit; it++) {
        k->iterations++;
        if (evaluate(k, a)) return NOT_FINITE;
        linearise(k, a, 0);
        if (factorise(k)) return SINGULAR;
        for (int i = 0; i < NY; i++) k->r[i] = -k->r[i];
        solve(k, k->r, step);
        const double norm = *error = coordinate_norm(step);
        if (!isfinite(norm)) return NOT_FINITE;
        if (norm <= tolerance || (norm < 1e3 * tolerance && norm > 0.5 * previous)) {
            settle_multipliers(k, a, step);
            return OK;
        }
        previous = norm;
        memcpy(q_keep, a->q1, sizeof(double) * N);
        memcpy(z_keep, a->z1, sizeof(double) * NZ);
        memcpy(lam_keep, a->lam, sizeof(double) * M);
        double factor = norm > 0.5 ? 0.5 / norm : 1.0;
        for (;;) {
            advance(a, step, factor);
            if (!evaluate(k, a)) {
                for (int i = 0; i < NY; i++) k->r[i] = -k->r[i];
                solve(k, k->r, trial);
                const double size = coordinate_norm(trial);
                if (isfinite(size) && size <= (1.0 - 0.25 * factor) * norm) break;
            }
            if (factor < 1e-4) return NOT_CONVERGED;
            memcpy(a->q1, q_keep, sizeof(double) * N);
            memcpy(a->z1, z_keep, sizeof(double) * NZ);
            memcpy(a->lam, lam_keep, sizeof(double) * M);
            factor *= 0.5;
        }
    }
    return NOT_CONVERGED;
}

/* One step from the guess in q1 (prescribed entries already exact), z1, lam. */
static int one_step(Work *k, const Point *a, double tolerance, int limit, double *error) {
    *error = 0;
    constraint_matrix(k, a);
    if (NY == 0) {
        const int status = evaluate(k, a);
        finish(k, a);
        return status;
    }
    double q_guess[ONE(N)], z_guess[ONE(NZ)], lam_guess[ONE(M)];
    memcpy(q_guess, a->q1, sizeof(double) * N);
    memcpy(z_guess, a->z1, sizeof(double) * NZ);
    memcpy(lam_guess, a->lam, sizeof(double) * M);
    int status = newton_chord(k, a, tolerance, 20, error);
    for (int attempt = 0; status && attempt < 2; attempt++) {
        for (int i = 0; i < N; i++) a->q1[i] = q_guess[i];
        if (attempt)
            for (int i = 0; i < NF; i++) a->q1[free_index[i]] = a->q0[free_index[i]];
        for (int i = 0; i < NZ; i++) a->z1[i] = attempt ? a->z0[i] : z_guess[i];
        for (int i = 0; i < M; i++) a->lam[i] = attempt ? 0.0 : lam_guess[i];
        status = newton_damped(k, a, tolerance, limit, error);
    }
    if (status) k->factored = 0;
    else finish(k, a);
    return status;
}

static void prepare(Work *k, const double *theta, const double *time_step) {
    double none[ONE(NX)] = {0};
    Point a = {none, none, none, none, theta, time_step, none, none, none};
    const double *args[9];
    double *res[2] = {k->row_scale, &k->h};
    arguments(&a, args);
    scales(args, res, k->iw, k->w, 0);
}

/* C[rows] += A X for the listed nonzero columns of each row; A has `width` columns, X has d, and room for BLOCK entries
 * after its last one, which are read but not used. */
static void multiply_rows(const double *A, int width, const int *start, const int *column, int rows, const double *X,
                          int d, double *C) {
    for (int first = 0; first < d; first += BLOCK) {
        const int wide = d - first < BLOCK ? d - first : BLOCK;
        for (int r = 0; r < rows; r++) {
            Lanes sum[2] = {{0}, {0}};
            for (int e = start[r]; e < start[r + 1]; e++) {
                const double factor = A[(size_t)r * width + column[e]];
                const Lanes *source = (const Lanes *)(X + (size_t)column[e] * d + first);
                sum[0] += factor * source[0];
                sum[1] += factor * source[1];
            }
            double *target = C + (size_t)r * d + first;
            for (int c = 0; c < wide; c++) target[c] += ((const double *)sum)[c];
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
 * (steps + 1, NC) and Newton's tolerance and limit matter to a rollout and, as those of one node, to a rest. */
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

/* The step reached, Newton's last correction, totals of iterations and factorisations, and the memory that was asked
 * for [bytes]. */
typedef struct {
    int step;
    double error;
    long long iterations, factorisations, memory;
} Outcome;

static void add_sparse(const double *nz, const long long *pattern, double *C, int d) {
    const long long columns = pattern[1], *offset = pattern + 2, *row = pattern + 3 + columns;
    for (long long c = 0; c < columns; c++)
        for (long long e = offset[c]; e < offset[c + 1]; e++) C[(size_t)row[e] * d + c] += nz[e];
}

static void theta_columns(const Directions *dir, const Point *a) {
    const double *args[9];
    double *res[3] = {dir->rows_nz, dir->p1_nz, dir->effort_nz};
    arguments(a, args);
    dir->by_theta(args, res, dir->iw, dir->w, 0);
}

/* Columns of one step, each (rows, d): of the state before (NX) and after, the input (NU) or NULL, the prescribed
 * coordinates after (NC) or NULL, multipliers and effort or NULL; then room for rows (NT), joined (NT), Y (NY), input
 * (NU) and start (NQZ). The last `loads` columns get more of the rows (NT, loads) and of p1 (N, loads). */
typedef struct {
    const double *before, *input, *path;
    double *after, *multipliers, *effort;
    double *rows, *joined, *Y, *input_room, *start;
    int loads;
    const double *load_rows, *load_p1;
} Columns;

/* Forward sensitivities of one converged step. */
static void sensitivity_step(Work *k, const Point *a, const Directions *dir, const Columns *columns) {
    const int d = dir->count;
    const double *X0 = columns->before, *input = columns->input, *path = columns->path;
    double *X1 = columns->after, *effort = columns->effort, *rows = columns->rows, *joined = columns->joined;
    double *Y = columns->Y, *start = columns->start;
    /* (q, z) of X0 side by side */
    memcpy(start, X0, sizeof(double) * N * d);
    memcpy(start + (size_t)N * d, X0 + (size_t)2 * N * d, sizeof(double) * NZ * d);
    memset(rows, 0, sizeof(double) * NT * d);
    multiply_rows(&k->R0[0][0], ONE(NQZ), rows_old_start, rows_old_col, NT, start, d, rows);
    for (int i = 0; i < N * d; i++) rows[i] += X0[(size_t)N * d + i];
    double *p1 = X1 + (size_t)N * d;
    memset(p1, 0, sizeof(double) * N * d);
    if (dir->theta_count) {
        theta_columns(dir, a);
        add_sparse(dir->rows_nz, dir->rows_pattern, rows, d);
        add_sparse(dir->p1_nz, dir->p1_pattern, p1, d);
    }
    const int loads = columns->loads, loaded = d - loads;
    for (int r = 0; r < NT; r++)
        for (int c = 0; c < loads; c++) rows[(size_t)r * d + loaded + c] += columns->load_rows[(size_t)r * loads + c];
    for (int r = 0; r < N; r++)
        for (int c = 0; c < loads; c++) p1[(size_t)r * d + loaded + c] += columns->load_p1[(size_t)r * loads + c];
    if (input)
        /* internal coordinates may follow an input too, as play behind a servo does */
        for (int r = 0; r < N + NZ; r++)
            for (int j = 0; j < NU; j++) {
                const double f = k->Ru[r][j], g = r < N ? k->Pu[r][j] : 0.0;
                for (int c = 0; f != 0.0 && c < d; c++) rows[(size_t)r * d + c] += f * input[(size_t)j * d + c];
                for (int c = 0; g != 0.0 && c < d; c++) p1[(size_t)r * d + c] += g * input[(size_t)j * d + c];
            }
    memset(joined, 0, sizeof(double) * NT * d);
    if (path)
        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            memcpy(joined + (size_t)at * d, path + (size_t)j * d, sizeof(double) * d);
            for (int r = 0; r < NT; r++) {
                const double f = k->R1[r][at];
                for (int c = 0; f != 0.0 && c < d; c++) rows[(size_t)r * d + c] += f * path[(size_t)j * d + c];
            }
        }
    for (int b = 0; b < NY; b++) {
        const double *source = rows + (size_t)unknown_row[order[b]] * d;
        for (int c = 0; c < d; c++) Y[(size_t)b * d + c] = -source[c];
    }
    solve_many(k, Y, d);
    for (int b = 0; b < NY; b++)
        memcpy(joined + (size_t)unknown_row[order[b]] * d, Y + (size_t)b * d, sizeof(double) * d);
    memcpy(X1, joined, sizeof(double) * N * d);
    memcpy(X1 + (size_t)2 * N * d, joined + (size_t)N * d, sizeof(double) * NZ * d);
    if (columns->multipliers) memcpy(columns->multipliers, joined + (size_t)(N + NZ) * d, sizeof(double) * M * d);
    multiply_rows(&k->P0[0][0], ONE(NQZ), p1_old_start, p1_old_col, N, start, d, p1);
    multiply_rows(&k->P1[0][0], ONE(NT), p1_new_start, p1_new_col, N, joined, d, p1);
    if (effort) {
        memset(effort, 0, sizeof(double) * NC * d);
        if (dir->theta_count) add_sparse(dir->effort_nz, dir->effort_pattern, effort, d);

        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            double *target = effort + (size_t)j * d;
            for (int c = 0; c < d; c++) {
                double sum = X0[(size_t)(N + at) * d + c];
                for (int i = 0; i < NQZ; i++) sum += k->R0[at][i] * start[(size_t)i * d + c];
                for (int i = 0; i < NT; i++) sum += k->R1[at][i] * joined[(size_t)i * d + c];
                if (input)
                    for (int i = 0; i < NU; i++) sum += k->Ru[at][i] * input[(size_t)i * d + c];
                if (c >= loaded) sum += columns->load_rows[(size_t)at * loads + c - loaded];
                target[c] -= sum / k->h;
            }
        }
    }
}

static void effort_of(const Work *k, double *effort) {
    for (int j = 0; j < NC; j++) effort[j] = -k->balance[prescribed_index[j]] / k->h;
}

static void apply_feedback(const Feedback *f, int step, const double *state, const double *nominal, double *u) {
    for (int i = 0; i < NU; i++) {
        double value = nominal[i];
        for (int j = 0; j < f->count; j++)
            value -= f->gain[((size_t)step * NU + i) * f->count + j] *
                     (state[f->index[j]] - f->reference[(size_t)step * f->count + j]);
        u[i] = value;
    }
}

/* Columns of the torque of one step: those of the nominal one (or NULL) less what the feedback makes of the state's.
 * NULL where neither is there. */
static const double *input_columns(const Feedback *f, int step, int d, const double *given, const double *state,
                                   double *room) {
    const int feeds = f && f->count > 0;
    if (!NU || !(feeds || given)) return NULL;
    if (given) memcpy(room, given, sizeof(double) * NU * d);
    else memset(room, 0, sizeof(double) * NU * d);
    for (int i = 0; feeds && i < NU; i++)
        for (int j = 0; j < f->count; j++) {
            const double gain = f->gain[((size_t)step * NU + i) * f->count + j];
            const double *source = state + (size_t)f->index[j] * d;
            for (int c = 0; gain != 0.0 && c < d; c++) room[(size_t)i * d + c] -= gain * source[c];
        }
    return room;
}

/* Where a step from the last of the states x is looked for first: q and z extrapolated, prescribed entries known. */
static void guess(const double *x, int step, const double *prescribed, double *q1, double *z1) {
    for (int i = 0; i < N; i++) {
        q1[i] = x[i];
        if (step > 1) q1[i] = 3 * (x[i] - x[i - NX]) + x[i - 2 * NX];
        else if (step == 1) q1[i] = 2 * x[i] - x[i - NX];
    }
    for (int i = 0; i < NZ; i++) z1[i] = step > 0 ? 2 * x[2 * N + i] - x[2 * N + i - NX] : x[2 * N + i];
    for (int j = 0; j < NC; j++) q1[prescribed_index[j]] = prescribed[j];
}

/* Room for one step's work and `doubles` more; 0 where there is not so much memory. */
static int room_for(size_t doubles, Work **k, double **buffer, Outcome *outcome) {
    memset(outcome, 0, sizeof *outcome);
    outcome->memory = (long long)(sizeof(Work) + sizeof(double) * (SZ_W + doubles) + sizeof(long long) * SZ_IW);
    *k = work_new();
    *buffer = *k && doubles ? YID_ALLOCATE(doubles, sizeof(double)) : NULL;
    if (*k && (*buffer || !doubles)) return 1;
    if (*k) work_free(*k);
    return 0;
}

/* Rollout, with forward sensitivities where there are directions; a status. */
int yid_rollout(const Motion *motion, const Trajectory *out, const Sensitivities *by, Outcome *outcome) {
    const Directions *dir = motion->directions;
    const Feedback *feedback = motion->feedback;
    const size_t d = dir ? dir->count : 0;
    Work *k;
    double *buffer;
    if (!room_for(d ? d * (2 * ONE(NT) + ONE(NY) + ONE(NU) + ONE(NQZ)) + BLOCK : 0, &k, &buffer, outcome))
        return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    Columns columns = {0};
    if (d) {
        columns.rows = buffer;
        columns.joined = columns.rows + d * ONE(NT);
        columns.Y = columns.joined + d * ONE(NT);
        columns.input_room = columns.Y + d * ONE(NY);
        columns.start = columns.input_room + d * ONE(NU);
    }
    double q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], u[ONE(NU)];
    memset(lam, 0, sizeof lam);
    int status = OK, step = 0;
    double error = 0;
    for (; step < motion->steps; step++) {
        const double *x = out->state + (size_t)step * NX;
        double *next = out->state + (size_t)(step + 1) * NX;
        if (NU) {
            const double *nominal = motion->torque + (size_t)step * NU;
            memcpy(u, nominal, sizeof(double) * NU);
            if (feedback && feedback->count > 0) apply_feedback(feedback, step, x, nominal, u);
            memcpy(out->applied + (size_t)step * NU, u, sizeof(double) * NU);
        }
        guess(x, step, motion->path + (size_t)(step + 1) * NC, q1, z1);
        Point a = {x, x + N, x + 2 * N, u, motion->theta, &motion->time_step, q1, z1, lam};
        status = one_step(k, &a, motion->tolerance, motion->limit, &error);
        memcpy(next, q1, sizeof(double) * N);
        memcpy(next + N, k->p1, sizeof(double) * N);
        memcpy(next + 2 * N, z1, sizeof(double) * NZ);
        if (status) break;
        memcpy(out->multipliers + (size_t)step * M, lam, sizeof(double) * M);
        effort_of(k, out->effort + (size_t)step * NC);
        if (d) {
            linearise(k, &a, 1);
            if (NY && (status = factorise(k))) break;
            columns.before = by->state + (size_t)step * NX * d;
            columns.after = by->state + (size_t)(step + 1) * NX * d;
            columns.input = input_columns(feedback, step, (int)d, by->torque ? by->torque + (size_t)step * NU * d : NULL,
                                          columns.before, columns.input_room);
            columns.path = by->path ? by->path + (size_t)(step + 1) * NC * d : NULL;
            columns.multipliers = by->multipliers + (size_t)step * M * d;
            columns.effort = by->effort + (size_t)step * NC * d;
            sensitivity_step(k, &a, dir, &columns);
        }
    }
    outcome->step = step;
    outcome->error = error;
    outcome->iterations = k->iterations;
    outcome->factorisations = k->factorisations;
    YID_FREE(buffer);
    work_free(k);
    return status;
}

/* What a step ends with, copied because a step may write it; and the torque where there is none. */
typedef struct {
    double q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], none[ONE(NU)];
} Ends;

/* One step of a trajectory that is given. */
static Point recorded_step(const Motion *motion, const Trajectory *along, int step, Ends *ends) {
    const double *x = along->state + (size_t)step * NX, *next = x + NX;
    const double *u = NU ? along->applied + (size_t)step * NU : ends->none;
    memcpy(ends->q1, next, sizeof(double) * N);
    memcpy(ends->z1, next + 2 * N, sizeof(double) * NZ);
    memcpy(ends->lam, along->multipliers + (size_t)step * M, sizeof(double) * M);
    const Point a = {x, x + N, x + 2 * N, u, motion->theta, &motion->time_step, ends->q1, ends->z1, ends->lam};
    return a;
}

/* Gradient of a cost along a finished rollout, step by step from its end; a status. */
int yid_adjoint(const Motion *motion, const Trajectory *rollout, const Partials *by, const Gradient *gradient,
                Outcome *outcome) {
    const Directions *dir = motion->directions;
    const Feedback *feedback = motion->feedback;
    const int steps = motion->steps, feeds = feedback && feedback->count > 0, thetas = dir ? dir->theta_count : 0;
    Work *k;
    double *buffer;
    if (!room_for(0, &k, &buffer, outcome)) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    double costate[ONE(NX)], g[ONE(NY)], nu[ONE(NY)], full[ONE(NT)], mu[ONE(NX)], mu_u[ONE(NU)];
    Ends ends = {0};
    memset(gradient->theta, 0, sizeof(double) * thetas);
    memcpy(costate, by->state + (size_t)steps * NX, sizeof(double) * NX);
    int status = OK, step = steps - 1;
    for (; step >= 0; step--) {
        const Point a = recorded_step(motion, rollout, step, &ends);
        constraint_matrix(k, &a);
        if (MIDDLE) {
            evaluate(k, &a);
            finish(k, &a);
        }
        linearise(k, &a, 1);
        if (NY && (status = factorise(k))) break;
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
            theta_columns(dir, &a);
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
    work_free(k);
    return status;
}

/* Rows, p1 and their Jacobians at the steps of a trajectory that need not satisfy the equations (a transcription's
 * iterate); a status. */
int yid_linearize(const Motion *motion, const Trajectory *along, const Linearization *out, Outcome *outcome) {
    const Directions *dir = motion->directions;
    Work *k;
    double *buffer;
    if (!room_for(0, &k, &buffer, outcome)) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    Ends ends = {0};
    for (int step = 0; step < motion->steps; step++) {
        const Point a = recorded_step(motion, along, step, &ends);
        constraint_matrix(k, &a);
        evaluate(k, &a);
        finish(k, &a);
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
        if (NU) {
            memcpy(out->rows_input + (size_t)step * NT * NU, k->Ru, sizeof(double) * NT * NU);
            memcpy(out->p1_input + (size_t)step * N * NU, k->Pu, sizeof(double) * N * NU);
        }
        if (dir && dir->theta_count) {
            const int d = dir->count;
            theta_columns(dir, &a);
            add_sparse(dir->rows_nz, dir->rows_pattern, out->rows_theta + (size_t)step * NT * d, d);
            add_sparse(dir->p1_nz, dir->p1_pattern, out->p1_theta + (size_t)step * N * d, d);
        }
    }
    work_free(k);
    return OK;
}

/* State (steps, NX, d) and effort (steps, NC, d) after single steps of a finished rollout by the state before, the torque
 * and further loads, d = NX + NU + loads columns; the loads add to the rows (NT, loads) and to p1 (N, loads) of every step
 * alike. A status. */
int yid_slopes(const Motion *motion, const Trajectory *along, int loads, const double *load_rows, const double *load_p1,
               double *state, double *effort, Outcome *outcome) {
    const size_t d = NX + NU + (size_t)loads;
    const Directions dir = {.count = (int)d};
    Work *k;
    double *buffer;
    if (!room_for(d * (2 * ONE(NT) + ONE(NY) + ONE(NU) + ONE(NQZ) + ONE(NX)) + BLOCK, &k, &buffer, outcome))
        return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    double *before = buffer, *input = before + d * ONE(NX);
    Columns columns = {.before = before, .input = NU ? input : NULL, .loads = loads};
    columns.load_rows = load_rows;
    columns.load_p1 = load_p1;
    columns.rows = input + d * ONE(NU);
    columns.joined = columns.rows + d * ONE(NT);
    columns.Y = columns.joined + d * ONE(NT);
    columns.start = columns.Y + d * ONE(NY);
    for (int i = 0; i < NX; i++) before[i * d + i] = 1.0;
    for (int i = 0; i < NU; i++) input[i * d + NX + i] = 1.0;
    Ends ends = {0};
    int status = OK, step = 0;
    for (; step < motion->steps; step++) {
        const Point a = recorded_step(motion, along, step, &ends);
        constraint_matrix(k, &a);
        evaluate(k, &a);
        finish(k, &a);
        linearise(k, &a, 1);
        if (NY && (status = factorise(k))) break;
        columns.after = state + (size_t)step * NX * d;
        columns.effort = effort + (size_t)step * NC * d;
        sensitivity_step(k, &a, &dir, &columns);
    }
    outcome->step = step;
    YID_FREE(buffer);
    work_free(k);
    return status;
}

/* What a rest works on: its equations are those of a step from q to q, with p such that it comes out again. */
typedef struct {
    double x[ONE(NX)], q[ONE(N)], z[ONE(NZ)], lam[ONE(M)], u[ONE(NU)];
    double inner[ONE(NZ)], slopes_nz[ONE(NNZ_RESTING)], full[ONE(NT)][ONE(NT)];
    int pivot[ONE(NY)];
} Resting;

/* Put unknowns (free coordinates, internal ones, forces of the constraints) in their places; a point of the step. */
static Point rest_point(const Work *k, Resting *s, const Motion *motion, const double *w) {
    for (int i = 0; i < NF; i++) s->q[free_index[i]] = w[i];
    for (int i = 0; i < NC; i++) s->q[prescribed_index[i]] = motion->path[i];
    for (int i = 0; i < NZ; i++) s->z[i] = w[NF + i];
    for (int i = 0; i < M; i++) s->lam[i] = k->h * w[NF + NZ + i];
    memcpy(s->x, s->q, sizeof(double) * N);
    memset(s->x + N, 0, sizeof(double) * N);
    if (NU) {
        memcpy(s->u, motion->torque, sizeof(double) * NU);
        if (motion->feedback) apply_feedback(motion->feedback, 0, s->x, motion->torque, s->u);
    }
    const Point a = {s->x, s->x + N, s->z, s->u, motion->theta, &motion->time_step, s->q, s->z, s->lam};
    return a;
}

/* Imbalance of the free coordinates [N m], internal equations at rest, constraints; returns the largest, or NaN. */
static double rest_rows(Work *k, Resting *s, const Point *a, double *r) {
    const double *args[9];
    double *res[2] = {s->inner, s->slopes_nz};
    double largest = 0;
    constraint_matrix(k, a);
    evaluate(k, a);
    finish(k, a);
    for (int i = 0; i < NF; i++) r[i] = (k->balance[free_index[i]] + k->p1[free_index[i]]) / k->h;
    for (int i = 0; i < M; i++) r[NF + NZ + i] = k->constraint[i];
    if (NZ) {
        arguments(a, args);
        resting(args, res, k->iw, k->w, 0);
        memcpy(r + NF, s->inner, sizeof(double) * NZ);
    }
    for (int i = 0; i < NY; i++) {
        if (!isfinite(r[i])) return NAN;
        largest = fmax(largest, fabs(r[i]));
    }
    return largest;
}

/* Slopes of `rest_rows` at the point of its last call, into k->A. */
static void rest_slopes(Work *k, Resting *s, const Point *a, const Feedback *hold) {
    linearise(k, a, 1);
    for (int i = 0; i < NT; i++) {
        double *row = s->full[i];
        const int inner = i >= N && i < N + NZ;
        memset(row, 0, sizeof(double) * NT);
        if (inner) continue;
        for (int j = 0; j < NT; j++) row[j] = k->R1[i][j];
        for (int j = 0; j < NQZ; j++) row[j] += k->R0[i][j];
        if (i < N) {
            for (int j = 0; j < NT; j++) row[j] += k->P1[i][j];
            for (int j = 0; j < NQZ; j++) row[j] += k->P0[i][j];
            for (int v = 0; hold && v < NU; v++)
                for (int c = 0; c < hold->count; c++)
                    row[hold->index[c]] -= (k->Ru[i][v] + k->Pu[i][v]) * hold->gain[v * hold->count + c];
            for (int j = 0; j < NQZ; j++) row[j] /= k->h;
        } else
            for (int j = NQZ; j < NT; j++) row[j] *= k->h;
    }
    for (int e = 0; e < NNZ_RESTING; e++) {
        double *row = s->full[N + resting_row[e]];
        const int column = resting_col[e], input = column - NT;
        if (column < NT) row[column] += s->slopes_nz[e] * (column < NQZ ? 1.0 : k->h);
        for (int c = 0; hold && input >= 0 && c < hold->count; c++)
            row[hold->index[c]] -= s->slopes_nz[e] * hold->gain[input * hold->count + c];
    }
    for (int b = 0; b < NY; b++)
        for (int c = 0; c < NY; c++) k->A[b][c] = s->full[unknown_row[b]][unknown_row[c]];
}

/* LU of k->A with partial pivoting: forces of constraints have no diagonal, and an equilibrium may be unstable. */
static int factorise_pivoted(Work *k, int *pivot) {
    for (int p = 0; p < NY; p++) {
        int best = p;
        for (int i = p + 1; i < NY; i++)
            if (fabs(k->A[i][p]) > fabs(k->A[best][p])) best = i;
        pivot[p] = best;
        if (!(fabs(k->A[best][p]) > 0) || !isfinite(k->A[best][p])) return SINGULAR;
        for (int c = 0; best != p && c < NY; c++) {
            const double kept = k->A[p][c];
            k->A[p][c] = k->A[best][c];
            k->A[best][c] = kept;
        }
        const double inverse = k->inverse[p] = 1.0 / k->A[p][p];
        const double *source = k->A[p];
        for (int i = p + 1; i < NY; i++) {
            double *target = k->A[i];
            const double factor = target[p] *= inverse;
            if (factor == 0.0) continue;
#pragma omp simd
            for (int c = p + 1; c < NY; c++) target[c] -= factor * source[c];
        }
    }
    return OK;
}

/* x = -A^-1 b; the largest of x in parts of max(|w|, 1), or NaN. */
static double rest_change(const Work *k, const int *pivot, const double *b, const double *w, double *x) {
    double size = 0;
    for (int i = 0; i < NY; i++) x[i] = -b[i];
    for (int p = 0; p < NY; p++) {
        const double value = x[pivot[p]];
        x[pivot[p]] = x[p];
        x[p] = value;
    }
    for (int p = 0; p < NY; p++)
        for (int i = p + 1; i < NY; i++) x[i] -= k->A[i][p] * x[p];
    for (int p = NY - 1; p >= 0; p--) {
        double sum = x[p];
        for (int c = p + 1; c < NY; c++) sum -= k->A[p][c] * x[c];
        x[p] = sum * k->inverse[p];
    }
    for (int i = 0; i < NY; i++) {
        if (!isfinite(x[i])) return NAN;
        size = fmax(size, fabs(x[i]) / fmax(fabs(w[i]), 1.0));
    }
    return size;
}

static int rest_search(Work *k, Resting *s, const Motion *motion, double *w, double *error) {
    const double tolerance = motion->tolerance;
    double r[ONE(NY)], delta[ONE(NY)], trial[ONE(NY)], further[ONE(NY)];
    Point a = rest_point(k, s, motion, w);
    *error = rest_rows(k, s, &a, r);
    for (int it = 0; it < motion->limit; it++) {
        if (isnan(*error)) return NOT_FINITE;
        if (*error <= tolerance) return OK;
        k->iterations++;
        rest_slopes(k, s, &a, motion->feedback);
        if (factorise_pivoted(k, s->pivot)) return SINGULAR;
        const double size = rest_change(k, s->pivot, r, w, delta);
        if (isnan(size)) return NOT_FINITE;
        for (double factor = fmin(1.0, 0.3 / size);; factor *= 0.5) {
            if (factor < 1e-6) return *error < 1e2 * tolerance ? OK : NOT_CONVERGED;
            for (int i = 0; i < NY; i++) trial[i] = w[i] + factor * delta[i];
            a = rest_point(k, s, motion, trial);
            const double left = rest_rows(k, s, &a, r);
            if (isnan(left)) continue;
            const double enough = 1.0 - factor / 4;
            if (left > enough * *error && !(rest_change(k, s->pivot, r, w, further) <= enough * size)) continue;
            *error = left;
            break;
        }
        memcpy(w, trial, sizeof trial);
    }
    return *error <= tolerance ? OK : NOT_CONVERGED;
}

/* Search a static equilibrium from the unknowns w, which are overwritten, where prescribed coordinates are at the path's
 * first node, and torques follow the first step's feedback; a status. Newton with step control: the natural monotonicity
 * test (Deuflhard 2011, section 3.3) or a smaller residual. */
int yid_rest(const Motion *motion, double *w, Outcome *outcome) {
    Work *k;
    double *buffer;
    if (!room_for((sizeof(Resting) + sizeof(double) - 1) / sizeof(double), &k, &buffer, outcome)) return OUT_OF_MEMORY;
    prepare(k, motion->theta, &motion->time_step);
    const int status = rest_search(k, (Resting *)buffer, motion, w, &outcome->error);
    outcome->iterations = k->iterations;
    YID_FREE(buffer);
    work_free(k);
    return status;
}
