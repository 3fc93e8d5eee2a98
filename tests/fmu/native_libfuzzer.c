/* libFuzzer's way in: model files, FMU states, calls of hosts with values as an XML may state them, and texts. The first
 * byte says which.
 *
 *     clang -g -O1 -fsanitize=fuzzer,address,undefined -o fuzzer native_libfuzzer.c -lm
 *     SOFTNECK_MODELS=FOLDER ./fuzzer -max_total_time=120 CORPUS
 *
 * Length and checksum are mended, else nothing behind them would ever be read. FOLDER holds 0.bin, 1.bin, ...: honest
 * models, whose states and values are what the second and third kind of bytes are about. */
#include <stdio.h>
#include <stdlib.h>

#define SN_FUEL 20000LL /* rounds of loops: enough for what is honest here, little where it is not */
#include "softneck.c"

enum { MODEL, STATE, CALLS, TEXTS, KINDS };
#define MOST_CALLS 64 /* an input should take milliseconds */
#define MOST 64
static sn_instance *honest[MOST];
static int count;

static void quiet(void *self, int status, const char *text)
{
    (void)self, (void)status, (void)text;
}

/* A double out of the next bytes; zero behind the end. */
static double number(const uint8_t **at, const uint8_t *end)
{
    double x = 0.0;
    size_t left = (size_t)(end - *at), n = left < 8 ? left : 8;
    memcpy(&x, *at, n);
    *at += n;
    return x;
}

static void steps(sn_instance *s, int rounds, const uint8_t *at, const uint8_t *end)
{
    for (int k = 0; k < rounds; k++) {
        for (uint32_t i = 0; i < s->model.n_in; i++)
            (void)sn_set(s, i, number(&at, end));
        if (!sn_do_step(s, s->start + (double)s->count * s->model.sample_time, s->model.sample_time))
            return;
    }
}

static void model(const uint8_t *data, size_t size)
{
    char error[SN_TEXT];
    sn_instance *s = (sn_instance *)calloc(1, sizeof *s);
    unsigned char *bytes = (unsigned char *)malloc(size + 1);
    uint64_t stated = size;
    uint32_t crc;
    if (size > 0)
        memcpy(bytes, data, size);
    if (size > SN_HEAD) {
        memcpy(bytes + 16, &stated, 8);
        crc = sn_crc32(bytes + SN_HEAD, size - SN_HEAD);
        memcpy(bytes + 24, &crc, 4);
    }
    s->tell = quiet;
    if (sn_parse_model(&s->model, bytes, size, "fuzz", error) && sn_make_room(s)) {
        sn_restart(s);
        if (sn_begin(s, 0.0, SN_NEVER) && sn_run(s))
            steps(s, 4, data, data + size);
    }
    sn_free_instance(s);
}

static void state(sn_instance *s, const uint8_t *data, size_t size)
{
    size_t full = sn_serial_bytes(s);
    unsigned char *text = (unsigned char *)calloc(full, 1);
    sn_snapshot *taken = sn_take_snapshot(s, NULL), *back;
    uint32_t crc;
    if (taken != NULL) {
        sn_serialise(s, taken, text);
        if (size > 0) /* beyond the head whatever came; what is missing stays honest */
            memcpy(text + SN_SERIAL_HEAD, data, size < full - SN_SERIAL_HEAD ? size : full - SN_SERIAL_HEAD);
        crc = sn_crc32(text + 24, full - 24);
        memcpy(text + 16, &crc, 4);
        free(sn_deserialise(s, data, size));
        back = sn_deserialise(s, text, full);
        if (back != NULL) {
            sn_go_back(s, back);
            steps(s, 3, data, data + size);
        }
        free(back);
    }
    free(taken);
    free(text);
}

/* What a host may call, in any order, with any numbers: nine bytes each. */
static void calls(sn_instance *s, const uint8_t *data, size_t size)
{
    const uint8_t *end = data + size;
    for (int k = 0; k < MOST_CALLS && data < end; k++) {
        uint8_t what = *data++;
        unsigned reference = what >> 3;
        double x = number(&data, end), y;
        int flag = x > 0.5;
        switch (what & 7) {
        case 0: (void)fmi2SetReal(s, &reference, 1, &x); break;
        case 1: (void)fmi3SetFloat64(s, &reference, 1, &x, 1); break;
        case 2: (void)fmi2SetBoolean(s, &reference, 1, &flag); break;
        case 3: (void)fmi2GetReal(s, &reference, 1, &y); break;
        /* A host may ask for an hour at once, and waits for it; not here. */
        case 4: (void)fmi2DoStep(s, s->time, x > 4.0 * s->model.sample_time && x < 1e12 ? 0.0 : x, 1); break;
        case 5: (void)fmi3DoStep(s, s->time, s->model.sample_time, 0, NULL, NULL, NULL, &y); break;
        case 6: (void)fmi2Reset(s); break;
        default: (void)fmi2SetupExperiment(s, 0, 0.0, x, 0, 0.0), (void)fmi2ExitInitializationMode(s);
        }
    }
}

/* What stands in a model description or comes from a host as text: name, GUID, location of the resources. */
static void texts(const uint8_t *data, size_t size)
{
    char *text = (char *)calloc(size + 3, 1), *second, *third;
    fmi2CallbackFunctions none = {NULL};
    memcpy(text, data, size);
    second = text + strlen(text) + 1;
    third = second < text + size ? second + strlen(second) + 1 : second;
    fmi2FreeInstance(fmi2Instantiate(third, fmi2CoSimulation, second, text, &none, 0, 0));
    fmi3FreeInstance(fmi3InstantiateCoSimulation(third, second, text, 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL));
    free(text);
}

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    const char *folder = getenv("SOFTNECK_MODELS");
    char path[4096], error[SN_TEXT];
    (void)argc, (void)argv;
    for (; count < MOST && folder != NULL; count++) {
        sn_instance *s = (sn_instance *)calloc(1, sizeof *s);
        s->tell = quiet;
        snprintf(path, sizeof path, "%s/%d.bin", folder, count);
        if (!sn_load_model(&s->model, path, error) || !sn_make_room(s)) {
            sn_free_instance(s);
            break;
        }
        honest[count] = s;
    }
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    sn_instance *s;
    if (size < 2)
        return 0;
    if (data[0] % KINDS == MODEL || count == 0) {
        model(data + 1, size - 1);
        return 0;
    }
    if (data[0] % KINDS == TEXTS) {
        texts(data + 1, size - 1);
        return 0;
    }
    s = honest[data[1] % count];
    sn_restart(s);
    if (data[0] % KINDS == CALLS)
        calls(s, data + 2, size - 2);
    else if (sn_begin(s, 0.0, SN_NEVER) && sn_run(s))
        state(s, data + 2, size - 2);
    return 0;
}
