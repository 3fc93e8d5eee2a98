/* The library of softneck's compiled FMUs: every kind, FMI 2.0 and 3.0, in this one translation unit.
 *
 *     cc -std=c99 -O2 -ffp-contract=off -fno-math-errno -fno-trapping-math -fvisibility=hidden -fPIC -shared \
 *        -o MODEL.so softneck.c -lm
 *
 * It reads MODEL from resources/model.bin. `sn_kinds.h` is generated from Python. */
#if defined(_WIN32)
#define SN_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define SN_EXPORT __attribute__((visibility("default")))
#else
#define SN_EXPORT
#endif

#ifdef SN_OWN_PROBE
#include "sn_probe.h"
#endif

/* What a step spends its time in comes first; all else may be slow, and is short. */
#include "sn_kinds.h"
#if defined(__clang__)
#pragma clang attribute push(__attribute__((minsize)), apply_to = function)
#endif
#include "fmi2.h"
#include "fmi3.h"
#if defined(__clang__)
#pragma clang attribute pop
#endif
