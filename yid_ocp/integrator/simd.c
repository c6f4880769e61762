/* Arithmetic of the kernel: a `real` is one double or, where BATCHED is defined, a vector with one for each member of a
 * batch; a `mask` says yes or no for every member. No operation mixes members, so that what one gives does not depend on
 * the others.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifndef BATCHED

#define SIMD_WIDTH 1
typedef double real;
typedef int mask;
typedef long long whole;
#define EVERY 1
#define NOT(m) (!(m))
#define ONES(m) (m)
#define SIMD_ENTRY(x, entry) (x)
#define ALL(x) (x)
#define SIMD _Pragma("omp simd")
#define SIMD_SUM _Pragma("omp simd reduction(- : sum)")
static inline int any(mask m) { return m; }
static inline real choose(mask m, real a, real b) { return m ? a : b; }
static inline real magnitude(real x) { return fabs(x); }

#else

#ifdef __AVX512F__
#define SIMD_WIDTH 8
#define ALL(x) {x, x, x, x, x, x, x, x}
#else
#define SIMD_WIDTH 4
#define ALL(x) {x, x, x, x}
#endif
typedef double real __attribute__((vector_size(8 * SIMD_WIDTH), may_alias));
typedef long long mask __attribute__((vector_size(8 * SIMD_WIDTH), may_alias));
typedef mask whole;
#define EVERY ((mask)ALL(-1))
#define NOT(m) (~(m))
#define ONES(m) (-(m))
#define SIMD_ENTRY(x, entry) (x)[entry]
#define SIMD
#define SIMD_SUM
static inline int any(mask m) {
    long long found = 0;
    for (int entry = 0; entry < SIMD_WIDTH; entry++) found |= m[entry];
    return found != 0;
}
static inline real choose(mask m, real a, real b) { return (real)(((mask)a & m) | ((mask)b & ~m)); }
static inline real magnitude(real x) { return (real)((mask)x & (mask)ALL(0x7fffffffffffffff)); }
#endif

/* What our functions use, beside operators (codegen.py). */
static inline real truth(mask m) { return choose(m, (real)ALL(1.0), (real)ALL(0.0)); }
static inline real lesser(real a, real b) { return choose((a < b) | (b != b), a, b); }
static inline real larger(real a, real b) { return choose((a > b) | (b != b), a, b); }
static inline real sign_of(real x) { return choose(x < 0, (real)ALL(-1.0), choose(x > 0, (real)ALL(1.0), x)); }
static real each(double (*function)(double), real x) {
    for (int entry = 0; entry < SIMD_WIDTH; entry++) SIMD_ENTRY(x, entry) = function(SIMD_ENTRY(x, entry));
    return x;
}
static real each_pair(double (*function)(double, double), real x, real y) {
    for (int entry = 0; entry < SIMD_WIDTH; entry++) SIMD_ENTRY(x, entry) = function(SIMD_ENTRY(x, entry), SIMD_ENTRY(y, entry));
    return x;
}
static inline real root(real x) {
    for (int entry = 0; entry < SIMD_WIDTH; entry++) SIMD_ENTRY(x, entry) = sqrt(SIMD_ENTRY(x, entry));
    return x;
}
typedef struct {
    real sine, cosine;
} Turn;

#ifndef BATCHED
static inline Turn turn(real x) {
    const Turn t = {sin(x), cos(x)};
    return t;
}
#else
/* Sine and cosine of every member, within two units in the last place. Quarter turns are taken off in three parts of
 * pi/2, the first two of which stay exact when multiplied by their number (Cody and Waite 1980); Taylor's series do for
 * the 45 degrees that are left. */
#define MANY 1e6 /* [rad]; libm takes what is beyond, and what is not finite */
static Turn turn(real x) {
    const real shifted = x * 0x1.45f306dc9c883p-1 + 0x1.8p52, n = shifted - 0x1.8p52;
    const mask quarter = (mask)shifted, odd = -(quarter & 1);
    const real near = x - n * 0x1.921fb544p+0, r = near - n * 0x1.0b4611a6p-34;
    const real rest = ((near - r) - n * 0x1.0b4611a6p-34) - n * 0x1.3198a2e037073p-69, z = r * r, half = 0.5 * z;
    real s = z * (1 / 355687428096000.0) - 1 / 1307674368000.0, c = z * (1 / 20922789888000.0) - 1 / 87178291200.0;
    s = s * z + 1 / 6227020800.0;
    s = s * z - 1 / 39916800.0;
    s = s * z + 1 / 362880.0;
    s = s * z - 1 / 5040.0;
    s = s * z + 1 / 120.0;
    s = s * z - 1 / 6.0;
    c = c * z + 1 / 479001600.0;
    c = c * z - 1 / 3628800.0;
    c = c * z + 1 / 40320.0;
    c = c * z - 1 / 720.0;
    c = c * z + 1 / 24.0;
    const real most = 1.0 - half;
    s = r + (r * z * s + rest * most);
    c = most + (((1.0 - most) - half) + (z * z * c - r * rest));
    Turn t = {choose(odd, c, s), choose(odd, s, c)};
    t.sine = (real)((mask)t.sine ^ ((quarter & 2) << 62));
    t.cosine = (real)((mask)t.cosine ^ (((quarter + 1) & 2) << 62));
    const mask known = magnitude(x) < MANY;
    for (int entry = 0; entry < SIMD_WIDTH && any(~known); entry++)
        if (!known[entry]) {
            t.sine[entry] = sin(x[entry]);
            t.cosine[entry] = cos(x[entry]);
        }
    return t;
}

static inline double places(double a, double b) { return fabs(a - b) / (0x1p-52 * fabs(b) + 0x1p-105); }

/* Number of members of a batch; 0 where this compiler and this machine do not get the arithmetic right. */
int yid_simd_width(void) {
    int bad = 0;
    for (int i = -400; i <= 400; i++) {
        real x;
        for (int entry = 0; entry < SIMD_WIDTH; entry++) x[entry] = 0.0137 * i * (1 + entry) + 1e-3 * entry;
        const Turn t = turn(x);
        const real less = lesser(x, -x), more = larger(x, x * x), sign = sign_of(x), size = magnitude(x);
        const real kind = choose(x < 0.5, x, truth(x >= 1.0));
        for (int entry = 0; entry < SIMD_WIDTH; entry++) {
            const double v = x[entry];
            bad |= !(places(t.sine[entry], sin(v)) < 4 && places(t.cosine[entry], cos(v)) < 4);
            bad |= less[entry] != -fabs(v) || more[entry] != fmax(v, v * v) || size[entry] != fabs(v);
            bad |= sign[entry] != (v > 0) - (v < 0) || kind[entry] != (v < 0.5 ? v : v >= 1.0 ? 1.0 : 0.0);
        }
    }
    return bad ? 0 : SIMD_WIDTH;
}
#endif

/* Neither infinite nor NaN. */
static inline mask is_finite(real x) { return x - x == 0; }
