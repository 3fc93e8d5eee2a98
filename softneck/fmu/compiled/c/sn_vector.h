/* Whole arrays at once: what numpy does with an expression, with temporaries in the workspace. */
#ifndef SN_VECTOR_H
#define SN_VECTOR_H

#include "sn_wide.h"

#define SN_ADD(a, b) ((a) + (b))
#define SN_SUB(a, b) ((a) - (b))
#define SN_MUL(a, b) ((a) * (b))
#define SN_DIV(a, b) ((a) / (b))

/* The common length of two. */
static inline int64_t sn_same(sn_work *w, int64_t a, int64_t b)
{
    if (SN_RARE(a != b))
        sn_fault(w, SN_SHAPE);
    return a;
}

/* name_vv, _vs, _sv make a new vector; name_mm, _ms, _sm a new matrix; name_iv, _is, _im, _ims work in place. */
#define SN_PAIRS(name, OP)                                                                                          \
    static SN_INSIDE sn_v1 name##_vv(sn_work *w, sn_v1 a, sn_v1 b)                                                  \
    {                                                                                                               \
        sn_v1 r = sn_new1(w, sn_same(w, a.n, b.n));                                                                 \
        for (int64_t i = 0; i < r.n; i++)                                                                           \
            r.p[i] = OP(a.p[i * a.s], b.p[i * b.s]);                                                                \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE sn_v1 name##_vs(sn_work *w, sn_v1 a, double b)                                                 \
    {                                                                                                               \
        sn_v1 r = sn_new1(w, a.n);                                                                                  \
        for (int64_t i = 0; i < r.n; i++)                                                                           \
            r.p[i] = OP(a.p[i * a.s], b);                                                                           \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE sn_v1 name##_sv(sn_work *w, double a, sn_v1 b)                                                 \
    {                                                                                                               \
        sn_v1 r = sn_new1(w, b.n);                                                                                  \
        for (int64_t i = 0; i < r.n; i++)                                                                           \
            r.p[i] = OP(a, b.p[i * b.s]);                                                                           \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE void name##_iv(sn_work *w, sn_v1 a, sn_v1 b)                                                   \
    {                                                                                                               \
        int64_t n = sn_same(w, a.n, b.n);                                                                           \
        for (int64_t i = 0; i < n; i++)                                                                             \
            a.p[i * a.s] = OP(a.p[i * a.s], b.p[i * b.s]);                                                          \
    }                                                                                                               \
    static SN_INSIDE void name##_is(sn_work *w, sn_v1 a, double b)                                                  \
    {                                                                                                               \
        (void)w;                                                                                                    \
        for (int64_t i = 0; i < a.n; i++)                                                                           \
            a.p[i * a.s] = OP(a.p[i * a.s], b);                                                                     \
    }                                                                                                               \
    static SN_INSIDE sn_v2 name##_mm(sn_work *w, const sn_v2 *a, const sn_v2 *b)                                    \
    {                                                                                                               \
        sn_v2 r = sn_zeros2(w, sn_same(w, a->n0, b->n0), sn_same(w, a->n1, b->n1));                                 \
        for (int64_t i = 0; i < r.n0; i++)                                                                          \
            for (int64_t j = 0; j < r.n1; j++)                                                                      \
                r.p[i * r.n1 + j] = OP(a->p[i * a->s0 + j * a->s1], b->p[i * b->s0 + j * b->s1]);                   \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE sn_v2 name##_ms(sn_work *w, const sn_v2 *a, double b)                                          \
    {                                                                                                               \
        sn_v2 r = sn_zeros2(w, a->n0, a->n1);                                                                       \
        for (int64_t i = 0; i < r.n0; i++)                                                                          \
            for (int64_t j = 0; j < r.n1; j++)                                                                      \
                r.p[i * r.n1 + j] = OP(a->p[i * a->s0 + j * a->s1], b);                                             \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE sn_v2 name##_sm(sn_work *w, double a, const sn_v2 *b)                                          \
    {                                                                                                               \
        sn_v2 r = sn_zeros2(w, b->n0, b->n1);                                                                       \
        for (int64_t i = 0; i < r.n0; i++)                                                                          \
            for (int64_t j = 0; j < r.n1; j++)                                                                      \
                r.p[i * r.n1 + j] = OP(a, b->p[i * b->s0 + j * b->s1]);                                             \
        return r;                                                                                                   \
    }                                                                                                               \
    static SN_INSIDE void name##_im(sn_work *w, const sn_v2 *a, const sn_v2 *b)                                     \
    {                                                                                                               \
        int64_t n = sn_same(w, a->n0, b->n0), m = sn_same(w, a->n1, b->n1);                                         \
        for (int64_t i = 0; i < n; i++)                                                                             \
            for (int64_t j = 0; j < m; j++)                                                                         \
                a->p[i * a->s0 + j * a->s1] = OP(a->p[i * a->s0 + j * a->s1], b->p[i * b->s0 + j * b->s1]);         \
    }                                                                                                               \
    static SN_INSIDE void name##_ims(sn_work *w, const sn_v2 *a, double b)                                          \
    {                                                                                                               \
        (void)w;                                                                                                    \
        for (int64_t i = 0; i < a->n0; i++)                                                                         \
            for (int64_t j = 0; j < a->n1; j++)                                                                     \
                a->p[i * a->s0 + j * a->s1] = OP(a->p[i * a->s0 + j * a->s1], b);                                   \
    }

SN_PAIRS(sn_add, SN_ADD)
SN_PAIRS(sn_sub, SN_SUB)
SN_PAIRS(sn_mul, SN_MUL)
SN_PAIRS(sn_div, SN_DIV)

#define SN_EACH(name, OP)                                                                                           \
    static SN_INSIDE sn_v1 name##_v(sn_work *w, sn_v1 a)                                                            \
    {                                                                                                               \
        sn_v1 r = sn_new1(w, a.n);                                                                                  \
        for (int64_t i = 0; i < r.n; i++)                                                                           \
            r.p[i] = OP(a.p[i * a.s]);                                                                              \
        return r;                                                                                                   \
    }

SN_EACH(sn_negative, -)
SN_EACH(sn_absolute, fabs)
SN_EACH(sn_sqrt, sqrt)

static SN_INSIDE sn_v1 sn_tanh_v(sn_work *w, sn_v1 a)
{
    sn_v1 r = sn_new1(w, a.n);
    if (a.s == 1)
        sn_tanh_all(w, r.p, a.p, r.n);
    else
        for (int64_t i = 0; i < r.n; i++)
            r.p[i] = sn_tanh(a.p[i * a.s]);
    return r;
}

/* `narx_push` of the histories: everything moves back, the newest sample goes in front. */
static SN_INSIDE void sn_narx_push(sn_work *w, sn_v1 history, sn_v1 newest)
{
    if (SN_RARE(history.s != 1 || newest.s != 1 || newest.n > history.n))
        sn_outside(w);
    memmove(history.p + newest.n, history.p, (size_t)(history.n - newest.n) * sizeof(double));
    memmove(history.p, newest.p, (size_t)newest.n * sizeof(double));
}

static SN_INSIDE void sn_fill1(sn_v1 a, double value)
{
    for (int64_t i = 0; i < a.n; i++)
        a.p[i * a.s] = value;
}

static SN_INSIDE sn_v1 sn_copied1(sn_work *w, sn_v1 a)
{
    sn_v1 r = sn_new1(w, a.n);
    for (int64_t i = 0; i < r.n; i++)
        r.p[i] = a.p[i * a.s];
    return r;
}

static SN_INSIDE sn_v2 sn_copied2(sn_work *w, const sn_v2 *a)
{
    sn_v2 r = sn_zeros2(w, a->n0, a->n1);
    for (int64_t i = 0; i < r.n0; i++)
        for (int64_t j = 0; j < r.n1; j++)
            r.p[i * r.n1 + j] = a->p[i * a->s0 + j * a->s1];
    return r;
}

/* to[:] = from; the two may overlap, as numpy allows. */
static SN_INSIDE void sn_set1(sn_work *w, sn_v1 to, sn_v1 from)
{
    if (sn_same(w, to.n, from.n) == 0)
        return;
    if (to.s == 1 && from.s == 1) {
        memmove(to.p, from.p, (size_t)to.n * sizeof(double));
    } else {
        size_t top = w->top;
        from = sn_copied1(w, from);
        for (int64_t i = 0; i < to.n; i++)
            to.p[i * to.s] = from.p[i];
        w->top = top;
    }
}

static SN_INSIDE sn_v1 sn_flat(sn_work *w, const sn_v2 *m)
{
    int64_t n = (int64_t)m->n0 * m->n1;
    sn_v1 v = {m->p, (int32_t)n, 1};
    if (SN_RARE(n > SN_MOST_NUMBERS))
        sn_fault(w, SN_SHAPE);
    if (m->s1 != 1 || m->s0 != m->n1)
        v.p = sn_copied2(w, m).p;
    return v;
}

static SN_INSIDE sn_v2 sn_shaped(sn_work *w, sn_v1 v, int64_t n0, int64_t n1)
{
    sn_v2 m = {v.p, (int32_t)n0, (int32_t)n1, (int32_t)(n1 * v.s), v.s};
    if (n0 < 0 || n1 < 0 || n0 > SN_MOST_NUMBERS || n1 > SN_MOST_NUMBERS || n0 * n1 != v.n)
        sn_fault(w, SN_SHAPE);
    return m;
}

/* Four sums side by side, added in one fixed order: fast, and the same bits from every compiler. */
static SN_INSIDE double sn_dot(sn_work *w, sn_v1 a, sn_v1 b)
{
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int64_t i = 0, n = sn_same(w, a.n, b.n);
    if (a.s == 1 && b.s == 1) {
        for (; i + 4 <= n; i += 4) {
            s0 += a.p[i] * b.p[i];
            s1 += a.p[i + 1] * b.p[i + 1];
            s2 += a.p[i + 2] * b.p[i + 2];
            s3 += a.p[i + 3] * b.p[i + 3];
        }
    } else {
        for (; i + 4 <= n; i += 4) {
            s0 += a.p[i * a.s] * b.p[i * b.s];
            s1 += a.p[(i + 1) * a.s] * b.p[(i + 1) * b.s];
            s2 += a.p[(i + 2) * a.s] * b.p[(i + 2) * b.s];
            s3 += a.p[(i + 3) * a.s] * b.p[(i + 3) * b.s];
        }
    }
    for (; i < n; i++)
        s0 += a.p[i * a.s] * b.p[i * b.s];
    return (s0 + s2) + (s1 + s3);
}

static SN_INSIDE sn_v1 sn_dot_mv(sn_work *w, const sn_v2 *A, sn_v1 x)
{
    sn_v1 r = sn_new1(w, A->n0);
    (void)sn_same(w, A->n1, x.n);
#ifdef SN_LANES
    if (A->s1 == 1 && x.s == 1) {
        sn_rows(w, r.p, A->p, x.p, r.n, A->s0, x.n);
        return r;
    }
#endif
    for (int64_t i = 0; i < r.n; i++) {
        sn_v1 row = {A->p + i * A->s0, A->n1, A->s1};
        r.p[i] = sn_dot(w, row, x);
    }
    return r;
}

static SN_INSIDE sn_v1 sn_dot_vm(sn_work *w, sn_v1 x, const sn_v2 *A)
{
    sn_v2 t = sn_turned(A);
#ifdef SN_LANES
    if (A->s1 == 1 && x.s == 1 && A->n1 >= 4 && A->n0 == x.n) {
        sn_v1 r = sn_new1(w, A->n1);
        sn_columns(w, r.p, A->p, x.p, A->n1, A->s0, x.n);
        return r;
    }
#endif
    return sn_dot_mv(w, &t, x);
}

static SN_INSIDE double sn_largest(sn_work *w, sn_v1 a)
{
    double best = *sn_at1(w, a, 0);
    for (int64_t i = 1; i < a.n; i++)
        if (a.p[i * a.s] > best || a.p[i * a.s] != a.p[i * a.s])
            best = a.p[i * a.s];
    return best;
}

static SN_INSIDE double sn_least(sn_work *w, sn_v1 a)
{
    double best = *sn_at1(w, a, 0);
    for (int64_t i = 1; i < a.n; i++)
        if (a.p[i * a.s] < best || a.p[i * a.s] != a.p[i * a.s])
            best = a.p[i * a.s];
    return best;
}

/* Insertion: members of an ensemble are few. NaN go last, as numpy puts them. */
static SN_INSIDE sn_v1 sn_sorted(sn_work *w, sn_v1 a)
{
    sn_v1 r = sn_copied1(w, a);
    sn_rounds(w, (int64_t)r.n * r.n);
    for (int64_t i = 1; i < r.n; i++) {
        double x = r.p[i];
        int64_t j = i;
        for (; j > 0 && (x < r.p[j - 1] || (r.p[j - 1] != r.p[j - 1] && x == x)); j--)
            r.p[j] = r.p[j - 1];
        r.p[j] = x;
    }
    return r;
}

/* Where the sorted numbers stood: by insertion too, so that numbers alike keep their order. */
static SN_INSIDE sn_i1 sn_order(sn_work *w, sn_v1 a)
{
    sn_i1 r = sn_zeros_i(w, a.n);
    sn_rounds(w, (int64_t)r.n * r.n);
    for (int64_t i = 0; i < r.n; i++) {
        double x = a.p[i * a.s];
        int64_t j = i;
        for (; j > 0; j--) {
            double y = a.p[r.p[j - 1] * a.s];
            if (!(x < y || (y != y && x == x)))
                break;
            r.p[j] = r.p[j - 1];
        }
        r.p[j] = i;
    }
    return r;
}

/* Members of a runtime that holds others. */
static const sn_node *sn_member(sn_work *w, const sn_node *node, int64_t i)
{
    if (i < 0 || i >= node->member_count)
        sn_outside(w);
    return node->members + i;
}

static int64_t sn_member_size(sn_work *w, const sn_node *node, int64_t i)
{
    const sn_node *member = sn_member(w, node, i);
    return member->kind->state_size(w, member);
}

static SN_INSIDE void sn_member_initialise(sn_work *w, const sn_node *node, int64_t i, sn_v1 q, sn_v1 x, sn_v1 y)
{
    const sn_node *member = sn_member(w, node, i);
    member->kind->initialise(w, member, q, x, y);
}

static SN_INSIDE void sn_member_step(sn_work *w, const sn_node *node, int64_t i, sn_v1 q, sn_v1 x, sn_v1 u, sn_v1 y)
{
    const sn_node *member = sn_member(w, node, i);
    member->kind->step(w, member, q, x, u, y);
}

static SN_INSIDE void sn_member_tangent(sn_work *w, const sn_node *node, int64_t i, sn_v1 q, sn_v1 x, sn_v1 u, sn_v1 y,
                                        const sn_v2 *X, const sn_v2 *U, const sn_v2 *Y, int64_t m)
{
    const sn_node *member = sn_member(w, node, i);
    if (member->kind->tangent == NULL)
        sn_fault(w, "a member has no derivative in this library");
    member->kind->tangent(w, member, q, x, u, y, X, U, Y, m);
}

#endif
