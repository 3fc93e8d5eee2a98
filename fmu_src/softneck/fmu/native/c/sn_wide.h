/* The loops that take most of the time, four numbers at a time: AVX2 where the processor has it, else what it has. Every
 * lane does what the scalar code does, and the order of all sums is written down: the bits are the same either way. */
#ifndef SN_WIDE_H
#define SN_WIDE_H

#include "sn_math.h"

#if defined(__GNUC__)
typedef double sn_d4 __attribute__((vector_size(32)));
typedef int64_t sn_l4 __attribute__((vector_size(32)));
#define SN_LANES 1

/* Four lanes of `sn_tanh`. */
#define SN_TANH4(y, x)                                                                                              \
    do {                                                                                                            \
        sn_l4 sign = (sn_l4)(x) & INT64_MIN, in;                                                                    \
        sn_d4 c = (sn_d4)((sn_l4)(x) & INT64_MAX), shifted, k, r, s, even, odd, scale, e;                           \
        in = c < 22.0;                                                                                              \
        c = (sn_d4)((in & (sn_l4)c) | (~in & (sn_l4)(sn_d4){22.0, 22.0, 22.0, 22.0}));                              \
        shifted = 2.0 * c * SN_PER_LN2 + SN_ROUNDER;                                                                \
        k = shifted - SN_ROUNDER;                                                                                   \
        r = (2.0 * c - k * SN_LN2_HIGH) - k * SN_LN2_LOW;                                                           \
        scale = (sn_d4)(((sn_l4)shifted + 1023) << 52);                                                             \
        s = r * r;                                                                                                  \
        even = 0.5 + s * (SN_E4 + s * (SN_E6 + s * (SN_E8 + s * (SN_E10 + s * (SN_E12 + s * SN_E14)))));            \
        odd = SN_E3 + s * (SN_E5 + s * (SN_E7 + s * (SN_E9 + s * (SN_E11 + s * SN_E13))));                          \
        e = scale * (r + s * (even + r * odd)) + (scale - 1.0);                                                     \
        y = (sn_d4)((sn_l4)(e / (e + 2.0)) | sign);                                                                 \
        in = x == x;                                                                                                \
        y = (sn_d4)((in & (sn_l4)y) | (~in & (sn_l4)x));                                                            \
    } while (0)

/* Eight at a time, so that the processor has two chains to work on; the last ones overlap those before. */
#define SN_TANH_ALL(name, attribute)                                                                                \
    attribute static void name(double *restrict y, const double *restrict x, int64_t n)                             \
    {                                                                                                               \
        int64_t i = 0;                                                                                              \
        if (n < 4) {                                                                                                \
            for (; i < n; i++)                                                                                      \
                y[i] = sn_tanh(x[i]);                                                                               \
            return;                                                                                                 \
        }                                                                                                           \
        for (; i < n; i += 8) {                                                                                     \
            int64_t one = i < n - 4 ? i : n - 4, two = i + 4 < n - 4 ? i + 4 : n - 4;                               \
            sn_d4 a, b, p, q;                                                                                       \
            memcpy(&a, x + one, sizeof a);                                                                          \
            memcpy(&b, x + two, sizeof b);                                                                          \
            SN_TANH4(p, a);                                                                                         \
            SN_TANH4(q, b);                                                                                         \
            memcpy(y + one, &p, sizeof p);                                                                          \
            memcpy(y + two, &q, sizeof q);                                                                          \
        }                                                                                                           \
    }

/* A x for rows without gaps: `sn_dot` of each. */
#define SN_ROWS(name, attribute)                                                                                    \
    attribute static void name(double *restrict y, const double *restrict A, const double *restrict x, int64_t rows,\
                               int64_t gap, int64_t n)                                                              \
    {                                                                                                               \
        for (int64_t k = 0; k < rows; k++, A += gap) {                                                              \
            sn_d4 sum = {0.0, 0.0, 0.0, 0.0}, a, b;                                                                 \
            int64_t i = 0;                                                                                          \
            for (; i + 4 <= n; i += 4) {                                                                            \
                memcpy(&a, A + i, sizeof a);                                                                        \
                memcpy(&b, x + i, sizeof b);                                                                        \
                sum += a * b;                                                                                       \
            }                                                                                                       \
            for (; i < n; i++)                                                                                      \
                sum[0] += A[i] * x[i];                                                                              \
            y[k] = (sum[0] + sum[2]) + (sum[1] + sum[3]);                                                           \
        }                                                                                                           \
    }

/* `tree_cones`: four points at a time, each point's sum in the order of its sides. The last four overlap those before:
 * what is worked out twice comes out equal. */
