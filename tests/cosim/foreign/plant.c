/* A linear plant that knows nothing of softneck: dx/dt = (k u - x) / T by forward Euler, three drives, two angles.

   Compiled by the tests as FMI 2.0 (-DFMI=2) and FMI 3.0 (-DFMI=3) from fmpy's own headers.
   It misbehaves on demand: mode 1 crashes, 2 hangs, 3 returns NaN, 4 returns an error,
   5 ends the simulation, all from t = 0.2 s on. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#if FMI == 2
#include "fmi2Functions.h"
#define INSTANCE fmi2Component
#define STATUS fmi2Status
#define REAL fmi2Real
#define INTEGER fmi2Integer
#define OK fmi2OK
#define ERR fmi2Error
#define ENDS fmi2Discard
#else
#include "fmi3Functions.h"
#define INSTANCE fmi3Instance
#define STATUS fmi3Status
#define REAL fmi3Float64
#define INTEGER fmi3Int32
#define OK fmi3OK
#define ERR fmi3Error
#define ENDS fmi3OK
#endif

/* 0..2 drives u, 3..4 angles in deg, 5 time constant, 6 gain in deg/rad; integer 7 mode */
typedef struct { REAL v[7]; INTEGER mode; } Plant;

static void defaults(Plant *p) { memset(p, 0, sizeof *p); p->v[5] = 0.5; p->v[6] = 10.0; }

static STATUS go(Plant *p, REAL t, REAL h) {
    if (p->mode && t > 0.2 - 1e-9) {
        if (p->mode == 1) abort();
        if (p->mode == 2) for (;;) usleep(10000);
        if (p->mode == 4) return ERR;
        if (p->mode == 5) return ENDS;
        p->v[3] = NAN;
        return OK;
    }
    p->v[3] += h / p->v[5] * (p->v[6] * (p->v[0] - 0.5 * (p->v[1] + p->v[2])) - p->v[3]);
    p->v[4] += h / p->v[5] * (p->v[6] * (p->v[1] - p->v[2]) - p->v[4]);
    return OK;
}

