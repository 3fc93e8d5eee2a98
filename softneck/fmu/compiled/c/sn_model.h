/* resources/model.bin: ports, kinds and arrays (written by `_model_file.py`). Nothing in it is believed: each length
 * is checked against what is left of the file, each kind and rank against the library, the whole by its CRC-32. */
#ifndef SN_MODEL_H
#define SN_MODEL_H

#include <stdarg.h>
#include <stdio.h>
#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#endif

#include "sn_kinds.h"

#define SN_FORMAT 3u
#define SN_HEAD 32
#define SN_DEEPEST 8
#define SN_MOST_PORTS 100000u
#define SN_MOST_MEMBERS 64u
#define SN_MOST_STATES (1 << 24)
#define SN_MOST_HORIZON 10000u
#define SN_TEXT 400

enum { SN_BOOLEAN = 1, SN_MISSING = 2, SN_INTEGER = 4, SN_TUNABLE = 8 };

typedef struct { const char *name, *unit; double start, low, high; unsigned flags; } sn_port;

typedef struct {
    unsigned char *bytes;
    const char *name, *guid;
    double sample_time;
    int plant;
    uint32_t n_in, n_out, n_par;
    uint32_t next, ahead; /* the last outputs: the first ones at the next sample, then those `horizon` samples from now */
    uint32_t horizon;
    sn_port *ports;
    sn_node root;
} sn_model;

typedef struct { unsigned char *at, *start, *end; char *error; const char *path; } sn_reader;

static int sn_refuse(sn_reader *r, const char *format, ...)
{
    va_list list;
    int used;
    if (r->error[0] != '\0')
        return 0;
    used = snprintf(r->error, SN_TEXT, "model file %.200s: ", r->path);
    va_start(list, format);
    vsnprintf(r->error + used, (size_t)(SN_TEXT - used), format, list);
    va_end(list);
    return 0;
}

static uint32_t sn_crc32(const unsigned char *p, size_t n)
{
    uint32_t table[256], crc = 0xffffffffu;
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++)
            c = c & 1 ? 0xedb88320u ^ (c >> 1) : c >> 1;
        table[i] = c;
    }
    for (size_t i = 0; i < n; i++)
        crc = table[(crc ^ p[i]) & 255u] ^ (crc >> 8);
    return crc ^ 0xffffffffu;
}

static int sn_take(sn_reader *r, void *to, size_t n)
{
    if (r->error[0] != '\0' || (size_t)(r->end - r->at) < n) {
        memset(to, 0, n);
        return sn_refuse(r, "it ends too early.");
    }
    memcpy(to, r->at, n);
    r->at += n;
    return 1;
}

static uint32_t sn_take_u32(sn_reader *r)
{
    uint32_t x;
    sn_take(r, &x, sizeof x);
    return x;
}

static double sn_take_f64(sn_reader *r)
{
    double x;
    sn_take(r, &x, sizeof x);
    return x;
}

/* A text stands there with its closing zero. */
static const char *sn_take_text(sn_reader *r)
{
    uint32_t n = sn_take_u32(r);
    const char *text = (const char *)r->at;
    if (r->error[0] != '\0' || n == 0 || (size_t)(r->end - r->at) < n || memchr(text, 0, n) != text + n - 1) {
        sn_refuse(r, "a text in it is damaged.");
        return "";
    }
    r->at += n;
    return text;
}

/* The view of an array without gaps. */
static void sn_lay_out(sn_array *a, double *p)
{
    int32_t n0 = a->n[0], n1 = a->n[1], n2 = a->n[2];
    if (a->rank == 1)
        a->v1 = (sn_v1){p, n0, 1};
    else if (a->rank == 2)
        a->v2 = (sn_v2){p, n0, n1, n1, 1};
    else
        a->v3 = (sn_v3){p, n0, n1, n2, (int32_t)((int64_t)n1 * n2), n2, 1};
}

