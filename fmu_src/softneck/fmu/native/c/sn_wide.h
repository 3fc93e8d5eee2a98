/* The two loops of a network, four numbers at a time: AVX2 where the processor has it, else what it has. Every lane does
 * what the scalar code does, and the order of all sums is written down, so that the bits are the same either way. */
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

#define SN_TANH_ALL(name, attribute)                                                                                \
    attribute static void name(double *restrict y, const double *restrict x, int64_t n)                             \
    {                                                                                                               \
        for (int64_t i = 0; i < n; i += 4) {                                                                        \
            size_t bytes = (n - i < 4 ? (size_t)(n - i) : 4u) * sizeof(double);                                     \
            sn_d4 a = {0.0, 0.0, 0.0, 0.0}, b;                                                                      \
            if (bytes == sizeof a) {                                                                                \
                memcpy(&a, x + i, sizeof a);                                                                        \
                SN_TANH4(b, a);                                                                                     \
                memcpy(y + i, &b, sizeof b);                                                                        \
            } else {                                                                                                \
                memcpy(&a, x + i, bytes);                                                                           \
                SN_TANH4(b, a);                                                                                     \
                memcpy(y + i, &b, bytes);                                                                           \
            }                                                                                                       \
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

SN_TANH_ALL(sn_tanh_all_plain, )
SN_ROWS(sn_rows_plain, )

#if defined(__x86_64__)
#include <cpuid.h>
#define SN_AVX2 __attribute__((target("avx2")))
SN_TANH_ALL(sn_tanh_all_wide, SN_AVX2)
SN_ROWS(sn_rows_wide, SN_AVX2)

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
#else
static int sn_has_wide(void) { return 0; }

static void sn_tanh_all(const sn_work *w, double *y, const double *x, int64_t n)
{
    (void)w;
    for (int64_t i = 0; i < n; i++)
        y[i] = sn_tanh(x[i]);
}
#endif

#endif
