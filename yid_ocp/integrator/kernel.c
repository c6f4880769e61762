/* Time stepping of one system: Newton with a kept factorisation, rollout with forward sensitivities, adjoint sweep.
 *
 * The generated part before this text defines the sizes (N, NZ, M, NU, NC, NF, NY, NT, NTHETA), the index tables and the
 * CasADi functions residual, linear, matrix, pull and scales; see codegen.py. All matrices are row-major.
 *   N coordinates, NZ internal ones, M constraints, NU inputs, NC prescribed and NF free coordinates,
 *   NT = N + NZ + M rows, NY = NF + NZ + M unknowns of a step, NX = 2 N + NZ state (q, p, z).
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NX (2 * N + NZ)
#define NQZ (N + NZ)
#define ONE(x) ((x) > 0 ? (x) : 1)

enum { OK = 0, NOT_CONVERGED = 1, SINGULAR = 2, NOT_FINITE = 3 };

typedef int (*theta_function)(const double **, double **, long long *, double *, int);

typedef struct {
    double balance[ONE(N)], internal[ONE(NZ)], constraint[ONE(M)], p1[ONE(N)];
    double pairs[(30 + 12 * CLOSED) * ONE(N)];
    double rest[ONE(NNZ_REST)], rest_p[ONE(NNZ_REST_P)], by_unknown[ONE(NNZ_CONSTRAINT)];
    double matrix_nz[ONE(NNZ_MATRIX)], pull_nz[ONE(NNZ_PULL)];
    double Phi[ONE(M)][ONE(N)];
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
    free(k->w);
    free(k->iw);
    free(k);
}

static Work *work_new(void) {
    Work *k = calloc(1, sizeof(Work));
    if (!k) return NULL;
    k->w = malloc(sizeof(double) * ONE(SZ_W));
    k->iw = malloc(sizeof(long long) * ONE(SZ_IW));
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

/* Dphi(q_k), kept for the whole step because it does not depend on the unknowns. */
static void constraint_matrix(Work *k, const Point *a) {
    if (M == 0) return;
    const double *args[9];
    double *res[1] = {k->matrix_nz};
    arguments(a, args);
    matrix(args, res, k->iw, k->w, 0);
    for (int e = 0; e < NNZ_MATRIX; e++) k->Phi[matrix_row[e]][matrix_col[e]] = k->matrix_nz[e];
}

/* Full rows of the balance (N), internal (NZ) and constraint (M) equations at the point; p1 on the way. */
static int evaluate(Work *k, const Point *a) {
    const double *args[9];
    double *res[4] = {k->balance, k->internal, k->constraint, k->p1};
    arguments(a, args);
    residual(args, res, k->iw, k->w, 0);
    for (int c = 0; c < M; c++) {
        double force = a->lam[c];
        for (int i = 0; i < N; i++) k->balance[i] -= k->row_scale[i] * k->Phi[c][i] * force;
    }
    double sum = 0;
    for (int i = 0; i < NF; i++) sum += (k->r[i] = k->balance[free_index[i]]);
    for (int i = 0; i < NZ; i++) sum += (k->r[NF + i] = k->internal[i]);
    for (int i = 0; i < M; i++) sum += (k->r[NF + NZ + i] = k->constraint[i]);
    return isfinite(sum) ? OK : NOT_FINITE;
}

