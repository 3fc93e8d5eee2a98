/* FMI 3.0: Co-Simulation and Model Exchange with scalars of Float64, Int32 and Boolean over `sn_instance`, and refusals of
 * all else. */
#ifndef SN_FMI3_H
#define SN_FMI3_H

#include "sn_instance.h"

#if defined(SN_FMI_HEADERS)
#include "fmi3Functions.h"
#else
#include <stdbool.h>
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8, fmi3Byte;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent } fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
#endif

typedef union { fmi3LogMessageCallback function; void *data; } sn_carried3;
typedef const fmi3ValueReference *sn_references;

static void sn_tell3(void *self, int status, const char *text)
{
    sn_instance *s = (sn_instance *)self;
    sn_carried3 logger;
    logger.data = s->logger;
    if (s->logger != NULL)
        logger.function(s->environment, (fmi3Status)status, status == SN_WARN ? "logStatusWarning" : "logStatusError",
                        text);
}

static fmi3Status sn_refused3(fmi3Instance c, const char *what)
{
    if (c != NULL)
        sn_say((sn_instance *)c, SN_FAIL, "%s is not part of this FMU.", what);
    return fmi3Error;
}

/* Whether it is an instance for Model Exchange. */
static int sn_exchanges3(fmi3Instance c, const char *what)
{
    if (c != NULL && !((sn_instance *)c)->exchange)
        sn_say((sn_instance *)c, SN_FAIL, "%s is of Model Exchange; this is an instance for Co-Simulation.", what);
    return c != NULL && ((sn_instance *)c)->exchange;
}

SN_EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

SN_EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    (void)on, (void)n, (void)categories;
    return c != NULL ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean on, fmi3Boolean events,
    fmi3Boolean early, const fmi3ValueReference required[], size_t n, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    char path[3072];
    sn_carried3 logger = {NULL};
    (void)visible, (void)on, (void)early, (void)required, (void)n, (void)update;
    logger.function = log;
    if (events || resources == NULL || !sn_path_of(resources, path, sizeof path)) {
        if (logger.data != NULL)
            log(environment, fmi3Error, "logStatusError",
                events ? "softneck: this FMU has no event mode." : "softneck: the host gives no path of the resources.");
        return NULL;
    }
    return sn_instantiate(0, path, token, name, sn_tell3, environment, logger.data);
}

SN_EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                    fmi3Boolean visible, fmi3Boolean on,
                                                    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    char path[3072];
    sn_carried3 logger = {NULL};
    (void)visible, (void)on;
    logger.function = log;
    if (resources == NULL || !sn_path_of(resources, path, sizeof path)) {
        if (logger.data != NULL)
            log(environment, fmi3Error, "logStatusError", "softneck: the host gives no path of the resources.");
        return NULL;
    }
    return sn_instantiate(1, path, token, name, sn_tell3, environment, logger.data);
}

SN_EXPORT fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean on,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)on, (void)update, (void)lock, (void)unlock;
    if (log != NULL)
        log(environment, fmi3Error, "logStatusError", "softneck: this FMU has no scheduled execution.");
    return NULL;
}

SN_EXPORT void fmi3FreeInstance(fmi3Instance c) { sn_free_instance((sn_instance *)c); }

SN_EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean with_tolerance, fmi3Float64 tolerance,
                                                 fmi3Float64 start, fmi3Boolean with_stop, fmi3Float64 stop)
{
    (void)with_tolerance, (void)tolerance;
    return c != NULL && sn_begin((sn_instance *)c, start, with_stop ? stop : SN_NEVER) ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    return c != NULL && sn_run((sn_instance *)c) ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3Terminate(fmi3Instance c) { return c != NULL ? fmi3OK : fmi3Error; }

SN_EXPORT fmi3Status fmi3Reset(fmi3Instance c)
{
    if (c == NULL)
        return fmi3Error;
    sn_restart((sn_instance *)c);
    return fmi3OK;
}

static int sn_counts3(fmi3Instance c, size_t references, size_t values)
{
    if (c != NULL && references != values)
        sn_say((sn_instance *)c, SN_FAIL, "all variables are scalars: as many values as references.");
    return c != NULL && references == values;
}

SN_EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                                    size_t nv)
{
    sn_instance *s = (sn_instance *)c;
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        if ((int64_t)vr[i] == s->values.n) /* behind all others: time */
            values[i] = s->time;
        else if (!sn_get(s, vr[i], &values[i]))
            return fmi3Error;
    }
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 values[],
                                    size_t nv)
{
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++)
        if (!sn_set((sn_instance *)c, vr[i], values[i]))
            return fmi3Error;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Boolean values[],
                                    size_t nv)
{
    double x;
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++) {
        if (!sn_get((sn_instance *)c, vr[i], &x))
            return fmi3Error;
        values[i] = x != 0.0;
    }
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Boolean values[],
                                    size_t nv)
{
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++)
        if (!sn_set((sn_instance *)c, vr[i], values[i] ? 1.0 : 0.0))
            return fmi3Error;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int32 values[], size_t nv)
{
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++)
        if (!sn_get_integer((sn_instance *)c, vr[i], &values[i]))
            return fmi3Error;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int32 values[],
                                  size_t nv)
{
    if (!sn_counts3(c, n, nv))
        return fmi3Error;
    for (size_t i = 0; i < n; i++)
        if (!sn_set_integer((sn_instance *)c, vr[i], values[i]))
            return fmi3Error;
    return fmi3OK;
}