#if FMI == 2
#define API FMI2_Export
API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
API STATUS fmi2SetDebugLogging(INSTANCE c, fmi2Boolean on, size_t n, const fmi2String k[]) { return OK; }
API INSTANCE fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String res,
                             const fmi2CallbackFunctions *f, fmi2Boolean visible, fmi2Boolean log) {
    Plant *p = malloc(sizeof *p);
    defaults(p);
    return p;
}
API void fmi2FreeInstance(INSTANCE c) { free(c); }
API STATUS fmi2SetupExperiment(INSTANCE c, fmi2Boolean a, REAL b, REAL d, fmi2Boolean e, REAL f) { return OK; }
API STATUS fmi2EnterInitializationMode(INSTANCE c) { return OK; }
API STATUS fmi2ExitInitializationMode(INSTANCE c) { return OK; }
API STATUS fmi2Terminate(INSTANCE c) { return OK; }
API STATUS fmi2Reset(INSTANCE c) { defaults(c); return OK; }
API STATUS fmi2GetReal(INSTANCE c, const fmi2ValueReference r[], size_t n, REAL x[]) {
    for (size_t i = 0; i < n; i++) x[i] = ((Plant *)c)->v[r[i]];
    return OK;
}
API STATUS fmi2SetReal(INSTANCE c, const fmi2ValueReference r[], size_t n, const REAL x[]) {
    for (size_t i = 0; i < n; i++) ((Plant *)c)->v[r[i]] = x[i];
    return OK;
}
API STATUS fmi2SetInteger(INSTANCE c, const fmi2ValueReference r[], size_t n, const INTEGER x[]) {
    if (n) ((Plant *)c)->mode = x[0];
    return OK;
}
API STATUS fmi2GetInteger(INSTANCE c, const fmi2ValueReference r[], size_t n, INTEGER x[]) {
    if (n) x[0] = ((Plant *)c)->mode;
    return OK;
}
API STATUS fmi2DoStep(INSTANCE c, REAL t, REAL h, fmi2Boolean no) { return go(c, t, h); }
API STATUS fmi2GetBooleanStatus(INSTANCE c, const fmi2StatusKind kind, fmi2Boolean *ended) {
    *ended = kind == fmi2Terminated && ((Plant *)c)->mode == 5;
    return OK;
}
API STATUS fmi2GetFMUstate(INSTANCE c, fmi2FMUstate *s) {
    *s = malloc(sizeof(Plant));
    memcpy(*s, c, sizeof(Plant));
    return OK;
}
API STATUS fmi2SetFMUstate(INSTANCE c, fmi2FMUstate s) { memcpy(c, s, sizeof(Plant)); return OK; }
API STATUS fmi2FreeFMUstate(INSTANCE c, fmi2FMUstate *s) { free(*s); *s = NULL; return OK; }
API STATUS fmi2SerializedFMUstateSize(INSTANCE c, fmi2FMUstate s, size_t *n) { *n = sizeof(Plant); return OK; }
API STATUS fmi2SerializeFMUstate(INSTANCE c, fmi2FMUstate s, fmi2Byte b[], size_t n) { memcpy(b, s, n); return OK; }
API STATUS fmi2DeSerializeFMUstate(INSTANCE c, const fmi2Byte b[], size_t n, fmi2FMUstate *s) {
    *s = malloc(sizeof(Plant));
    memcpy(*s, b, n);
    return OK;
}
#else
#define API FMI3_Export
API const char *fmi3GetVersion(void) { return "3.0"; }
API STATUS fmi3SetDebugLogging(INSTANCE c, fmi3Boolean on, size_t n, const fmi3String k[]) { return OK; }
API INSTANCE fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String res, fmi3Boolean visible,
                                         fmi3Boolean log, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference need[], size_t n, fmi3InstanceEnvironment e,
                                         fmi3LogMessageCallback tell, fmi3IntermediateUpdateCallback update) {
    Plant *p = malloc(sizeof *p);
    defaults(p);
    return p;
}
API void fmi3FreeInstance(INSTANCE c) { free(c); }
API STATUS fmi3EnterInitializationMode(INSTANCE c, fmi3Boolean a, REAL b, REAL d, fmi3Boolean e, REAL f) { return OK; }
API STATUS fmi3ExitInitializationMode(INSTANCE c) { return OK; }
API STATUS fmi3Terminate(INSTANCE c) { return OK; }
API STATUS fmi3Reset(INSTANCE c) { defaults(c); return OK; }
API STATUS fmi3GetFloat64(INSTANCE c, const fmi3ValueReference r[], size_t n, REAL x[], size_t m) {
    for (size_t i = 0; i < n; i++) x[i] = ((Plant *)c)->v[r[i]];
    return OK;
}
API STATUS fmi3SetFloat64(INSTANCE c, const fmi3ValueReference r[], size_t n, const REAL x[], size_t m) {
    for (size_t i = 0; i < n; i++) ((Plant *)c)->v[r[i]] = x[i];
    return OK;
}
API STATUS fmi3SetInt32(INSTANCE c, const fmi3ValueReference r[], size_t n, const INTEGER x[], size_t m) {
    if (n) ((Plant *)c)->mode = x[0];
    return OK;
}
API STATUS fmi3SetInt64(INSTANCE c, const fmi3ValueReference r[], size_t n, const fmi3Int64 x[], size_t m) {
    if (n) ((Plant *)c)->mode = (INTEGER)x[0]; /* an enumeration in its place */
    return OK;
}
API STATUS fmi3GetInt32(INSTANCE c, const fmi3ValueReference r[], size_t n, INTEGER x[], size_t m) {
    if (n) x[0] = ((Plant *)c)->mode;
    return OK;
}
API STATUS fmi3DoStep(INSTANCE c, REAL t, REAL h, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *stop,
                      fmi3Boolean *early, REAL *last) {
    *event = *stop = *early = fmi3False;
    *last = t + h;
    *stop = ((Plant *)c)->mode == 5 && t > 0.2 - 1e-9;
    return go(c, t, h);
}
API STATUS fmi3GetFMUState(INSTANCE c, fmi3FMUState *s) {
    *s = malloc(sizeof(Plant));
    memcpy(*s, c, sizeof(Plant));
    return OK;
}
API STATUS fmi3SetFMUState(INSTANCE c, fmi3FMUState s) { memcpy(c, s, sizeof(Plant)); return OK; }
API STATUS fmi3FreeFMUState(INSTANCE c, fmi3FMUState *s) { free(*s); *s = NULL; return OK; }
API STATUS fmi3SerializedFMUStateSize(INSTANCE c, fmi3FMUState s, size_t *n) { *n = sizeof(Plant); return OK; }
API STATUS fmi3SerializeFMUState(INSTANCE c, fmi3FMUState s, fmi3Byte b[], size_t n) { memcpy(b, s, n); return OK; }
API STATUS fmi3DeserializeFMUState(INSTANCE c, const fmi3Byte b[], size_t n, fmi3FMUState *s) {
    *s = malloc(sizeof(Plant));
    memcpy(*s, b, n);
    return OK;
}
#endif