static int sn_take_array(sn_reader *r, sn_array *array, int rank)
{
    uint64_t count = 1, most = (uint64_t)(r->end - r->at) / sizeof(double);
    array->rank = (int32_t)sn_take_u32(r);
    if (array->rank != rank)
        return sn_refuse(r, "an array has %d dimensions where this kind has %d.", (int)array->rank, rank);
    for (int i = 0; i < rank; i++) {
        uint64_t n;
        sn_take(r, &n, sizeof n);
        if (n > most || n > SN_MOST_NUMBERS || (n > 0 && count > most / n))
            return sn_refuse(r, "an array is larger than the file.");
        count *= n;
        array->n[i] = (int32_t)n;
    }
    if (count > SN_MOST_NUMBERS)
        return sn_refuse(r, "an array has more than 2^31 numbers.");
    /* To the next multiple of eight from the start: the numbers are used where they stand. */
    r->at += (8 - (size_t)(r->at - r->start) % 8) % 8;
    if (r->at > r->end || (uint64_t)(r->end - r->at) < count * sizeof(double))
        return sn_refuse(r, "it ends too early.");
    sn_lay_out(array, (double *)(void *)r->at);
    r->at += count * sizeof(double);
    return 1;
}

static const sn_kind *sn_find_kind(const char *name)
{
    for (int i = 0; i < sn_kind_count; i++)
        if (strcmp(sn_kinds[i].name, name) == 0)
            return &sn_kinds[i];
    return NULL;
}

static int sn_take_node(sn_reader *r, sn_node *node, int depth)
{
    const char *name = sn_take_text(r);
    uint32_t arrays = sn_take_u32(r), members;
    if (r->error[0] != '\0')
        return 0;
    node->kind = sn_find_kind(name);
    if (node->kind == NULL)
        return sn_refuse(r, "this library does not hold `%.100s`; take one of the same softneck.", name);
    if (arrays != (uint32_t)node->kind->array_count)
        return sn_refuse(r, "%u arrays where `%.100s` has %d.", arrays, name, (int)node->kind->array_count);
    node->arrays = (sn_array *)calloc(arrays + 1u, sizeof *node->arrays);
    if (node->arrays == NULL)
        return sn_refuse(r, "no memory.");
    for (uint32_t i = 0; i < arrays; i++) {
        if (!sn_take_array(r, &node->arrays[i], node->kind->ranks[i]))
            return 0;
        node->array_count++;
    }
    members = sn_take_u32(r);
    if (r->error[0] != '\0')
        return 0;
    if (members > SN_MOST_MEMBERS || (members > 0) != (node->kind->has_members != 0) || depth >= SN_DEEPEST)
        return sn_refuse(r, "%u members of `%.100s` cannot be.", members, name);
    if (members == 0)
        return 1;
    node->members = (sn_node *)calloc(members, sizeof *node->members);
    if (node->members == NULL)
        return sn_refuse(r, "no memory.");
    node->member_count = (int32_t)members;
    for (uint32_t i = 0; i < members; i++)
        if (!sn_take_node(r, &node->members[i], depth + 1))
            return 0;
    return 1;
}

static int sn_take_port(sn_reader *r, sn_port *port)
{
    port->name = sn_take_text(r);
    port->unit = sn_take_text(r);
    port->start = sn_take_f64(r);
    port->low = sn_take_f64(r);
    port->high = sn_take_f64(r);
    port->flags = sn_take_u32(r);
    return r->error[0] == '\0';
}

static void sn_free_node(sn_node *node)
{
    for (int32_t i = 0; i < node->member_count; i++)
        sn_free_node(&node->members[i]);
    free(node->members);
    free(node->arrays);
}

static void sn_free_model(sn_model *model)
{
    sn_free_node(&model->root);
    free(model->ports);
    free(model->bytes);
    memset(model, 0, sizeof *model);
}

static int sn_check_head(sn_reader *r, size_t size)
{
    static const unsigned char magic[8] = "SNMODEL";
    uint32_t version, mark, crc;
    uint64_t stated;
    unsigned char found[8];
    sn_take(r, found, sizeof found);
    version = sn_take_u32(r);
    mark = sn_take_u32(r);
    sn_take(r, &stated, sizeof stated);
    crc = sn_take_u32(r);
    (void)sn_take_u32(r);
    if (r->error[0] != '\0' || memcmp(found, magic, sizeof magic) != 0)
        return sn_refuse(r, "is no model file.");
    if (version != SN_FORMAT || mark != 0x01020304u)
        return sn_refuse(r, "has format %u; this library reads %u. Export the FMU again.", version, SN_FORMAT);
    if (stated != size)
        return sn_refuse(r, "has %lu bytes and should have %lu.", (unsigned long)size, (unsigned long)stated);
    if (crc != sn_crc32(r->start + SN_HEAD, size - SN_HEAD))
        return sn_refuse(r, "is damaged: its checksum is another one.");
    return 1;
}