#define SN_CONES(name, attribute)                                                                                   \
    attribute static void name(double *restrict y, const double *restrict p, int64_t gap, int64_t count,             \
                               const double *restrict x, int64_t n, double gamma)                                   \
    {                                                                                                               \
        for (int64_t k = 0; k < count; k += 8) {                                                                    \
            int64_t one = k < count - 4 ? k : count - 4, two = k + 4 < count - 4 ? k + 4 : count - 4;               \
            sn_d4 s = {0.0, 0.0, 0.0, 0.0}, t = s, a, b;                                                            \
            for (int64_t i = 0; i < n; i++) {                                                                       \
                memcpy(&a, p + i * gap + one, sizeof a);                                                            \
                memcpy(&b, p + i * gap + two, sizeof b);                                                            \
                a -= x[i];                                                                                          \
                b -= x[i];                                                                                          \
                s += a * a;                                                                                         \
                t += b * b;                                                                                         \
            }                                                                                                       \
            for (int j = 0; j < 4; j++)                                                                             \
                s[j] = sqrt(s[j]), t[j] = sqrt(t[j]);                                                               \
            s *= gamma;                                                                                             \
            t *= gamma;                                                                                             \
            memcpy(y + one, &s, sizeof s);                                                                          \
            memcpy(y + two, &t, sizeof t);                                                                          \
        }                                                                                                           \
    }

typedef double sn_d2 __attribute__((vector_size(16)));
typedef int64_t sn_l2 __attribute__((vector_size(16)));

/* `tree_children`: both children side by side, each sum in the order of the sides; a gap below zero counts nothing. */
static void sn_boxes_plain(const double *a, const double *b, const double *x, int64_t n, double *result)
{
    sn_d2 sum = {0.0, 0.0};
    for (int64_t i = 0; i < n; i++) {
        sn_d2 low = {a[2 * i], b[2 * i]}, high = {a[2 * i + 1], b[2 * i + 1]}, below = low - x[i], above = x[i] - high;
        sn_l2 first = below > above;
        sn_d2 gap = (sn_d2)((first & (sn_l2)below) | (~first & (sn_l2)above));
        gap = (sn_d2)((gap > 0.0) & (sn_l2)gap);
        sum += gap * gap;
    }
    result[0] = sqrt(sum[0]);
    result[1] = sqrt(sum[1]);
}

SN_TANH_ALL(sn_tanh_all_plain, )
SN_ROWS(sn_rows_plain, )
SN_CONES(sn_cones_plain, )

#if defined(__x86_64__)
#include <cpuid.h>
#include <immintrin.h>
#define SN_AVX2 __attribute__((target("avx2")))
SN_TANH_ALL(sn_tanh_all_wide, SN_AVX2)
SN_ROWS(sn_rows_wide, SN_AVX2)

/* SN_CONES once more: compilers take the roots one by one. */
SN_AVX2 static void sn_cones_wide(double *restrict y, const double *restrict p, int64_t gap, int64_t count,
                                  const double *restrict x, int64_t n, double gamma)
{
    const __m256d slope = _mm256_set1_pd(gamma);
    for (int64_t k = 0; k < count; k += 8) {
        int64_t one = k < count - 4 ? k : count - 4, two = k + 4 < count - 4 ? k + 4 : count - 4;
        const double *first = p + one, *second = p + two;
        __m256d s = _mm256_setzero_pd(), t = s;
        for (int64_t i = 0; i < n; i++, first += gap, second += gap) {
            __m256d at = _mm256_broadcast_sd(x + i);
            __m256d a = _mm256_sub_pd(_mm256_loadu_pd(first), at), b = _mm256_sub_pd(_mm256_loadu_pd(second), at);
            s = _mm256_add_pd(s, _mm256_mul_pd(a, a));
            t = _mm256_add_pd(t, _mm256_mul_pd(b, b));
        }
        _mm256_storeu_pd(y + one, _mm256_mul_pd(slope, _mm256_sqrt_pd(s)));
        _mm256_storeu_pd(y + two, _mm256_mul_pd(slope, _mm256_sqrt_pd(t)));
    }
}

/* Two sides of both boxes at a time; their squares are added one side after the other. */
SN_AVX2 static void sn_boxes_wide(const double *a, const double *b, const double *x, int64_t n, double *result)
{
    const __m256d zero = _mm256_setzero_pd();
    __m128d sum = _mm_setzero_pd(), low, high, gap1;
    int64_t i = 0;
    for (; i + 2 <= n; i += 2) {
        __m256d left = _mm256_loadu_pd(a + 2 * i), right = _mm256_loadu_pd(b + 2 * i);
        __m256d at = _mm256_permute4x64_pd(_mm256_castpd128_pd256(_mm_loadu_pd(x + i)), 0x50);
        __m256d gap = _mm256_max_pd(_mm256_sub_pd(_mm256_unpacklo_pd(left, right), at),
                                    _mm256_sub_pd(at, _mm256_unpackhi_pd(left, right)));
        gap = _mm256_max_pd(gap, zero);
        gap = _mm256_mul_pd(gap, gap);
        sum = _mm_add_pd(sum, _mm256_castpd256_pd128(gap));
        sum = _mm_add_pd(sum, _mm256_extractf128_pd(gap, 1));
    }
    if (i < n) {
        low = _mm_set_pd(b[2 * i], a[2 * i]);
        high = _mm_set_pd(b[2 * i + 1], a[2 * i + 1]);
        gap1 = _mm_max_pd(_mm_sub_pd(low, _mm_set1_pd(x[i])), _mm_sub_pd(_mm_set1_pd(x[i]), high));
        gap1 = _mm_max_pd(gap1, _mm_setzero_pd());
        sum = _mm_add_pd(sum, _mm_mul_pd(gap1, gap1));
    }
    _mm_storeu_pd(result, _mm_sqrt_pd(sum));
}

