/* The least FMI 2.0 Co-Simulation FMU in C that does some work: a first-order lag, for comparison. */
#include <stdlib.h>
#include <string.h>

typedef struct { double u, y; } Lag;
typedef void *Component;
#define PLAIN(name, ...) int name(__VA_ARGS__) { return 0; }

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
Component fmi2Instantiate(const char *a, int b, const char *c, const char *d, const void *e, int f, int g) {
    return calloc(1, sizeof(Lag));
}
void fmi2FreeInstance(Component c) { free(c); }
int fmi2Reset(Component c) { memset(c, 0, sizeof(Lag)); return 0; }
int fmi2SetReal(Component c, const unsigned *r, size_t n, const double *v) {
    for (size_t i = 0; i < n; i++) if (r[i] == 0) ((Lag *)c)->u = v[i];
    return 0;
}
int fmi2GetReal(Component c, const unsigned *r, size_t n, double *v) {
    for (size_t i = 0; i < n; i++) v[i] = r[i] == 0 ? ((Lag *)c)->u : ((Lag *)c)->y;
    return 0;
}
int fmi2DoStep(Component c, double t, double h, int no_set_before) {
    Lag *lag = c;
    lag->y += 0.1 * (lag->u - lag->y);
    return 0;
}
PLAIN(fmi2SetDebugLogging, Component c, int on, size_t n, const char **categories)
PLAIN(fmi2SetupExperiment, Component c, int a, double b, double d, int e, double f)
PLAIN(fmi2EnterInitializationMode, Component c)
PLAIN(fmi2ExitInitializationMode, Component c)
PLAIN(fmi2Terminate, Component c)
PLAIN(fmi2GetInteger, Component c, const unsigned *r, size_t n, int *v)
PLAIN(fmi2GetBoolean, Component c, const unsigned *r, size_t n, int *v)
PLAIN(fmi2GetString, Component c, const unsigned *r, size_t n, const char **v)
PLAIN(fmi2SetInteger, Component c, const unsigned *r, size_t n, const int *v)
PLAIN(fmi2SetBoolean, Component c, const unsigned *r, size_t n, const int *v)
PLAIN(fmi2SetString, Component c, const unsigned *r, size_t n, const char **v)
PLAIN(fmi2GetFMUstate, Component c, void **s)
PLAIN(fmi2SetFMUstate, Component c, void *s)
PLAIN(fmi2FreeFMUstate, Component c, void **s)
PLAIN(fmi2SerializedFMUstateSize, Component c, void *s, size_t *n)
PLAIN(fmi2SerializeFMUstate, Component c, void *s, char *b, size_t n)
PLAIN(fmi2DeSerializeFMUstate, Component c, const char *b, size_t n, void **s)
PLAIN(fmi2GetDirectionalDerivative, Component c)
PLAIN(fmi2SetRealInputDerivatives, Component c)
PLAIN(fmi2GetRealOutputDerivatives, Component c)
PLAIN(fmi2CancelStep, Component c)
PLAIN(fmi2GetStatus, Component c, int s, int *v)
PLAIN(fmi2GetRealStatus, Component c, int s, double *v)
PLAIN(fmi2GetIntegerStatus, Component c, int s, int *v)
PLAIN(fmi2GetBooleanStatus, Component c, int s, int *v)
PLAIN(fmi2GetStringStatus, Component c, int s, const char **v)