#define SN_NONE3(name, type)                                                                                        \
    SN_EXPORT fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, type values[],      \
                                       size_t nv)                                                                   \
    {                                                                                                               \
        (void)vr, (void)values, (void)nv;                                                                           \
        return n == 0 ? fmi3OK : sn_refused3(c, "fmi3Get" #name);                                                   \
    }                                                                                                               \
    SN_EXPORT fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const type values[],\
                                       size_t nv)                                                                   \
    {                                                                                                               \
        (void)vr, (void)values, (void)nv;                                                                           \
        return n == 0 ? fmi3OK : sn_refused3(c, "fmi3Set" #name);                                                   \
    }
SN_NONE3(Float32, fmi3Float32)
SN_NONE3(Int8, fmi3Int8)
SN_NONE3(UInt8, fmi3UInt8)
SN_NONE3(Int16, fmi3Int16)
SN_NONE3(UInt16, fmi3UInt16)
SN_NONE3(UInt32, fmi3UInt32)
SN_NONE3(Int64, fmi3Int64)
SN_NONE3(UInt64, fmi3UInt64)
SN_NONE3(String, fmi3String)

SN_EXPORT fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no_set_before,
                                fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    int done = c != NULL && sn_do_step((sn_instance *)c, time, size);
    (void)no_set_before;
    if (event != NULL)
        *event = 0;
    if (terminate != NULL)
        *terminate = 0;
    if (early != NULL)
        *early = 0;
    if (last != NULL)
        *last = c != NULL ? ((const sn_instance *)c)->time : time;
    return done ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, sn_references unknown, size_t n, sn_references known,
                                                  size_t n_known, const fmi3Float64 seeds[], size_t n_seeds,
                                                  fmi3Float64 moved[], size_t n_moved)
{
    if (!sn_counts3(c, n, n_moved) || !sn_counts3(c, n_known, n_seeds))
        return fmi3Error;
    return sn_derivative((sn_instance *)c, unknown, n, known, n_known, seeds, moved) ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    sn_snapshot *taken;
    if (c == NULL || state == NULL)
        return fmi3Error;
    taken = sn_take_snapshot((sn_instance *)c, (sn_snapshot *)*state);
    if (taken == NULL)
        return fmi3Error;
    *state = taken;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    if (c == NULL || state == NULL)
        return fmi3Error;
    sn_go_back((sn_instance *)c, (const sn_snapshot *)state);
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    if (c == NULL || state == NULL || size == NULL)
        return fmi3Error;
    *size = sn_serial_bytes((const sn_instance *)c);
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    if (c == NULL || state == NULL || bytes == NULL || size < sn_serial_bytes((const sn_instance *)c))
        return fmi3Error;
    sn_serialise((const sn_instance *)c, (const sn_snapshot *)state, bytes);
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    sn_snapshot *made;
    if (c == NULL || bytes == NULL || state == NULL)
        return fmi3Error;
    made = sn_deserialise((sn_instance *)c, bytes, size);
    if (made == NULL)
        return fmi3Error;
    *state = made;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    *n = 0;
    return c != NULL ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    *n = 0;
    return c != NULL ? fmi3OK : fmi3Error;
}

#define SN_REFUSE3(name, arguments, unused)                                                                         \
    SN_EXPORT fmi3Status name arguments                                                                             \
    {                                                                                                               \
        unused;                                                                                                     \
        return sn_refused3(c, #name);                                                                               \
    }
SN_REFUSE3(fmi3GetBinary, (fmi3Instance c, sn_references vr, size_t n, size_t sizes[], fmi3Binary v[], size_t nv),
           ((void)vr, (void)n, (void)sizes, (void)v, (void)nv))
SN_REFUSE3(fmi3SetBinary,
           (fmi3Instance c, sn_references vr, size_t n, const size_t sizes[], const fmi3Binary v[], size_t nv),
           ((void)vr, (void)n, (void)sizes, (void)v, (void)nv))
SN_REFUSE3(fmi3GetClock, (fmi3Instance c, sn_references vr, size_t n, fmi3Clock v[]), ((void)vr, (void)n, (void)v))
SN_REFUSE3(fmi3SetClock, (fmi3Instance c, sn_references vr, size_t n, const fmi3Clock v[]),
           ((void)vr, (void)n, (void)v))
SN_REFUSE3(fmi3GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference vr, size_t *n),
           ((void)vr, (void)n))
SN_REFUSE3(fmi3GetVariableDependencies,
           (fmi3Instance c, fmi3ValueReference vr, size_t a[], fmi3ValueReference b[], size_t d[],
            fmi3DependencyKind kinds[], size_t n),
           ((void)vr, (void)a, (void)b, (void)d, (void)kinds, (void)n))