/* Whether processor and operating system have AVX2. */
static int sn_has_wide(void)
{
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & (1u << 27)) || !(c & (1u << 28)))
        return 0;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (low & 6u) == 6u && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & (1u << 5));
}
#else
#define sn_tanh_all_wide sn_tanh_all_plain
#define sn_rows_wide sn_rows_plain
#define sn_cones_wide sn_cones_plain
#define sn_boxes_wide sn_boxes_plain
static int sn_has_wide(void) { return 0; }
#endif

static void sn_two_boxes(const sn_work *w, const double *a, const double *b, const double *x, int64_t n, double *result)
{
    if (w->wide)
        sn_boxes_wide(a, b, x, n, result);
    else
        sn_boxes_plain(a, b, x, n, result);
}

static void sn_tanh_all(const sn_work *w, double *y, const double *x, int64_t n)
{
    if (w->wide)
        sn_tanh_all_wide(y, x, n);
    else
        sn_tanh_all_plain(y, x, n);
}

static void sn_rows(const sn_work *w, double *y, const double *A, const double *x, int64_t rows, int64_t gap, int64_t n)
{
    if (w->wide)
        sn_rows_wide(y, A, x, rows, gap, n);
    else
        sn_rows_plain(y, A, x, rows, gap, n);
}

#else
static int sn_has_wide(void) { return 0; }

static void sn_two_boxes(const sn_work *w, const double *a, const double *b, const double *x, int64_t n, double *result)
{
    double left = 0.0, right = 0.0, gap;
    (void)w;
    for (int64_t i = 0; i < n; i++) {
        gap = sn_max(a[2 * i] - x[i], x[i] - a[2 * i + 1]);
        left += gap > 0.0 ? gap * gap : 0.0;
        gap = sn_max(b[2 * i] - x[i], x[i] - b[2 * i + 1]);
        right += gap > 0.0 ? gap * gap : 0.0;
    }
    result[0] = sqrt(left);
    result[1] = sqrt(right);
}

static void sn_tanh_all(const sn_work *w, double *y, const double *x, int64_t n)
{
    (void)w;
    for (int64_t i = 0; i < n; i++)
        y[i] = sn_tanh(x[i]);
}
#endif

/* What the runtimes' functions of these names do, with their checks made once for all entries; see `_translate.py`. */
static SN_INSIDE void sn_tree_children(sn_work *w, const sn_v2 *nodes, int64_t node, sn_v1 x, double *result)
{
    if (SN_RARE(node < 0 || node > nodes->n0 / 2 || 2 * node + 1 >= nodes->n0 || x.n > nodes->n1 / 2 || nodes->s1 != 1
                || x.s != 1))
        sn_outside(w);
    sn_two_boxes(w, nodes->p + 2 * node * nodes->s0, nodes->p + (2 * node + 1) * nodes->s0, x.p, x.n, result);
}

static SN_INSIDE void sn_tree_cones(sn_work *w, const sn_v2 *points, int64_t first, int64_t count, double gamma,
                                    sn_v1 x, sn_v1 cones)
{
    if (SN_RARE(first < 0 || count < 0 || first > points->n1 || count > points->n1 - first || count > cones.n
                || x.n > points->n0 || points->s1 != 1 || x.s != 1 || cones.s != 1))
        sn_outside(w);
    sn_rounds(w, count);
#ifdef SN_LANES
    if (count >= 4) {
        if (w->wide)
            sn_cones_wide(cones.p, points->p + first, points->s0, count, x.p, x.n, gamma);
        else
            sn_cones_plain(cones.p, points->p + first, points->s0, count, x.p, x.n, gamma);
        return;
    }
#endif
    for (int64_t k = 0; k < count; k++) {
        double sum = 0.0;
        for (int64_t i = 0; i < x.n; i++) {
            double gap = points->p[i * points->s0 + first + k] - x.p[i];
            sum += gap * gap;
        }
        cones.p[k] = gamma * sqrt(sum);
    }
}

#endif
