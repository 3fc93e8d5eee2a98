/* Elementary functions out of IEEE operations alone, so that every platform gives the same bits.
 *
 * Each reduces its argument by a multiple of a constant that is split into parts (Cody and Waite 1980, Software Manual
 * for the Elementary Functions) and sums the Taylor series of what is left until a term falls below a tenth of the
 * last digit, in pairs of terms rather than one after the other, as processors work on several at once. sqrt, fabs, floor, ceil and fmod are exact in IEEE arithmetic and are the library's. Compile without
 * contraction to fused multiply-add. */
#ifndef SN_MATH_H
#define SN_MATH_H

#include "sn_base.h"

#define SN_PI 3.141592653589793
#define SN_LN2_HIGH 0x1.62e42feep-1 /* 32 bits: times a whole number below 2^21 it is exact */
#define SN_LN2_LOW 0x1.a39ef35793c76p-33
#define SN_PER_LN2 0x1.71547652b82fep+0
#define SN_HALF_PI_1 0x1.921fb544p+0 /* 33 bits each */
#define SN_HALF_PI_2 0x1.0b4611a6p-34
#define SN_HALF_PI_3 0x1.3198a2e037073p-69
#define SN_PER_HALF_PI 0x1.45f306dc9c883p-1
#define SN_EIGHTH 0.785 /* of a turn, less a little: no quarter is taken off, and the bits are those of doing so */
/* Added and taken off again it rounds to whole numbers; its last bits then hold that number. */
#define SN_ROUNDER 6755399441055744.0

