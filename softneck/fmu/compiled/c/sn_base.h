/* What the translated runtimes stand on: views of arrays whose every access is checked, a workspace instead of
 * malloc, and a budget of loop rounds, so that no model file makes a step read elsewhere, allocate or hang. What breaks
 * a rule leaves the step at once, back to `sn_guarded`: a check is one comparison and one jump that all of a function
 * share, which is a third of the library and the faster code. */
#ifndef SN_BASE_H
#define SN_BASE_H

#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifdef __GNUC__
#define SN_LEAVES __attribute__((noinline, cold, noreturn))
#define SN_APART __attribute__((noinline)) /* called so often that copies of it would be most of the library */
#define SN_MERGED inline __attribute__((always_inline))
#define SN_RARE(x) __builtin_expect(!!(x), 0)
#define SN_SOON(p) __builtin_prefetch(p)
#if defined(__has_attribute)
#if __has_attribute(minsize)
#define SN_SMALL __attribute__((minsize)) /* short before fast */
#endif
#endif
#else
#define SN_LEAVES
#define SN_APART
#define SN_MERGED inline
#define SN_RARE(x) (x)
#define SN_SOON(p) (void)(p)
#endif
#ifndef SN_SMALL
#define SN_SMALL
#endif

/* Windows hands a vector over in memory; among ourselves it goes in registers as everywhere else. */
#if defined(_WIN32) && defined(__x86_64__) && defined(__GNUC__)
#define SN_INSIDE __attribute__((sysv_abi))
#else
#define SN_INSIDE
#endif

/* The way out of a step. The compiler's own pair saves three registers; the library's may ask the system for a signal
 * mask (macOS) or unwind (Windows). */
#if defined(__GNUC__) && defined(__x86_64__)
typedef void *sn_way[5];
#define SN_STAY(way) __builtin_setjmp(way)
#define SN_LEAVE(way) __builtin_longjmp(way, 1)
#else
#include <setjmp.h>
typedef jmp_buf sn_way;
#if defined(__APPLE__)
#define SN_STAY(way) _setjmp(way)
#define SN_LEAVE(way) _longjmp(way, 1)
#else
#define SN_STAY(way) setjmp(way)
#define SN_LEAVE(way) longjmp(way, 1)
#endif
#endif

/* Rounds of loops that one call may take: seconds, where an honest step takes microseconds. */
#ifndef SN_FUEL
#define SN_FUEL 1000000000LL
#endif
/* Largest whole number that a double carries exactly; beyond it `int` of Python would be a long one. */
#define SN_WHOLE 9007199254740992.0

/* Arrays. No array has more numbers than 32 bits count, so that a vector fits two registers. */
typedef struct { double *p; int32_t n, s; } sn_v1;             /* (n,), stride in elements */
typedef struct { double *p; int32_t n0, n1, s0, s1; } sn_v2;   /* (n0, n1) */
typedef struct { double *p; int32_t n0, n1, n2, s0, s1, s2; } sn_v3;
typedef struct { int64_t *p; int32_t n, s; } sn_i1;
#define SN_MOST_NUMBERS 2147483647

struct sn_kind;
typedef struct {
    sn_v1 v1; /* the one that `rank` tells */
    sn_v2 v2;
    sn_v3 v3;
    int32_t n[3], rank;
} sn_array;
typedef struct sn_node {
    const struct sn_kind *kind;
    sn_array *arrays;
    struct sn_node *members;
    int32_t array_count, member_count;
} sn_node;

/* The leaves in which a tree's bounds were found last: the next search begins there, and finds the same as from anywhere. */
typedef struct { const double *nodes; int64_t low, high; } sn_found;
enum { SN_FOUND = 16 };

typedef struct {
    unsigned char *base;
    size_t size, top, peak;
    int64_t fuel;
    const char *fault; /* why the step is worth nothing, NULL while it is */
    int wide;          /* this processor takes four numbers at a time */
    sn_way out;        /* where a step goes that is worth nothing */
    sn_found found[SN_FOUND];
    unsigned searched; /* trees */
} sn_work;

typedef struct sn_kind {
    const char *name;
    const signed char *ranks;
    int32_t array_count, has_members;
    int64_t (SN_INSIDE *state_size)(sn_work *, const sn_node *);
    void (SN_INSIDE *initialise)(sn_work *, const sn_node *, sn_v1, sn_v1, sn_v1);
    void (SN_INSIDE *step)(sn_work *, const sn_node *, sn_v1, sn_v1, sn_v1, sn_v1);
    /* The same along so many directions, a column each (softneck.runtime._tangent); NULL in libraries without. */
    void (SN_INSIDE *tangent)(sn_work *, const sn_node *, sn_v1, sn_v1, sn_v1, sn_v1, const sn_v2 *, const sn_v2 *,
                              const sn_v2 *, int64_t);
} sn_kind;