/* Take over `bytes` as a model; on failure 0, the reason in `error` (SN_TEXT) and nothing to free but `model`. */
static int sn_parse_model(sn_model *model, unsigned char *bytes, size_t size, const char *path, char *error)
{
    sn_reader r = {bytes, bytes, bytes + size, error, path};
    uint64_t count;
    memset(model, 0, sizeof *model);
    model->bytes = bytes;
    error[0] = '\0';
    if (!sn_check_head(&r, size))
        return 0;
    model->name = sn_take_text(&r);
    model->guid = sn_take_text(&r);
    model->sample_time = sn_take_f64(&r);
    model->plant = sn_take_u32(&r) != 0;
    model->n_in = sn_take_u32(&r);
    model->n_out = sn_take_u32(&r);
    model->n_par = sn_take_u32(&r);
    model->next = sn_take_u32(&r);
    model->ahead = sn_take_u32(&r);
    model->horizon = sn_take_u32(&r);
    if (error[0] != '\0')
        return 0;
    if (!(model->sample_time > 1e-9 && model->sample_time < 1e9))
        return sn_refuse(&r, "its sample time is %g s.", model->sample_time);
    count = (uint64_t)model->n_in + model->n_out + model->n_par;
    if (count > SN_MOST_PORTS)
        return sn_refuse(&r, "has too many variables.");
    model->ports = (sn_port *)calloc((size_t)count + 1u, sizeof *model->ports);
    if (model->ports == NULL)
        return sn_refuse(&r, "no memory.");
    for (uint64_t i = 0; i < count; i++)
        if (!sn_take_port(&r, &model->ports[i]))
            return 0;
    if (model->ahead > model->next || 2u * (uint64_t)model->next + model->ahead > model->n_out)
        return sn_refuse(&r, "%u and %u of its %u outputs cannot be those of later samples.", model->next, model->ahead,
                         model->n_out);
    if ((model->ahead > 0 && model->horizon == 0) || model->horizon > SN_MOST_HORIZON)
        return sn_refuse(&r, "outputs %u samples ahead cannot be.", model->horizon);
    if (!sn_take_node(&r, &model->root, 0))
        return 0;
    if (model->next > 0 && model->root.kind->tangent == NULL)
        return sn_refuse(&r, "this library holds no derivative of `%.100s`.", model->root.kind->name);
    return r.at == r.end ? 1 : sn_refuse(&r, "has bytes behind its end.");
}

static FILE *sn_open(const char *path)
{
#ifdef _WIN32
    wchar_t wide[4096];
    if (MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 4096) == 0)
        return NULL;
    return _wfopen(wide, L"rb");
#else
    return fopen(path, "rb");
#endif
}

static int sn_load_model(sn_model *model, const char *path, char *error)
{
    sn_reader r = {NULL, NULL, NULL, error, path};
    unsigned char *bytes = NULL;
    size_t size = 0, room = 1 << 16, got;
    FILE *file = sn_open(path);
    memset(model, 0, sizeof *model);
    error[0] = '\0';
    if (file == NULL)
        return sn_refuse(&r, "cannot be opened.");
    /* Read on until there is no more: no length is asked for that a host's file system may not tell. */
    for (;;) {
        unsigned char *grown = (unsigned char *)realloc(bytes, room);
        if (grown == NULL) {
            free(bytes);
            fclose(file);
            return sn_refuse(&r, "no memory.");
        }
        bytes = grown;
        got = fread(bytes + size, 1, room - size, file);
        size += got;
        if (size < room)
            break;
        room *= 2;
    }
    fclose(file);
    return sn_parse_model(model, bytes, size, path, error);
}

#endif