static inline double sn_from_bits(uint64_t bits)
{
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static inline uint64_t sn_to_bits(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline int sn_finite(double x) { return x - x == 0.0; }
static inline int sn_nan(double x) { return x != x; }
static inline int sn_infinite(double x) { return x == x && x - x != 0.0; }

/* 1 / n!, nearest doubles. */
#define SN_E3 0x1.5555555555555p-3
#define SN_E4 0x1.5555555555555p-5
#define SN_E5 0x1.1111111111111p-7
#define SN_E6 0x1.6c16c16c16c17p-10
#define SN_E7 0x1.a01a01a01a01ap-13
#define SN_E8 0x1.a01a01a01a01ap-16
#define SN_E9 0x1.71de3a556c734p-19
#define SN_E10 0x1.27e4fb7789f5cp-22
#define SN_E11 0x1.ae64567f544e4p-26
#define SN_E12 0x1.1eed8eff8d898p-29
#define SN_E13 0x1.6124613a86d09p-33

/* exp(r) - 1 for |r| <= ln(2)/2. */
static SN_MERGED double sn_expm1_small(double r)
{
    double s = r * r, t = s * s, u = t * t;
    double even = ((0.5 + s * SN_E4) + t * (SN_E6 + s * SN_E8)) + u * (SN_E10 + s * SN_E12);
    double odd = ((SN_E3 + s * SN_E5) + t * (SN_E7 + s * SN_E9)) + u * (SN_E11 + s * SN_E13);
    return r + s * (even + r * odd);
}

static double sn_exp(double x)
{
    double k, high, low, r, y;
    int64_t n;
    if (!(x <= 709.782712893384))
        return x != x ? x : HUGE_VAL;
    if (x < -745.1332191019412)
        return 0.0;
    k = (x * SN_PER_LN2 + SN_ROUNDER) - SN_ROUNDER;
    high = x - k * SN_LN2_HIGH;
    low = k * SN_LN2_LOW;
    r = high - low;
    /* What `high - low` lost comes back to first order. */
    y = 1.0 + (sn_expm1_small(r) + ((high - r) - low));
    n = (int64_t)k;
    if (n > 1023)
        return y * sn_from_bits((uint64_t)(1023 + 1023) << 52) * sn_from_bits((uint64_t)(n - 1023 + 1023) << 52);
    if (n < -1022) /* one rounding into the subnormal numbers */
        return y * sn_from_bits((uint64_t)(n + 1022 + 1023) << 52) * sn_from_bits((uint64_t)1 << 52);
    return y * sn_from_bits((uint64_t)(n + 1023) << 52);
}

static double sn_log(double x)
{
    double k = 0.0, f, s, z, tail;
    uint64_t bits;
    if (!(x > 0.0))
        return x == 0.0 ? -HUGE_VAL : sn_from_bits(0x7ff8000000000000u);
    if (x > DBL_MAX)
        return x;
    if (x < DBL_MIN) {
        x *= 18014398509481984.0; /* 2^54 */
        k = -54.0;
    }
    bits = sn_to_bits(x);
    k += (double)(int64_t)(bits >> 52) - 1023.0;
    x = sn_from_bits((bits & 0x000fffffffffffffu) | 0x3ff0000000000000u);
    if (x > 1.4142135623730951) {
        x *= 0.5;
        k += 1.0;
    }
    /* log(1 + f) = 2 atanh(s), s = f / (2 + f); f - f^2/2 taken apart keeps the last digit. */
    f = x - 1.0;
    s = f / (2.0 + f);
    z = s * s;
    tail = z * (2.0 / 3.0 + z * (2.0 / 5.0 + z * (2.0 / 7.0 + z * (2.0 / 9.0 + z * (2.0 / 11.0 + z * (2.0 / 13.0
        + z * (2.0 / 15.0 + z * (2.0 / 17.0 + z * (2.0 / 19.0 + z * (2.0 / 21.0))))))))));
    z = 0.5 * f * f;
    return k * SN_LN2_HIGH - ((z - (s * (z + tail) + k * SN_LN2_LOW)) - f);
}

/* r + t = x - n pi/2 with |r| <= pi/4 or a little more; returns n modulo 4. */
static int sn_quarters(double x, double *r, double *t)
{
    double n, a, b, c;
    if (fabs(x) > 500000.0) /* so far out a rounding error of the turn is more than one of the angle */
        x = fmod(x, 2.0 * SN_PI);
    n = (x * SN_PER_HALF_PI + SN_ROUNDER) - SN_ROUNDER;
    a = x - n * SN_HALF_PI_1;
    b = n * SN_HALF_PI_2;
    c = a - b;
    *t = ((a - c) - b) - n * SN_HALF_PI_3;
    *r = c + *t;
    *t = (c - *r) + *t;
    return (int)((int64_t)n & 3);
}

static inline double sn_sin_small(double r, double t)
{
    double z = r * r;
    double z2 = z * z, z4 = z2 * z2;
    double p = ((-0x1.5555555555555p-3 + z * 0x1.1111111111111p-7) + z2 * (-0x1.a01a01a01a01ap-13
        + z * 0x1.71de3a556c734p-19)) + z4 * ((-0x1.ae64567f544e4p-26 + z * 1.6059043836821613e-10)
        + z2 * (-7.647163731819816e-13 + z * 2.8114572543455206e-15));
    return r + (t * (1.0 - 0.5 * z) + r * z * p);
}

static inline double sn_cos_small(double r, double t)
{
    double z = r * r, half = 0.5 * z, high = 1.0 - half;
    double z2 = z * z, z4 = z2 * z2;
    double p = ((0x1.5555555555555p-5 - z * 0x1.6c16c16c16c17p-10) + z2 * (0x1.a01a01a01a01ap-16
        - z * 0x1.27e4fb7789f5cp-22)) + z4 * ((0x1.1eed8eff8d898p-29 - z * 1.1470745597729725e-11)
        + z2 * (4.779477332387385e-14 - z * 1.5619206968586225e-16));
    return high + (((1.0 - high) - half) + (z2 * p - r * t));
}

static double sn_sin(double x)
{
    double r, t, y;
    int n;
    if (fabs(x) < SN_EIGHTH)
        return sn_sin_small(x, 0.0);
    if (!sn_finite(x))
        return x - x;
    n = sn_quarters(x, &r, &t);
    y = n & 1 ? sn_cos_small(r, t) : sn_sin_small(r, t);
    return n & 2 ? -y : y;
}

static double sn_cos(double x)
{
    double r, t, y;
    int n;
    if (fabs(x) < SN_EIGHTH)
        return sn_cos_small(x, 0.0);
    if (!sn_finite(x))
        return x - x;
    n = sn_quarters(x, &r, &t);
    y = n & 1 ? sn_sin_small(r, t) : sn_cos_small(r, t);
    return n == 1 || n == 2 ? -y : y;
}

static double sn_tan(double x)
{
    double r, t;
    int n;
    if (!sn_finite(x))
        return x - x;
    n = sn_quarters(x, &r, &t);
    return n & 1 ? -sn_cos_small(r, t) / sn_sin_small(r, t) : sn_sin_small(r, t) / sn_cos_small(r, t);
}

/* tanh(|x|) = e / (e + 2) with e = exp(2 |x|) - 1; no branch, so that compilers take several at once. */
static inline double sn_tanh(double x)
{
    double a = fabs(x), c = a < 22.0 ? a : 22.0; /* tanh(22) is 1 */
    double shifted = 2.0 * c * SN_PER_LN2 + SN_ROUNDER;
    double k = shifted - SN_ROUNDER;
    double r = (2.0 * c - k * SN_LN2_HIGH) - k * SN_LN2_LOW;
    double scale = sn_from_bits((sn_to_bits(shifted) + 1023u) << 52);
    double e = scale * sn_expm1_small(r) + (scale - 1.0);
    double y = e / (e + 2.0);
    y = sn_from_bits(sn_to_bits(y) | (sn_to_bits(x) & 0x8000000000000000u));
    return x == x ? y : x;
}

/* atan of |t| <= 1/16 beyond its first term. */
static inline double sn_atan_small(double t)
{
    double z = t * t, z2 = z * z;
    return -t * z * ((1.0 / 3.0 - z * (1.0 / 5.0)) + z2 * ((1.0 / 7.0 - z * (1.0 / 9.0))
        + z2 * (1.0 / 11.0 - z * (1.0 / 13.0))));
}

/* atan(y / x) for 0 <= y <= x, x > 0: next to the nearest eighth. */
static double sn_atan_quotient(double y, double x)
{
    static const double high[9] = {0.0, 0.12435499454676144, 0.24497866312686414, 0.35877067027057225,
        0.4636476090008061, 0.5585993153435624, 0.6435011087932844, 0.7188299996216245, 0.7853981633974483};
    static const double low[9] = {0.0, -3.1253241424539383e-18, 1.0698755618734451e-17, -2.4623815582638635e-17,
        2.2698777452961687e-17, -5.4556305485916264e-18, 1.5834785051444286e-17, -2.1478388444456983e-17,
        3.061616997868383e-17};
    double q = y / x, c, t;
    int k = (int)(8.0 * q + 0.5);
    if (k == 0)
        return q + sn_atan_small(q);
    c = 0.125 * k;
    t = (q - c) / (1.0 + c * q);
    return high[k] + (t + (low[k] + sn_atan_small(t)));
}

static double sn_atan2(double y, double x)
{
    double a = fabs(x), b = fabs(y), r;
    if (x != x || y != y)
        return x + y;
    if (b == 0.0)
        r = 0.0;
    else if (a > DBL_MAX && b > DBL_MAX)
        r = 0.25 * SN_PI;
    else if (b <= a)
        r = a > DBL_MAX ? 0.0 : sn_atan_quotient(b, a);
    else
        r = 0.5 * SN_PI - ((b > DBL_MAX ? 0.0 : sn_atan_quotient(a, b)) - 6.123233995736766e-17);
    if (sn_to_bits(x) >> 63)
        r = SN_PI - (r - 1.2246467991473532e-16);
    return sn_to_bits(y) >> 63 ? -r : r;
}

static double sn_atan(double x) { return sn_atan2(x, 1.0); }

/* a % b of Python: the sign of b. */
static double sn_fmod(double a, double b)
{
    double r, q;
    /* Whole numbers, as random numbers are made of: the product is exact, and one more or less is made good. */
    if (fabs(a) < SN_WHOLE && b > 0.0 && b < SN_WHOLE && a == (double)(int64_t)a && b == (double)(int64_t)b) {
        q = a / b;
        r = a - (double)(int64_t)q * b;
        return r < 0.0 ? r + b : r < b ? r : r - b;
    }
    r = fmod(a, b);
    if (r != 0.0 && (r < 0.0) != (b < 0.0))
        r += b;
    return r;
}

static double sn_power_whole(double x, int n)
{
    double y = 1.0;
    for (int i = 0; i < (n < 0 ? -n : n); i++)
        y *= x;
    return n < 0 ? 1.0 / y : y;
}

#endif