/* Jacobians of the rows and of p1; `everything` adds those with respect to q_k, z_k and u. */
static void linearise(Work *k, const Point *a, int everything) {
    const double *args[9];
    double *res[4] = {k->pairs, k->rest, k->rest_p, k->by_unknown};
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
    if (!everything) return;
    for (int e = 0; e < NNZ_REST_P; e++) {
        const int column = rest_p_col[e];
        if (column < NT) k->P1[rest_p_row[e]][column] += k->rest_p[e];
        else if (column < NT + NQZ) k->P0[rest_p_row[e]][column - NT] += k->rest_p[e];
        else k->Pu[rest_p_row[e]][column - NT - NQZ] += k->rest_p[e];
    }
    if (M > 0) {
        double *pulls[1] = {k->pull_nz};
        pull(args, pulls, k->iw, k->w, 0);
        for (int e = 0; e < NNZ_PULL; e++)
            k->R0[pull_row[e]][pull_col[e]] -= k->row_scale[pull_row[e]] * k->pull_nz[e];
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

/* Last correction of the multipliers, and of the balance at prescribed coordinates, which gives the effort. */
static void settle_multipliers(Work *k, const Point *a, const double *delta) {
    for (int c = 0; c < M; c++) {
        const double change = delta[NF + NZ + c];
        a->lam[c] += change;
        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            k->balance[at] -= k->row_scale[at] * k->Phi[c][at] * change;
        }
    }
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
    if (NY == 0) return evaluate(k, a);
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

static void add_sparse(const double *nz, const long long *pattern, int first, int rows, double *C, int d) {
    /* CasADi's compressed columns: rows, columns, column offsets, row indices. */
    const long long columns = pattern[1], *offset = pattern + 2, *row = pattern + 3 + columns;
    if (pattern[0] != rows) return;
    for (long long c = 0; c < columns; c++)
        for (long long e = offset[c]; e < offset[c + 1]; e++) C[(size_t)(first + row[e]) * d + c] += nz[e];
}

typedef struct {
    int count;                       /* sensitivity directions; the first `theta_count` are parameters */
    int theta_count;
    theta_function by_theta;
    const long long *rows_pattern, *p1_pattern, *effort_pattern;
    double *rows_nz, *p1_nz, *effort_nz, *w;
    long long *iw;
} Directions;

static void theta_columns(const Directions *dir, const Point *a) {
    const double *args[9];
    double *res[3] = {dir->rows_nz, dir->p1_nz, dir->effort_nz};
    arguments(a, args);
    dir->by_theta(args, res, dir->iw, dir->w, 0);
}

/* Forward sensitivities of one converged step. X0, X1: (NX, d); input: (NU, d) or NULL; path: next prescribed (NC, d)
 * or NULL; buffers rows (NT, d), joined (NT, d), Y (NY, d). */
static void sensitivity_step(Work *k, const Point *a, const Directions *dir, const double *X0, const double *input,
                             const double *path, double *X1, double *multipliers, double *effort, double *rows,
                             double *joined, double *Y, double *start) {
    const int d = dir->count;
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
        add_sparse(dir->rows_nz, dir->rows_pattern, 0, NT, rows, d);
        add_sparse(dir->p1_nz, dir->p1_pattern, 0, N, p1, d);
    }
    if (input)
        for (int r = 0; r < N; r++)
            for (int j = 0; j < NU; j++) {
                const double f = k->Ru[r][j], g = k->Pu[r][j];
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
    if (multipliers) memcpy(multipliers, joined + (size_t)(N + NZ) * d, sizeof(double) * M * d);
    multiply_rows(&k->P0[0][0], ONE(NQZ), p1_old_start, p1_old_col, N, start, d, p1);
    multiply_rows(&k->P1[0][0], ONE(NT), p1_new_start, p1_new_col, N, joined, d, p1);
    if (effort) {
        memset(effort, 0, sizeof(double) * NC * d);
        if (dir->theta_count) add_sparse(dir->effort_nz, dir->effort_pattern, 0, NC, effort, d);

        for (int j = 0; j < NC; j++) {
            const int at = prescribed_index[j];
            double *target = effort + (size_t)j * d;
            for (int c = 0; c < d; c++) {
                double sum = X0[(size_t)(N + at) * d + c];
                for (int i = 0; i < NQZ; i++) sum += k->R0[at][i] * start[(size_t)i * d + c];
                for (int i = 0; i < NT; i++) sum += k->R1[at][i] * joined[(size_t)i * d + c];
                if (input)
                    for (int i = 0; i < NU; i++) sum += k->Ru[at][i] * input[(size_t)i * d + c];
                target[c] -= sum / k->h;
            }
        }
    }
}

static void effort_of(const Work *k, double *effort) {
    for (int j = 0; j < NC; j++) effort[j] = -k->balance[prescribed_index[j]] / k->h;
}

/* Feedback u_k = ubar_k - K_k (x_k[index] - xbar_k); K is (steps, NU, count). */
typedef struct {
    int count;
    const int *index;
    const double *gain, *reference;
} Feedback;

static void apply_feedback(const Feedback *f, int step, const double *state, const double *nominal, double *u) {
    for (int i = 0; i < NU; i++) {
        double value = nominal[i];
        for (int j = 0; j < f->count; j++)
            value -= f->gain[((size_t)step * NU + i) * f->count + j] *
                     (state[f->index[j]] - f->reference[(size_t)step * f->count + j]);
        u[i] = value;
    }
}

/* Rollout over `steps` steps. state: (steps+1, NX), first row given; path: (steps+1, NC); torque: (steps, NU) nominal.
 * With directions: X (steps+1, NX, d), first block given. Returns a status; info = {step reached, error, iterations,
 * factorisations}. */
int yid_rollout(int steps, const double *theta, double time_step, const double *torque, const double *path,
                const Feedback *feedback, double *state, double *multipliers, double *effort, double *applied,
                const Directions *dir, double *X, double *XL, double *XE, const double *X_torque,
                const double *X_path, double tolerance, int limit, double *info) {
    Work *k = work_new();
    if (!k) return SINGULAR;
    prepare(k, theta, &time_step);
    const int d = dir ? dir->count : 0;
    const int feeds = feedback && feedback->count > 0;
    const size_t buffered = (size_t)d * (2 * ONE(NT) + ONE(NY) + ONE(NU) + ONE(NQZ)) + BLOCK;
    double *buffer = d ? calloc(buffered, sizeof(double)) : NULL;
    if (d && !buffer) {
        work_free(k);
        return SINGULAR;
    }
    double *rows = buffer, *joined = rows + (size_t)d * ONE(NT), *Y = joined + (size_t)d * ONE(NT);
    double *input = Y + (size_t)d * ONE(NY), *start = input + (size_t)d * ONE(NU);
    double q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], u[ONE(NU)];
    memset(lam, 0, sizeof lam);
    int status = OK, step = 0;
    double error = 0;
    for (; step < steps; step++) {
        const double *x = state + (size_t)step * NX;
        double *next = state + (size_t)(step + 1) * NX;
        if (NU) {
            memcpy(u, torque + (size_t)step * NU, sizeof(double) * NU);
            if (feeds) apply_feedback(feedback, step, x, torque + (size_t)step * NU, u);
            if (applied) memcpy(applied + (size_t)step * NU, u, sizeof(double) * NU);
        }
        for (int i = 0; i < N; i++) {
            q1[i] = x[i];
            if (step > 1) q1[i] = 3 * (x[i] - x[i - NX]) + x[i - 2 * NX];
            else if (step == 1) q1[i] = 2 * x[i] - x[i - NX];
        }
        for (int i = 0; i < NZ; i++) z1[i] = step > 0 ? 2 * x[2 * N + i] - x[2 * N + i - NX] : x[2 * N + i];
        for (int j = 0; j < NC; j++) q1[prescribed_index[j]] = path[(size_t)(step + 1) * NC + j];
        Point a = {x, x + N, x + 2 * N, u, theta, &time_step, q1, z1, lam};
        status = one_step(k, &a, tolerance, limit, &error);
        memcpy(next, q1, sizeof(double) * N);
        memcpy(next + N, k->p1, sizeof(double) * N);
        memcpy(next + 2 * N, z1, sizeof(double) * NZ);
        if (status) break;
        if (multipliers) memcpy(multipliers + (size_t)step * M, lam, sizeof(double) * M);
        if (effort) effort_of(k, effort + (size_t)step * NC);
        if (d) {
            linearise(k, &a, 1);
            if (NY && (status = factorise(k))) break;
            const double *X0 = X + (size_t)step * NX * d, *given = X_torque ? X_torque + (size_t)step * NU * d : NULL;
            if (NU && (feeds || given)) {
                if (given) memcpy(input, given, sizeof(double) * NU * d);
                else memset(input, 0, sizeof(double) * NU * d);
                for (int i = 0; feeds && i < NU; i++)
                    for (int j = 0; j < feedback->count; j++) {
                        const double gain = feedback->gain[((size_t)step * NU + i) * feedback->count + j];
                        const double *source = X0 + (size_t)feedback->index[j] * d;
                        for (int c = 0; gain != 0.0 && c < d; c++) input[(size_t)i * d + c] -= gain * source[c];
                    }
            }
            sensitivity_step(k, &a, dir, X0, NU && (feeds || given) ? input : NULL,
                             X_path ? X_path + (size_t)(step + 1) * NC * d : NULL, X + (size_t)(step + 1) * NX * d,
                             XL ? XL + (size_t)step * M * d : NULL, XE ? XE + (size_t)step * NC * d : NULL, rows,
                             joined, Y, start);
        }
    }
    info[0] = step;
    info[1] = error;
    info[2] = (double)k->iterations;
    info[3] = (double)k->factorisations;
    free(buffer);
    work_free(k);
    return status;
}

/* Backward sweep along a finished rollout. by_state: (steps+1, NX) partial derivatives of the cost, by_multiplier
 * (steps, M), by_effort (steps, NC) or NULL. Writes the gradient by the chosen parameters (theta_count), by the initial
 * state (NX), by the nominal torque (steps, NU) where asked for, and by the path (steps+1, NC). */
int yid_adjoint(int steps, const double *theta, double time_step, const double *applied, const Feedback *feedback,
                const double *state, const double *multipliers, const Directions *dir, const double *by_state,
                const double *by_multiplier, const double *by_effort, double *gradient, double *by_start,
                double *by_torque, double *by_path, double *info) {
    Work *k = work_new();
    if (!k) return SINGULAR;
    prepare(k, theta, &time_step);
    const int feeds = feedback && feedback->count > 0;
    double costate[ONE(NX)], g[ONE(NY)], nu[ONE(NY)], full[ONE(NT)], mu[ONE(NX)], mu_u[ONE(NU)];
    double q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], none[ONE(NU)];
    memset(none, 0, sizeof none);
    memset(gradient, 0, sizeof(double) * (dir ? dir->theta_count : 0));
    memcpy(costate, by_state + (size_t)steps * NX, sizeof(double) * NX);
    int status = OK, step = steps - 1;
    for (; step >= 0; step--) {
        const double *x = state + (size_t)step * NX, *next = state + (size_t)(step + 1) * NX;
        memcpy(q1, next, sizeof(double) * N);
        memcpy(z1, next + 2 * N, sizeof(double) * NZ);
        memcpy(lam, multipliers + (size_t)step * M, sizeof(double) * M);
        Point a = {x, x + N, x + 2 * N, NU ? applied + (size_t)step * NU : none, theta, &time_step, q1, z1, lam};
        constraint_matrix(k, &a);
        linearise(k, &a, 1);
        if (NY && (status = factorise(k))) break;
        const double *weight = costate + N, *effort = by_effort ? by_effort + (size_t)step * NC : NULL;
        for (int b = 0; b < NY; b++) {
            const int column = unknown_row[b];
            double sum = column < N ? costate[column] : column < N + NZ ? costate[N + column] : 0.0;
            if (column >= N + NZ && by_multiplier) sum += by_multiplier[(size_t)step * M + column - N - NZ];
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
            by_path[(size_t)(step + 1) * NC + j] = sum;
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
            if (by_torque) by_torque[(size_t)step * NU + j] = mu_u[j];
        }
        for (int j = 0; feeds && j < NU; j++)
            for (int c = 0; c < feedback->count; c++)
                mu[feedback->index[c]] -= feedback->gain[((size_t)step * NU + j) * feedback->count + c] * mu_u[j];
        if (dir && dir->theta_count) {
            for (int j = 0; effort && j < NC; j++) full[prescribed_index[j]] = 0;
            theta_columns(dir, &a);
            const long long *patterns[3] = {dir->rows_pattern, dir->p1_pattern, dir->effort_pattern};
            const double *values[3] = {dir->rows_nz, dir->p1_nz, dir->effort_nz}, *weights[3] = {full, weight, effort};
            for (int part = 0; part < 3; part++) {
                const long long *offset = patterns[part] + 2, *row = patterns[part] + 3 + dir->theta_count;
                if (!weights[part]) continue;
                for (int c = 0; c < dir->theta_count; c++)
                    for (long long e = offset[c]; e < offset[c + 1]; e++)
                        gradient[c] += weights[part][row[e]] * values[part][e];
            }
        }
        for (int i = 0; i < NX; i++) costate[i] = mu[i] + by_state[(size_t)step * NX + i];
    }
    memcpy(by_start, costate, sizeof(double) * NX);
    for (int j = 0; j < NC; j++) by_path[j] = costate[prescribed_index[j]];
    info[0] = step;
    work_free(k);
    return status;
}

