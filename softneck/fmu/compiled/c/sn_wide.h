/* The loops that take most of the time, four numbers at a time: AVX2 where the processor has it, else what it has. Every
 * lane does what the scalar code does, and the order of all sums is written down: the bits are the same either way. */
#ifndef SN_WIDE_H
#define SN_WIDE_H

#include "sn_math.h"

/* One child of `slant_children`, as in Python. */
static inline void sn_child(const double *node, double squared, double along, const double *plane, double *result)
{
    double start = node[0] - along, stop = node[1] - along, best = plane[2] * sqrt(squared), d;
    d = sn_min(sn_max(-best, start), stop);
    result[0] = node[2] + plane[0] + (plane[1] * d + plane[3] * sqrt(d * d + squared)) - plane[4];
    d = sn_min(sn_max(best, start), stop);
    result[1] = node[3] + plane[0] + (plane[1] * d - plane[3] * sqrt(d * d + squared)) + plane[4];
}

static void sn_children_plain(const double *a, const double *b, const double *at, int64_t sides, const double *plane,
                              double *result)
{
    double left = 0.0, right = 0.0, gap;
    for (int64_t i = 1; i <= sides; i++) {
        gap = sn_max(sn_max(a[3 + i] - at[i], at[i] - a[3 + sides + i]), 0.0);
        left += gap * gap;
        gap = sn_max(sn_max(b[3 + i] - at[i], at[i] - b[3 + sides + i]), 0.0);
        right += gap * gap;
    }
    sn_child(a, left, at[0], plane, result);
    sn_child(b, right, at[0], plane, result + 2);
}

/* The cones of a few points, one by one. */
static void sn_leaf_few(double *best, const double *p, const double *values, int64_t gap, int64_t count,
                        const double *x, int64_t n, double gamma)
{
    for (int64_t k = 0; k < count; k++) {
        double sum = 0.0;
        for (int64_t i = 0; i < n; i++) {
            double away = p[i * gap + k] - x[i];
            sum += away * away;
        }
        sum = gamma * sqrt(sum);
        best[0] = sn_max(best[0], values[k] - sum);
        best[1] = sn_min(best[1], values[k] + sum);
    }
}

/* `slant_descend`: its branches are guessed right more often than not, and what follows a guess is worked out meanwhile;
 * without branches it took 1.4 times as long. One node a level is left for later: a tree of 2^31 nodes has 31. It begins
 * with the leaves `low` and `high`, where they are known: bounds that are good from the start leave out more. Nodes
 * after the next come from memory while this one is worked on. */
#define SN_DESCEND(name, attribute, children, leaf)                                                                 \
    attribute static SN_MERGED void name##_leaf(sn_work *w, const sn_v2 *points, sn_v1 values, int64_t node,        \
                                                int64_t leaves, double gamma, sn_v1 x, double *best)                \
    {                                                                                                               \
        int64_t rows = values.n, first = (node - leaves) * rows / leaves;                                           \
        int64_t count = (node + 1 - leaves) * rows / leaves - first;                                                \
        double low = best[0], high = best[1];                                                                       \
        sn_rounds(w, count + 1);                                                                                    \
        (count < 4 ? sn_leaf_few : leaf)(best, points->p + first, values.p + first, points->s0, count, x.p, x.n,    \
                                         gamma);                                                                    \
        best[2] = best[0] > low ? (double)node : best[2];                                                           \
        best[3] = best[1] < high ? (double)node : best[3];                                                          \
    }                                                                                                               \
    attribute static void name(sn_work *w, const sn_v2 *points, sn_v1 values, const sn_v2 *nodes, const double *at, \
                               int64_t sides, const double *plane, double gamma, sn_v1 x, double *best,              \
                               sn_found was)                                                                        \
    {                                                                                                               \
        int64_t waiting[64], leaves = nodes->n0 / 2, top = 0, node = 1;                                             \
        double later[64][2], found[4], high = -HUGE_VAL, low = HUGE_VAL;                                            \
        best[2] = best[3] = (double)leaves;                                                                         \
        if (was.low >= leaves && was.low < nodes->n0)                                                               \
            name##_leaf(w, points, values, was.low, leaves, gamma, x, best);                                        \
        if (was.high >= leaves && was.high < nodes->n0 && was.high != was.low)                                      \
            name##_leaf(w, points, values, was.high, leaves, gamma, x, best);                                       \
        for (;;) {                                                                                                  \
            while (high < best[1] || low > best[0]) {                                                               \
                if (node >= leaves) {                                                                               \
                    if (node != was.low && node != was.high)                                                        \
                        name##_leaf(w, points, values, node, leaves, gamma, x, best);                               \
                    break;                                                                                          \
                }                                                                                                   \
                for (int64_t i = 0; 2 * node < leaves && i < 4 * nodes->s0; i += 8)                                 \
                    SN_SOON(nodes->p + 4 * node * nodes->s0 + i);                                                   \
                children(nodes->p + 2 * node * nodes->s0, nodes->p + (2 * node + 1) * nodes->s0, at, sides, plane,  \
                         found);                                                                                    \
                double other_high = found[2], other_low = found[3];                                                 \
                int64_t other = 2 * node + 1;                                                                       \
                high = found[0];                                                                                    \
                low = found[1];                                                                                     \
                node = 2 * node;                                                                                    \
                if (other_high - other_low < high - low) {                                                          \
                    double one = high, two = low;                                                                   \
                    high = other_high, low = other_low, other_high = one, other_low = two;                          \
                    other = node, node++;                                                                           \
                }                                                                                                   \
                if (other_high < best[1] || other_low > best[0]) {                                                  \
                    waiting[top] = other;                                                                           \
                    later[top][0] = other_high;                                                                     \
                    later[top][1] = other_low;                                                                      \
                    top++;                                                                                          \
                }                                                                                                   \
            }                                                                                                       \
            if (top == 0)                                                                                           \
                return;                                                                                             \
            top--;                                                                                                  \
            node = waiting[top];                                                                                    \
            high = later[top][0];                                                                                   \
            low = later[top][1];                                                                                    \
        }                                                                                                           \
    }