SN_LEAVES static void sn_fault(sn_work *w, const char *why)
{
    w->fault = why;
    SN_LEAVE(w->out);
}

static const char SN_INDEX[] = "an index is outside of its array: model file and kind do not fit together";
static const char SN_SHAPE[] = "shapes do not fit: model file and kind do not fit together";
static const char SN_HANGS[] = "a loop does not end: model file and kind do not fit together";
static const char SN_FULL[] = "the workspace is too small: model file and kind do not fit together";
static const char SN_NUMBER[] = "a number is too large or not whole where one is counted with";

SN_LEAVES static void sn_outside(sn_work *w) { sn_fault(w, SN_INDEX); }

/* Workspace: a stack that a function leaves as it found it. */
SN_APART static void *sn_room(sn_work *w, int64_t count, size_t each)
{
    size_t bytes;
    void *room;
    if (count < 0 || count > SN_MOST_NUMBERS || (uint64_t)count > w->size / each)
        sn_fault(w, SN_FULL);
    bytes = ((size_t)count * each + 15u) & ~(size_t)15u;
    if (bytes > w->size - w->top)
        sn_fault(w, SN_FULL);
    room = w->base + w->top;
    w->top += bytes;
    if (w->top > w->peak)
        w->peak = w->top;
    return room;
}

static SN_INSIDE inline sn_v1 sn_new1(sn_work *w, int64_t n)
{
    sn_v1 v = {(double *)sn_room(w, n, sizeof(double)), (int32_t)n, 1};
    return v;
}

SN_APART static SN_INSIDE sn_v1 sn_zeros1(sn_work *w, int64_t n)
{
    sn_v1 v = sn_new1(w, n);
    memset(v.p, 0, (size_t)n * sizeof(double));
    return v;
}

SN_APART static SN_INSIDE sn_v2 sn_zeros2(sn_work *w, int64_t n0, int64_t n1)
{
    sn_v2 m = {NULL, (int32_t)n0, (int32_t)n1, (int32_t)n1, 1};
    if (n0 < 0 || n0 > SN_MOST_NUMBERS || n1 < 0 || n1 > SN_MOST_NUMBERS || n0 * n1 > SN_MOST_NUMBERS)
        sn_fault(w, SN_FULL);
    m.p = sn_zeros1(w, n0 * n1).p;
    return m;
}

SN_APART static SN_INSIDE sn_v3 sn_zeros3(sn_work *w, int64_t n0, int64_t n1, int64_t n2)
{
    sn_v2 all;
    if (n1 < 0 || n1 > SN_MOST_NUMBERS || n2 < 0 || n2 > SN_MOST_NUMBERS)
        sn_fault(w, SN_FULL);
    all = sn_zeros2(w, n0, n1 * n2);
    sn_v3 c = {all.p, all.n0, (int32_t)n1, (int32_t)n2, all.s0, (int32_t)n2, 1};
    return c;
}

SN_APART static SN_INSIDE sn_i1 sn_zeros_i(sn_work *w, int64_t n)
{
    sn_i1 v = {(int64_t *)sn_room(w, n, sizeof(int64_t)), (int32_t)n, 1};
    memset(v.p, 0, (size_t)n * sizeof(int64_t));
    return v;
}

/* Entries. */
static SN_INSIDE inline double *sn_at1(sn_work *w, sn_v1 v, int64_t i)
{
    if (SN_RARE((uint64_t)i >= (uint64_t)v.n))
        sn_outside(w);
    return v.p + i * v.s;
}

static SN_INSIDE inline int64_t *sn_at_i(sn_work *w, sn_i1 v, int64_t i)
{
    if (SN_RARE((uint64_t)i >= (uint64_t)v.n))
        sn_outside(w);
    return v.p + i * v.s;
}

static SN_INSIDE inline double *sn_at2(sn_work *w, const sn_v2 *m, int64_t i, int64_t j)
{
    if (SN_RARE((uint64_t)i >= (uint64_t)m->n0 || (uint64_t)j >= (uint64_t)m->n1))
        sn_outside(w);
    return m->p + i * m->s0 + j * m->s1;
}

