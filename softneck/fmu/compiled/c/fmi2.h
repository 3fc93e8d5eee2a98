/* FMI 2.0.4: Co-Simulation and Model Exchange over `sn_instance`, and refusals of all else, which strict loaders want to
 * find. */
#ifndef SN_FMI2_H
#define SN_FMI2_H

#include "sn_instance.h"

#if defined(SN_FMI_HEADERS) /* the tests compile against the standard's own headers to compare the prototypes */
#include "fmi2Functions.h"
#else
typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef char fmi2Char, fmi2Byte;
typedef const char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;
typedef struct {
    fmi2Boolean newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged;
    fmi2Boolean valuesOfContinuousStatesChanged, nextEventTimeDefined;
    fmi2Real nextEventTime;
} fmi2EventInfo;
#endif

typedef void (*sn_logger2)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
/* A function pointer does not travel as `void *` in standard C: it is copied there and back. */
typedef union { sn_logger2 function; void *data; } sn_carried2;

static void sn_tell2(void *self, int status, const char *text)
{
    sn_instance *s = (sn_instance *)self;
    sn_carried2 logger;
    char safe[2 * SN_TEXT + 201];
    size_t n = 0;
    logger.data = s->logger;
    if (s->logger == NULL)
        return;
    /* A logger takes the message for a printf format. */
    for (; *text != '\0' && n < sizeof safe - 3; text++) {
        if (*text == '%')
            safe[n++] = '%';
        safe[n++] = *text;
    }
    safe[n] = '\0';
    logger.function(s->environment, s->instance_name != NULL ? s->instance_name : "", (fmi2Status)status,
                    status == SN_WARN ? "logStatusWarning" : "logStatusError", safe);
}

static fmi2Status sn_refused2(fmi2Component c, const char *what)
{
    if (c != NULL)
        sn_say((sn_instance *)c, SN_FAIL, "%s is not part of this FMU.", what);
    return fmi2Error;
}

/* Whether it is an instance for Model Exchange. */
static int sn_exchanges2(fmi2Component c, const char *what)
{
    if (c != NULL && !((sn_instance *)c)->exchange)
        sn_say((sn_instance *)c, SN_FAIL, "%s is of Model Exchange; this is an instance for Co-Simulation.", what);
    return c != NULL && ((sn_instance *)c)->exchange;
}

SN_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
SN_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

SN_EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)on, (void)n, (void)categories; /* there is nothing to say but warnings and errors */
    return c != NULL ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String location,
                                        const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean on)
{
    char path[3072];
    sn_carried2 logger = {NULL};
    (void)visible, (void)on;
    if (functions != NULL)
        logger.function = functions->logger;
    if (location == NULL || !sn_path_of(location, path, sizeof path)) {
        if (logger.data != NULL)
            logger.function(functions->componentEnvironment, name != NULL ? name : "", fmi2Error, "logStatusError",
                            "softneck: the host gives no usable location of the resources.");
        return NULL;
    }
    return sn_instantiate(type == fmi2ModelExchange, path, guid, name, sn_tell2,
                          functions != NULL ? functions->componentEnvironment : NULL, logger.data);
}

SN_EXPORT void fmi2FreeInstance(fmi2Component c) { sn_free_instance((sn_instance *)c); }

SN_EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
                                         fmi2Boolean with_stop, fmi2Real stop)
{
    sn_instance *s = (sn_instance *)c;
    (void)with_tolerance, (void)tolerance;
    if (s == NULL || !sn_begin(s, start, with_stop ? stop : SN_NEVER))
        return fmi2Error;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return c != NULL ? fmi2OK : fmi2Error; }

SN_EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    return c != NULL && sn_run((sn_instance *)c) ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2Terminate(fmi2Component c) { return c != NULL ? fmi2OK : fmi2Error; }

SN_EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    if (c == NULL)
        return fmi2Error;
    sn_restart((sn_instance *)c);
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    for (size_t i = 0; i < n; i++)
        if (c == NULL || !sn_get((sn_instance *)c, vr[i], &value[i]))
            return fmi2Error;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[])
{
    double x;
    for (size_t i = 0; i < n; i++) {
        if (c == NULL || !sn_get((sn_instance *)c, vr[i], &x))
            return fmi2Error;
        value[i] = x != 0.0;
    }
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    for (size_t i = 0; i < n; i++)
        if (c == NULL || !sn_set((sn_instance *)c, vr[i], value[i]))
            return fmi2Error;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[])
{
    for (size_t i = 0; i < n; i++)
        if (c == NULL || !sn_set((sn_instance *)c, vr[i], value[i] ? 1.0 : 0.0))
            return fmi2Error;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        if (c == NULL || !sn_get_integer((sn_instance *)c, vr[i], &value[i]))
            return fmi2Error;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        if (c == NULL || !sn_set_integer((sn_instance *)c, vr[i], value[i]))
            return fmi2Error;
    return fmi2OK;
}