/* Rows, p1 and their Jacobians at `count` steps of a trajectory that need not satisfy the equations (a transcription's
 * iterate). state: (count + 1, NX). Matrix arguments may be NULL together; with directions also the parameter columns. */
int yid_linearize(int count, const double *theta, double time_step, const double *state, const double *multipliers,
               const double *applied, const Directions *dir, double *rows, double *p1, double *R1, double *R0,
               double *Ru, double *P1, double *P0, double *Pu, double *Rtheta, double *Ptheta) {
    Work *k = work_new();
    if (!k) return SINGULAR;
    prepare(k, theta, &time_step);
    double q1[ONE(N)], z1[ONE(NZ)], lam[ONE(M)], none[ONE(NU)];
    memset(none, 0, sizeof none);
    for (int step = 0; step < count; step++) {
        const double *x = state + (size_t)step * NX, *next = x + NX;
        memcpy(q1, next, sizeof(double) * N);
        memcpy(z1, next + 2 * N, sizeof(double) * NZ);
        memcpy(lam, multipliers + (size_t)step * M, sizeof(double) * M);
        Point a = {x, x + N, x + 2 * N, NU ? applied + (size_t)step * NU : none, theta, &time_step, q1, z1, lam};
        constraint_matrix(k, &a);
        evaluate(k, &a);
        double *r = rows + (size_t)step * NT;
        memcpy(r, k->balance, sizeof(double) * N);
        memcpy(r + N, k->internal, sizeof(double) * NZ);
        memcpy(r + N + NZ, k->constraint, sizeof(double) * M);
        memcpy(p1 + (size_t)step * N, k->p1, sizeof(double) * N);
        if (!R1) continue;
        linearise(k, &a, 1);
        memcpy(R1 + (size_t)step * NT * NT, k->R1, sizeof(double) * NT * NT);
        memcpy(R0 + (size_t)step * NT * NQZ, k->R0, sizeof(double) * NT * NQZ);
        memcpy(P1 + (size_t)step * N * NT, k->P1, sizeof(double) * N * NT);
        memcpy(P0 + (size_t)step * N * NQZ, k->P0, sizeof(double) * N * NQZ);
        if (NU) {
            memcpy(Ru + (size_t)step * NT * NU, k->Ru, sizeof(double) * NT * NU);
            memcpy(Pu + (size_t)step * N * NU, k->Pu, sizeof(double) * N * NU);
        }
        if (dir && dir->theta_count) {
            theta_columns(dir, &a);
            add_sparse(dir->rows_nz, dir->rows_pattern, 0, NT, Rtheta + (size_t)step * NT * dir->count, dir->count);
            add_sparse(dir->p1_nz, dir->p1_pattern, 0, N, Ptheta + (size_t)step * N * dir->count, dir->count);
        }
    }
    work_free(k);
    return OK;
}
