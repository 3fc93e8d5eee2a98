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

#include "fmi2.h"
#include "fmi3.h"