#if defined(__GNUC__)
typedef double sn_d4 __attribute__((vector_size(32)));
typedef int64_t sn_l4 __attribute__((vector_size(32)));
#define SN_LANES 1

/* Four lanes of `sn_tanh`. */
#define SN_TANH4(y, x)                                                                                              \
    do {                                                                                                            \
        sn_l4 sign = (sn_l4)(x) & INT64_MIN, in;                                                                    \
        sn_d4 c = (sn_d4)((sn_l4)(x) & INT64_MAX), shifted, k, r, s, t, u, even, odd, scale, e;                     \
        in = c < 22.0;                                                                                              \
        c = (sn_d4)((in & (sn_l4)c) | (~in & (sn_l4)(sn_d4){22.0, 22.0, 22.0, 22.0}));                              \
        shifted = 2.0 * c * SN_PER_LN2 + SN_ROUNDER;                                                                \
        k = shifted - SN_ROUNDER;                                                                                   \
        r = (2.0 * c - k * SN_LN2_HIGH) - k * SN_LN2_LOW;                                                           \
        scale = (sn_d4)(((sn_l4)shifted + 1023) << 52);                                                             \
        s = r * r;                                                                                                  \
        t = s * s;                                                                                                  \
        u = t * t;                                                                                                  \
        even = ((0.5 + s * SN_E4) + t * (SN_E6 + s * SN_E8)) + u * (SN_E10 + s * SN_E12);                           \
        odd = ((SN_E3 + s * SN_E5) + t * (SN_E7 + s * SN_E9)) + u * (SN_E11 + s * SN_E13);                          \
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

/* x A for rows without gaps, four columns side by side: `sn_dot` of each. The last four overlap those before. */
#define SN_COLUMNS(name, attribute)                                                                                 \
    attribute static void name(double *restrict y, const double *restrict A, const double *restrict x,              \
                               int64_t columns, int64_t gap, int64_t n)                                             \
    {                                                                                                               \
        for (int64_t j = 0; j < columns; j += 4) {                                                                  \
            const double *at = A + (j < columns - 4 ? j : columns - 4);                                             \
            double *to = y + (at - A);                                                                              \
            sn_d4 p = {0.0, 0.0, 0.0, 0.0}, q = p, r = p, s = p, a, b, c, d;                                        \
            int64_t i = 0;                                                                                          \
            for (; i + 4 <= n; i += 4, at += 4 * gap) {                                                             \
                memcpy(&a, at, sizeof a);                                                                           \
                memcpy(&b, at + gap, sizeof b);                                                                     \
                memcpy(&c, at + 2 * gap, sizeof c);                                                                 \
                memcpy(&d, at + 3 * gap, sizeof d);                                                                 \
                p += x[i] * a;                                                                                      \
                q += x[i + 1] * b;                                                                                  \
                r += x[i + 2] * c;                                                                                  \
                s += x[i + 3] * d;                                                                                  \
            }                                                                                                       \
            for (; i < n; i++, at += gap) {                                                                         \
                memcpy(&a, at, sizeof a);                                                                           \
                p += x[i] * a;                                                                                      \
            }                                                                                                       \
            a = (p + r) + (q + s);                                                                                  \
            memcpy(to, &a, sizeof a);                                                                               \
        }                                                                                                           \
    }

/* The cones of `slant_leaf`: four points at a time, each point's sum in the order of its sides, each lane its own bounds.
 * The last four overlap those before: what is worked out twice comes out equal. `best` is low and high. */
static void sn_leaf_plain(double *best, const double *p, const double *values, int64_t gap, int64_t count,
                          const double *x, int64_t n, double gamma)
{
    sn_d4 low = {best[0], best[0], best[0], best[0]}, high = {best[1], best[1], best[1], best[1]};
    for (int64_t k = 0; k < count; k += 4) {
        int64_t one = k < count - 4 ? k : count - 4;
        sn_d4 s = {0.0, 0.0, 0.0, 0.0}, a, y;
        sn_l4 in;
        for (int64_t i = 0; i < n; i++) {
            memcpy(&a, p + i * gap + one, sizeof a);
            a -= x[i];
            s += a * a;
        }
        memcpy(&y, values + one, sizeof y);
        for (int j = 0; j < 4; j++)
            s[j] = gamma * sqrt(s[j]);
        a = y + s;
        in = a < high;
        high = (sn_d4)((in & (sn_l4)a) | (~in & (sn_l4)high));
        a = y - s;
        in = a > low;
        low = (sn_d4)((in & (sn_l4)a) | (~in & (sn_l4)low));
    }
    best[0] = sn_max(sn_max(low[0], low[2]), sn_max(low[1], low[3]));
    best[1] = sn_min(sn_min(high[0], high[2]), sn_min(high[1], high[3]));
}

SN_DESCEND(sn_descend_plain, , sn_children_plain, sn_leaf_plain)
SN_TANH_ALL(sn_tanh_all_plain, )
SN_ROWS(sn_rows_plain, )
SN_COLUMNS(sn_columns_plain, )

#if defined(__x86_64__)
#include <cpuid.h>
#include <immintrin.h>
#define SN_AVX2 __attribute__((target("avx2")))
#define SN_PART SN_AVX2 static SN_MERGED

/* SN_TANH4 in fewer instructions: what is no number passes through `min` and all that follows. */
SN_PART __m256d sn_tanh4(__m256d x)
{
#define SN_4(x) _mm256_set1_pd(x)
#define SN_PAIR(a, b) _mm256_add_pd(SN_4(a), _mm256_mul_pd(s, SN_4(b)))
#define SN_SERIES(a, b, c) _mm256_add_pd(_mm256_add_pd(a, _mm256_mul_pd(t, b)), _mm256_mul_pd(u, c))
    const __m256d minus = SN_4(-0.0);
    __m256d c = _mm256_min_pd(SN_4(22.0), _mm256_andnot_pd(minus, x)), shifted, k, r, s, t, u, even, odd, scale, e;
    c = _mm256_add_pd(c, c);
    shifted = _mm256_add_pd(_mm256_mul_pd(c, SN_4(SN_PER_LN2)), SN_4(SN_ROUNDER));
    k = _mm256_sub_pd(shifted, SN_4(SN_ROUNDER));
    r = _mm256_sub_pd(_mm256_sub_pd(c, _mm256_mul_pd(k, SN_4(SN_LN2_HIGH))), _mm256_mul_pd(k, SN_4(SN_LN2_LOW)));
    scale = _mm256_castsi256_pd(
        _mm256_slli_epi64(_mm256_add_epi64(_mm256_castpd_si256(shifted), _mm256_set1_epi64x(1023)), 52));
    s = _mm256_mul_pd(r, r);
    t = _mm256_mul_pd(s, s);
    u = _mm256_mul_pd(t, t);
    even = SN_SERIES(SN_PAIR(0.5, SN_E4), SN_PAIR(SN_E6, SN_E8), SN_PAIR(SN_E10, SN_E12));
    odd = SN_SERIES(SN_PAIR(SN_E3, SN_E5), SN_PAIR(SN_E7, SN_E9), SN_PAIR(SN_E11, SN_E13));
    e = _mm256_add_pd(r, _mm256_mul_pd(s, _mm256_add_pd(even, _mm256_mul_pd(r, odd))));
    e = _mm256_add_pd(_mm256_mul_pd(scale, e), _mm256_sub_pd(scale, SN_4(1.0)));
    e = _mm256_div_pd(e, _mm256_add_pd(e, SN_4(2.0)));
    return _mm256_or_pd(e, _mm256_and_pd(minus, x));
#undef SN_SERIES
#undef SN_PAIR
#undef SN_4
}

SN_AVX2 static void sn_tanh_all_wide(double *restrict y, const double *restrict x, int64_t n)
{
    int64_t i = 0;
    for (; i + 8 <= n; i += 8) {
        __m256d a = sn_tanh4(_mm256_loadu_pd(x + i)), b = sn_tanh4(_mm256_loadu_pd(x + i + 4));
        _mm256_storeu_pd(y + i, a);
        _mm256_storeu_pd(y + i + 4, b);
    }
    for (; i + 4 <= n; i += 4)
        _mm256_storeu_pd(y + i, sn_tanh4(_mm256_loadu_pd(x + i)));
    for (; i < n; i++)
        y[i] = sn_tanh(x[i]);
}

/* The sums of two rows, each as `sn_rows_plain` adds it; `first` and `second` are the next columns, from `i` on. */
SN_PART __m128d sn_two_sums(__m256d a, __m256d b, const double *first, const double *second,
                                          const double *x, int64_t n)
{
    __m128d p = _mm256_castpd256_pd128(a), q = _mm256_castpd256_pd128(b);
    for (int64_t i = 0; i < n; i++) {
        __m128d at = _mm_load_sd(x + i);
        p = _mm_add_sd(p, _mm_mul_sd(_mm_load_sd(first + i), at));
        q = _mm_add_sd(q, _mm_mul_sd(_mm_load_sd(second + i), at));
    }
    p = _mm_add_pd(p, _mm256_extractf128_pd(a, 1));
    q = _mm_add_pd(q, _mm256_extractf128_pd(b, 1));
    return _mm_add_pd(_mm_unpacklo_pd(p, q), _mm_unpackhi_pd(p, q));
}

/* Four rows side by side: compilers wait for each sum. The last four overlap those before. */
SN_AVX2 static void sn_rows_wide(double *restrict y, const double *restrict A, const double *restrict x, int64_t rows,
                                 int64_t gap, int64_t n)
{
    const int64_t whole = n & ~(int64_t)3;
    if (rows < 4) {
        sn_rows_plain(y, A, x, rows, gap, n);
        return;
    }
    for (int64_t row = 0; row < rows; row += 4) {
        int64_t k = row < rows - 4 ? row : rows - 4;
        const double *a = A + k * gap, *b = a + gap, *c = b + gap, *d = c + gap;
        __m256d p = _mm256_setzero_pd(), q = p, r = p, s = p;
        for (int64_t i = 0; i < whole; i += 4) {
            __m256d at = _mm256_loadu_pd(x + i);
            p = _mm256_add_pd(p, _mm256_mul_pd(_mm256_loadu_pd(a + i), at));
            q = _mm256_add_pd(q, _mm256_mul_pd(_mm256_loadu_pd(b + i), at));
            r = _mm256_add_pd(r, _mm256_mul_pd(_mm256_loadu_pd(c + i), at));
            s = _mm256_add_pd(s, _mm256_mul_pd(_mm256_loadu_pd(d + i), at));
        }
        _mm_storeu_pd(y + k, sn_two_sums(p, q, a + whole, b + whole, x + whole, n - whole));
        _mm_storeu_pd(y + k + 2, sn_two_sums(r, s, c + whole, d + whole, x + whole, n - whole));
    }
}

SN_COLUMNS(sn_columns_wide, SN_AVX2)

/* `sn_leaf_plain` once more, eight points at a time: compilers take roots and choices one by one. */
SN_AVX2 static void sn_leaf_wide(double *best, const double *p, const double *values, int64_t gap, int64_t count,
                                 const double *x, int64_t n, double gamma)
{
    const __m256d slope = _mm256_set1_pd(gamma);
    __m256d low = _mm256_set1_pd(best[0]), high = _mm256_set1_pd(best[1]);
    double ends[8];
    for (int64_t k = 0; k < count; k += 8) {
        int64_t one = k < count - 4 ? k : count - 4, two = k + 4 < count - 4 ? k + 4 : count - 4;
        const double *first = p + one, *second = p + two;
        __m256d s = _mm256_setzero_pd(), t = s, y = _mm256_loadu_pd(values + one), z = _mm256_loadu_pd(values + two);
        for (int64_t i = 0; i < n; i++, first += gap, second += gap) {
            __m256d at = _mm256_broadcast_sd(x + i);
            __m256d a = _mm256_sub_pd(_mm256_loadu_pd(first), at), b = _mm256_sub_pd(_mm256_loadu_pd(second), at);
            s = _mm256_add_pd(s, _mm256_mul_pd(a, a));
            t = _mm256_add_pd(t, _mm256_mul_pd(b, b));
        }
        s = _mm256_mul_pd(slope, _mm256_sqrt_pd(s));
        t = _mm256_mul_pd(slope, _mm256_sqrt_pd(t));
        high = _mm256_min_pd(_mm256_add_pd(z, t), _mm256_min_pd(_mm256_add_pd(y, s), high));
        low = _mm256_max_pd(_mm256_sub_pd(z, t), _mm256_max_pd(_mm256_sub_pd(y, s), low));
    }
    _mm256_storeu_pd(ends, low);
    _mm256_storeu_pd(ends + 4, high);
    best[0] = sn_max(sn_max(ends[0], ends[2]), sn_max(ends[1], ends[3]));
    best[1] = sn_min(sn_min(ends[4], ends[6]), sn_min(ends[5], ends[7]));
}

/* Four sides of a box at a time, then both bounds of both children. Nothing that a step puts out is a sum of these: they
 * differ from Python's by rounding, which the last of `plane` allows for. */
SN_PART __m128d sn_apart(const double *node, const double *at, int64_t sides)
{
    __m256d sum = _mm256_setzero_pd();
    for (int64_t i = 0; i < sides; i += 4) {
        __m256d x = _mm256_loadu_pd(at + 1 + i), gap;
        gap = _mm256_max_pd(_mm256_sub_pd(_mm256_loadu_pd(node + 4 + i), x),
                            _mm256_sub_pd(x, _mm256_loadu_pd(node + 4 + sides + i)));
        gap = _mm256_max_pd(gap, _mm256_setzero_pd());
        sum = _mm256_add_pd(sum, _mm256_mul_pd(gap, gap));
    }
    return _mm_add_pd(_mm256_castpd256_pd128(sum), _mm256_extractf128_pd(sum, 1));
}

SN_PART void sn_children_wide(const double *a, const double *b, const double *at, int64_t sides,
                              const double *plane, double *result)
{
    const __m256d other = _mm256_setr_pd(0.0, -0.0, 0.0, -0.0); /* the sign of what is for the upper bound's child */
    __m128d left = sn_apart(a, at, sides), right = sn_apart(b, at, sides);
    __m128d both = _mm_add_pd(_mm_unpacklo_pd(left, right), _mm_unpackhi_pd(left, right));
    __m256d squared = _mm256_permute4x64_pd(_mm256_castpd128_pd256(both), 0x50);
    __m256d x = _mm256_broadcast_sd(at), A = _mm256_loadu_pd(a), B = _mm256_loadu_pd(b), r, start, stop, d, cone;
    const __m256d minus = _mm256_set1_pd(-0.0), steep = _mm256_broadcast_sd(plane + 2);
    start = _mm256_sub_pd(_mm256_permute2f128_pd(_mm256_unpacklo_pd(A, A), _mm256_unpacklo_pd(B, B), 0x20), x);
    stop = _mm256_sub_pd(_mm256_permute2f128_pd(_mm256_unpackhi_pd(A, A), _mm256_unpackhi_pd(B, B), 0x20), x);
    r = _mm256_permute2f128_pd(A, B, 0x31);
    /* d |d| rises with d: its limits are known before `squared`, and both roots are taken at once. */
    start = _mm256_mul_pd(start, _mm256_andnot_pd(minus, start));
    stop = _mm256_mul_pd(stop, _mm256_andnot_pd(minus, stop));
    d = _mm256_mul_pd(_mm256_mul_pd(steep, steep), squared);
    /* down the plane for what is below all cones, up for what is above them */
    d = _mm256_xor_pd(d, _mm256_xor_pd(other, minus));
    d = _mm256_min_pd(_mm256_max_pd(d, start), stop);
    cone = _mm256_sqrt_pd(_mm256_add_pd(_mm256_andnot_pd(minus, d), squared));
    d = _mm256_or_pd(_mm256_sqrt_pd(_mm256_andnot_pd(minus, d)), _mm256_and_pd(minus, d));
    cone = _mm256_sub_pd(_mm256_mul_pd(_mm256_broadcast_sd(plane + 3), cone), _mm256_broadcast_sd(plane + 4));
    r = _mm256_add_pd(_mm256_add_pd(r, _mm256_broadcast_sd(plane)), _mm256_mul_pd(_mm256_broadcast_sd(plane + 1), d));
    _mm256_storeu_pd(result, _mm256_add_pd(r, _mm256_xor_pd(cone, other)));
}

SN_DESCEND(sn_descend_wide, SN_AVX2, sn_children_wide, sn_leaf_wide)

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
#define sn_columns_wide sn_columns_plain
#define sn_descend_wide sn_descend_plain
static int sn_has_wide(void) { return 0; }
#endif

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

/* x A, of four columns and more. */
static void sn_columns(const sn_work *w, double *y, const double *A, const double *x, int64_t columns, int64_t gap,
                       int64_t n)
{
    if (w->wide)
        sn_columns_wide(y, A, x, columns, gap, n);
    else
        sn_columns_plain(y, A, x, columns, gap, n);
}

#else
SN_DESCEND(sn_descend_plain, , sn_children_plain, sn_leaf_few)
static int sn_has_wide(void) { return 0; }

static void sn_tanh_all(const sn_work *w, double *y, const double *x, int64_t n)
{
    (void)w;
    for (int64_t i = 0; i < n; i++)
        y[i] = sn_tanh(x[i]);
}
#endif

/* `tanh_each` of a runtime: so many numbers, at most two for each motor; what is behind them fills the last lanes. */
static void sn_tanh_each(const sn_work *w, int64_t n, const double *x, double *y)
{
    double from[16] = {0.0}, to[16];
    memcpy(from, x, (size_t)n * sizeof *x);
    sn_tanh_all(w, to, from, (n + 3) & ~(int64_t)3);
    memcpy(y, to, (size_t)n * sizeof *y);
}

/* Where this tree's last search ended; a tree that is new here takes the place of the one that came first. */
static sn_found *sn_found_of(sn_work *w, const sn_v2 *nodes)
{
    sn_found *found = w->found;
    while (found < w->found + SN_FOUND && found->nodes != nodes->p)
        found++;
    if (found == w->found + SN_FOUND) {
        found = w->found + w->searched++ % SN_FOUND;
        found->nodes = nodes->p;
        found->low = found->high = 0; /* no leaf */
    }
    return found;
}

/* What the runtimes' functions of these names do, with their checks made once for all entries; see `_translate.py`. */
static SN_INSIDE void sn_slant_descend(sn_work *w, const sn_v2 *points, sn_v1 values, const sn_v2 *nodes, sn_v1 at,
                                       sn_v1 plane, double gamma, sn_v1 x, sn_v1 best)
{
    int64_t sides = (int64_t)at.n - 1;
    if (SN_RARE(nodes->n0 < 2 || sides < 0 || sides % 4 != 0 || 4 + 2 * sides > nodes->n1 || plane.n < 5
                || nodes->s1 != 1 || at.s != 1 || plane.s != 1 || values.n > points->n1 || x.n > points->n0
                || best.n < 4 || points->s1 != 1 || x.s != 1 || values.s != 1 || best.s != 1))
        sn_outside(w);
    /* Bounds that are known already ask for the first leaf in the tree's order: that search takes its own way. */
    sn_found nowhere = {0}, *was = best.p[0] == -HUGE_VAL && best.p[1] == HUGE_VAL ? sn_found_of(w, nodes) : &nowhere;
#ifdef SN_LANES
    if (w->wide)
        sn_descend_wide(w, points, values, nodes, at.p, sides, plane.p, gamma, x, best.p, *was);
    else
#endif
        sn_descend_plain(w, points, values, nodes, at.p, sides, plane.p, gamma, x, best.p, *was);
    was->low = (int64_t)best.p[2];
    was->high = (int64_t)best.p[3];
}

#endif