SN_REFUSE3(fmi3GetAdjointDerivative,
           (fmi3Instance c, sn_references a, size_t na, sn_references b, size_t nb, const fmi3Float64 seed[], size_t ns,
            fmi3Float64 v[], size_t nv),
           ((void)a, (void)na, (void)b, (void)nb, (void)seed, (void)ns, (void)v, (void)nv))
SN_REFUSE3(fmi3EnterConfigurationMode, (fmi3Instance c), (void)c)
SN_REFUSE3(fmi3ExitConfigurationMode, (fmi3Instance c), (void)c)
SN_REFUSE3(fmi3EnterStepMode, (fmi3Instance c), (void)c)
SN_REFUSE3(fmi3GetIntervalDecimal,
           (fmi3Instance c, sn_references vr, size_t n, fmi3Float64 v[], fmi3IntervalQualifier q[]),
           ((void)vr, (void)n, (void)v, (void)q))
SN_REFUSE3(fmi3GetIntervalFraction,
           (fmi3Instance c, sn_references vr, size_t n, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[]),
           ((void)vr, (void)n, (void)a, (void)b, (void)q))
SN_REFUSE3(fmi3GetShiftDecimal, (fmi3Instance c, sn_references vr, size_t n, fmi3Float64 v[]),
           ((void)vr, (void)n, (void)v))
SN_REFUSE3(fmi3GetShiftFraction, (fmi3Instance c, sn_references vr, size_t n, fmi3UInt64 a[], fmi3UInt64 b[]),
           ((void)vr, (void)n, (void)a, (void)b))
SN_REFUSE3(fmi3SetIntervalDecimal, (fmi3Instance c, sn_references vr, size_t n, const fmi3Float64 v[]),
           ((void)vr, (void)n, (void)v))
SN_REFUSE3(fmi3SetIntervalFraction,
           (fmi3Instance c, sn_references vr, size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]),
           ((void)vr, (void)n, (void)a, (void)b))
SN_REFUSE3(fmi3SetShiftDecimal, (fmi3Instance c, sn_references vr, size_t n, const fmi3Float64 v[]),
           ((void)vr, (void)n, (void)v))
SN_REFUSE3(fmi3SetShiftFraction,
           (fmi3Instance c, sn_references vr, size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]),
           ((void)vr, (void)n, (void)a, (void)b))
SN_REFUSE3(fmi3GetOutputDerivatives,
           (fmi3Instance c, sn_references vr, size_t n, const fmi3Int32 orders[], fmi3Float64 v[], size_t nv),
           ((void)vr, (void)n, (void)orders, (void)v, (void)nv))
SN_REFUSE3(fmi3ActivateModelPartition, (fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time),
           ((void)clock, (void)time))

/* Model Exchange: events, and no continuous states. */
SN_EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    return sn_exchanges3(c, "fmi3EnterEventMode") && sn_enter_event((sn_instance *)c) ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return sn_exchanges3(c, "fmi3EvaluateDiscreteStates") ? fmi3OK : fmi3Error;
}

SN_EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                              fmi3Boolean *nominals, fmi3Boolean *states, fmi3Boolean *defined,
                                              fmi3Float64 *next)
{
    int needed = 0;
    double time = 0.0;
    if (!sn_exchanges3(c, "fmi3UpdateDiscreteStates") || !sn_update((sn_instance *)c, &needed, &time))
        return fmi3Error;
    *again = needed != 0;
    *terminate = *nominals = *states = 0;
    *defined = 1;
    *next = time;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    if (!sn_exchanges3(c, "fmi3EnterContinuousTimeMode"))
        return fmi3Error;
    ((sn_instance *)c)->event = 0;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *stop)
{
    (void)no;
    if (!sn_exchanges3(c, "fmi3CompletedIntegratorStep"))
        return fmi3Error;
    *event = *stop = 0;
    return fmi3OK;
}

SN_EXPORT fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    return sn_exchanges3(c, "fmi3SetTime") && sn_set_time((sn_instance *)c, time) ? fmi3OK : fmi3Error;
}

#define SN_STATELESS3(name, type)                                                                                   \
    SN_EXPORT fmi3Status name(fmi3Instance c, type x[], size_t n)                                                   \
    {                                                                                                               \
        (void)x;                                                                                                    \
        if (!sn_exchanges3(c, #name))                                                                               \
            return fmi3Error;                                                                                       \
        return n == 0 ? fmi3OK : sn_refused3(c, "a continuous state or event indicator");                           \
    }
SN_STATELESS3(fmi3SetContinuousStates, const fmi3Float64)
SN_STATELESS3(fmi3GetContinuousStateDerivatives, fmi3Float64)
SN_STATELESS3(fmi3GetEventIndicators, fmi3Float64)
SN_STATELESS3(fmi3GetContinuousStates, fmi3Float64)
SN_STATELESS3(fmi3GetNominalsOfContinuousStates, fmi3Float64)

#endif