static SN_INSIDE inline double *sn_at3(sn_work *w, const sn_v3 *c, int64_t i, int64_t j, int64_t k)
{
    if (SN_RARE((uint64_t)i >= (uint64_t)c->n0 || (uint64_t)j >= (uint64_t)c->n1 || (uint64_t)k >= (uint64_t)c->n2))
        sn_outside(w);
    return c->p + i * c->s0 + j * c->s1 + k * c->s2;
}

/* Parts. */
SN_APART static SN_INSIDE sn_v1 sn_row2(sn_work *w, const sn_v2 *m, int64_t i)
{
    sn_v1 v = {m->p, m->n1, m->s1};
    if (SN_RARE((uint64_t)i >= (uint64_t)m->n0))
        sn_outside(w);
    v.p += i * m->s0;
    return v;
}

SN_APART static SN_INSIDE sn_v2 sn_row3(sn_work *w, const sn_v3 *c, int64_t i)
{
    sn_v2 m = {c->p, c->n1, c->n2, c->s1, c->s2};
    if (SN_RARE((uint64_t)i >= (uint64_t)c->n0))
        sn_outside(w);
    m.p += i * c->s0;
    return m;
}

static SN_INSIDE inline sn_v2 sn_turned(const sn_v2 *m)
{
    sn_v2 t = {m->p, m->n1, m->n0, m->s1, m->s0};
    return t;
}

/* v[a:b] as Python cuts it; a negative border of a variable is refused: none of ours means one. */
SN_APART static SN_INSIDE sn_v1 sn_cut(sn_work *w, sn_v1 v, int64_t a, int64_t b)
{
    sn_v1 r = {v.p, 0, v.s};
    if (SN_RARE(a < 0 || b < 0))
        sn_outside(w);
    if (b > v.n)
        b = v.n;
    if (a < b) {
        r.p += a * v.s;
        r.n = (int32_t)(b - a);
    }
    return r;
}

SN_APART static SN_INSIDE sn_v2 sn_cut2(sn_work *w, const sn_v2 *m, int64_t a, int64_t b)
{
    sn_v2 r = {m->p, 0, m->n1, m->s0, m->s1};
    if (SN_RARE(a < 0 || b < 0))
        sn_outside(w);
    if (b > m->n0)
        b = m->n0;
    if (a < b) {
        r.p += a * m->s0;
        r.n0 = (int32_t)(b - a);
    }
    return r;
}

/* Loops. */
static inline void sn_rounds(sn_work *w, int64_t rounds)
{
    if (SN_RARE(rounds > w->fuel))
        sn_fault(w, SN_HANGS);
    if (rounds > 0)
        w->fuel -= rounds;
}

/* Whole numbers, as Python counts. */
SN_APART static int64_t sn_int(sn_work *w, double x)
{
    if (SN_RARE(!(x > -SN_WHOLE && x < SN_WHOLE)))
        sn_fault(w, SN_NUMBER);
    return (int64_t)x;
}

/* The same where it is called: what is compiled for speed takes it. */
static inline int64_t sn_int_here(sn_work *w, double x)
{
    if (SN_RARE(!(x > -SN_WHOLE && x < SN_WHOLE)))
        sn_fault(w, SN_NUMBER);
    return (int64_t)x;
}

static inline int64_t sn_times(sn_work *w, int64_t a, int64_t b)
{
    /* Exact in int64 while both stay below 2^31; what an honest model counts does. */
    if (SN_RARE(a < -2147483647 || a > 2147483647 || b < -2147483647 || b > 2147483647))
        sn_fault(w, SN_NUMBER);
    return a * b;
}

SN_APART static int64_t sn_floor_divide(sn_work *w, int64_t a, int64_t b)
{
    int64_t q;
    if (SN_RARE(b == 0))
        sn_fault(w, SN_NUMBER);
    if (b == -1)
        return a == INT64_MIN ? 0 : -a;
    q = a / b;
    return a % b != 0 && (a < 0) != (b < 0) ? q - 1 : q;
}

SN_APART static int64_t sn_modulo(sn_work *w, int64_t a, int64_t b)
{
    int64_t r;
    if (SN_RARE(b == 0))
        sn_fault(w, SN_NUMBER);
    if (b == -1)
        return 0;
    r = a % b;
    return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}

static inline int64_t sn_min_i(int64_t a, int64_t b) { return b < a ? b : a; }
static inline int64_t sn_max_i(int64_t a, int64_t b) { return b > a ? b : a; }
static inline double sn_min(double a, double b) { return b < a ? b : a; }
static inline double sn_max(double a, double b) { return b > a ? b : a; }

#endif