#define SN_NONE2(name, type)                                                                                        \
    SN_EXPORT fmi2Status name(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[])               \
    {                                                                                                               \
        (void)vr, (void)value;                                                                                      \
        return n == 0 ? fmi2OK : sn_refused2(c, #name);                                                             \
    }
SN_NONE2(fmi2GetString, fmi2String)
SN_NONE2(fmi2SetString, const fmi2String)

SN_EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real size, fmi2Boolean no_set_before)
{
    (void)no_set_before;
    return c != NULL && sn_do_step((sn_instance *)c, time, size) ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2CancelStep(fmi2Component c) { return sn_refused2(c, "fmi2CancelStep"); }

SN_EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                                  const fmi2ValueReference known[], size_t n_known,
                                                  const fmi2Real seeds[], fmi2Real moved[])
{
    return c != NULL && sn_derivative((sn_instance *)c, unknown, n, known, n_known, seeds, moved) ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    sn_snapshot *taken;
    if (c == NULL || state == NULL)
        return fmi2Error;
    taken = sn_take_snapshot((sn_instance *)c, (sn_snapshot *)*state);
    if (taken == NULL)
        return fmi2Error;
    *state = taken;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    if (c == NULL || state == NULL)
        return fmi2Error;
    sn_go_back((sn_instance *)c, (const sn_snapshot *)state);
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    if (c == NULL || state == NULL || size == NULL)
        return fmi2Error;
    *size = sn_serial_bytes((const sn_instance *)c);
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (c == NULL || state == NULL || bytes == NULL || size < sn_serial_bytes((const sn_instance *)c))
        return fmi2Error;
    sn_serialise((const sn_instance *)c, (const sn_snapshot *)state, (unsigned char *)bytes);
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    sn_snapshot *made;
    if (c == NULL || bytes == NULL || state == NULL)
        return fmi2Error;
    made = sn_deserialise((sn_instance *)c, (const unsigned char *)bytes, size);
    if (made == NULL)
        return fmi2Error;
    *state = made;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind;
    *value = fmi2OK;
    return c != NULL ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (c == NULL || kind != fmi2LastSuccessfulTime)
        return sn_refused2(c, "this status");
    *value = ((const sn_instance *)c)->time;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind, (void)value;
    return sn_refused2(c, "this status");
}

SN_EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    if (c == NULL || kind != fmi2Terminated)
        return sn_refused2(c, "this status");
    *value = 0;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind, (void)value;
    return sn_refused2(c, "this status");
}

/* What there is no use for here. */
#define SN_REFUSE2(name, arguments, unused)                                                                         \
    SN_EXPORT fmi2Status name arguments                                                                             \
    {                                                                                                               \
        unused;                                                                                                     \
        return sn_refused2(c, #name);                                                                               \
    }
SN_REFUSE2(fmi2SetRealInputDerivatives,
           (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]),
           ((void)vr, (void)n, (void)order, (void)value))
SN_REFUSE2(fmi2GetRealOutputDerivatives,
           (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real value[]),
           ((void)vr, (void)n, (void)order, (void)value))

/* Model Exchange: events, and no continuous states. */
SN_EXPORT fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    return sn_exchanges2(c, "fmi2EnterEventMode") && sn_enter_event((sn_instance *)c) ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    fmi2EventInfo found = {0, 0, 0, 0, 1, 0.0};
    int done = sn_exchanges2(c, "fmi2NewDiscreteStates") && info != NULL &&
               sn_update((sn_instance *)c, &found.newDiscreteStatesNeeded, &found.nextEventTime);
    if (done)
        *info = found;
    return done ? fmi2OK : fmi2Error;
}

SN_EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    if (!sn_exchanges2(c, "fmi2EnterContinuousTimeMode"))
        return fmi2Error;
    ((sn_instance *)c)->event = 0;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *stop)
{
    (void)no;
    if (!sn_exchanges2(c, "fmi2CompletedIntegratorStep"))
        return fmi2Error;
    *event = *stop = 0;
    return fmi2OK;
}

SN_EXPORT fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    return sn_exchanges2(c, "fmi2SetTime") && sn_set_time((sn_instance *)c, time) ? fmi2OK : fmi2Error;
}

#define SN_STATELESS2(name, type)                                                                                   \
    SN_EXPORT fmi2Status name(fmi2Component c, type x[], size_t n)                                                  \
    {                                                                                                               \
        (void)x;                                                                                                    \
        if (!sn_exchanges2(c, #name))                                                                               \
            return fmi2Error;                                                                                       \
        return n == 0 ? fmi2OK : sn_refused2(c, "a continuous state or event indicator");                           \
    }
SN_STATELESS2(fmi2SetContinuousStates, const fmi2Real)
SN_STATELESS2(fmi2GetDerivatives, fmi2Real)
SN_STATELESS2(fmi2GetEventIndicators, fmi2Real)
SN_STATELESS2(fmi2GetContinuousStates, fmi2Real)
SN_STATELESS2(fmi2GetNominalsOfContinuousStates, fmi2Real)

#endif
