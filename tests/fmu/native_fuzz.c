/* Model files and FMU states with wrong bytes, under the address and undefined-behaviour sanitizers.
 *
 *     native_fuzz ROUNDS SEED MODEL.bin...
 *
 * Each round changes some bytes, mends length and checksum (else nothing behind them would ever be read), and loads,
 * steps, saves and restores what comes out. The first round of a file changes nothing and must work without memory
 * being asked for in a step. Deterministic: xorshift from SEED. */
#include <stdio.h>
#include <stdlib.h>

static long taken;
static void *counted_malloc(size_t n) { taken++; return malloc(n); }
static void *counted_calloc(size_t n, size_t m) { taken++; return calloc(n, m); }
static void *counted_realloc(void *p, size_t n) { taken++; return realloc(p, n); }
#define malloc counted_malloc
#define calloc counted_calloc
#define realloc counted_realloc
#define SN_FUEL 200000LL /* rounds of loops: enough for what is honest here, little where it is not */
#include "softneck.c"

static uint64_t noise;
static int refused, stepped;

static uint64_t draw(void)
{
    noise ^= noise << 13;
    noise ^= noise >> 7;
    noise ^= noise << 17;
    return noise;
}

static double number(void)
{
    static const double odd[] = {0.0, -1.0, 1e300, -1e300, 1e18, 4294967296.0, -9e15, 3.5, 1e-310};
    double x;
    uint64_t bits = draw();
    memcpy(&x, &bits, sizeof x);
    return bits % 3 == 0 ? odd[draw() % 9] : bits % 3 == 1 ? x : (double)(int64_t)(draw() % 64);
}

static void spoil(unsigned char *bytes, size_t size, size_t first)
{
    for (int k = (int)(draw() % 6) + 1; k > 0; k--) {
        size_t at = first + (size_t)(draw() % (size - first));
        double x = number();
        if (draw() % 2 && at + 8 < size)
            memcpy(bytes + (at & ~(size_t)7), &x, 8);
        else
            bytes[at] = (unsigned char)draw();
    }
}

static void quiet(void *self, int status, const char *text)
{
    (void)self, (void)status, (void)text;
    refused++;
}

/* The outputs of the next sample and what moves them, of any variables by any. */
static void look(sn_instance *s, int wild)
{
    uint32_t unknown[4], known[4];
    double seeds[4], moved[4];
    for (int i = 0; i < 4; i++) {
        unknown[i] = wild && draw() % 8 == 0 ? (uint32_t)draw() : s->model.n_in + (uint32_t)(draw() % s->model.n_out);
        known[i] = wild && draw() % 8 == 0 ? (uint32_t)draw() : (uint32_t)(draw() % s->model.n_in);
        seeds[i] = wild ? number() : 1.0;
    }
    (void)sn_get(s, s->model.n_in + s->model.n_out - 1, moved);
    (void)sn_derivative(s, unknown, 4, known, 4, seeds, moved);
}

static int steps(sn_instance *s, int count, int wild)
{
    for (int k = 0; k < count; k++) {
        for (uint32_t i = 0; i < s->model.n_in; i++)
            (void)sn_set(s, i, s->model.ports[i].flags & SN_BOOLEAN ? (double)(draw() % 8 > 0)
                               : wild ? number() : 0.01 * (double)(draw() % 64));
        if (s->model.next > 0 && s->model.n_in > 0)
            look(s, wild);
        if (!sn_do_step(s, s->start + (double)s->count * s->model.sample_time, s->model.sample_time))
            return 0;
        stepped++;
    }
    return 1;
}

static void restore(sn_instance *s)
{
    sn_snapshot *taken_now = sn_take_snapshot(s, NULL), *back;
    size_t size = sn_serial_bytes(s);
    unsigned char *text = (unsigned char *)malloc(size);
    uint32_t crc;
    if (taken_now != NULL && text != NULL) {
        sn_serialise(s, taken_now, text);
        spoil(text, size, draw() % 4 ? SN_SERIAL_HEAD : 0);
        crc = sn_crc32(text + 24, size - 24);
        memcpy(text + 16, &crc, 4);
        back = sn_deserialise(s, text, draw() % 16 ? size : size - 1);
        if (back != NULL) {
            sn_go_back(s, back);
            (void)steps(s, 3, 1);
        }
        free(back);
    }
    free(taken_now);
    free(text);
}

static int one(const unsigned char *file, size_t size, int honest)
{
    char error[SN_TEXT];
    sn_instance *s = (sn_instance *)calloc(1, sizeof *s);
    size_t length = honest || draw() % 8 ? size : (size_t)(draw() % size) + 1;
    unsigned char *bytes = (unsigned char *)malloc(length);
    uint64_t stated = length;
    uint32_t crc;
    long before;
    int works = 0;
    memcpy(bytes, file, length);
    if (!honest) {
        /* Mostly in the part before the arrays' bulk: lengths, kinds, tables. */
        spoil(bytes, draw() % 2 && length > 4096 ? 4096 : length, 0);
        if (length > SN_HEAD && draw() % 16) {
            memcpy(bytes, file, 16);
            memcpy(bytes + 16, &stated, 8);
            crc = sn_crc32(bytes + SN_HEAD, length - SN_HEAD);
            memcpy(bytes + 24, &crc, 4);
        }
    }
    s->tell = quiet;
    if (sn_parse_model(&s->model, bytes, length, "fuzz", error) && sn_make_room(s)) {
        sn_restart(s);
        if (sn_begin(s, 0.0, SN_NEVER) && sn_run(s)) {
            before = taken;
            works = steps(s, 20, !honest);
            if (honest && taken != before) {
                fprintf(stderr, "%s: a step asked for memory\n", s->model.name);
                exit(3);
            }
            restore(s);
        }
    }
    sn_free_instance(s);
    return works;
}

int main(int argc, char **argv)
{
    int rounds = argc > 3 ? atoi(argv[1]) : 0;
    noise = argc > 3 ? strtoull(argv[2], NULL, 10) * 2654435769u + 1 : 1;
    for (int f = 3; f < argc; f++) {
        static unsigned char file[1 << 22];
        FILE *stream = fopen(argv[f], "rb");
        size_t size = stream != NULL ? fread(file, 1, sizeof file, stream) : 0;
        if (stream != NULL)
            fclose(stream);
        if (size == 0 || !one(file, size, 1)) {
            fprintf(stderr, "%s: does not run as it is\n", argv[f]);
            return 2;
        }
        for (int k = 0; k < rounds; k++)
            (void)one(file, size, 0);
    }
    printf("%d files, %d samples, %d refusals\n", argc - 3, stepped, refused);
    return 0;
}
